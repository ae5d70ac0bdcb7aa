"""Exports of a scene, read back by the programs they are for, or by their libraries; cameras and points are known."""

import json

import cv2
import laspy
import numpy as np
import pytest
import trimesh
from PIL import Image

import sfm_app
from sfm_app import exports
from sfm_app.camera_files import read_given_cameras
from sfm_app.colmap.backend import pycolmap
from sfm_app.formats.gltf import FLIP
from sfm_app.geometry.poses import Similarity
from sfm_app.products import write_photo_list
from sfm_app.types import Photo, PhotoSet
from tests.unit.colored_photos import colors_of

EXACT_PX, RELATIVE = 1e-6, 1e-6
MOVED = Similarity(3.5, cv2.Rodrigues(np.array([0.3, -0.2, 0.5]))[0], np.array([10.0, -2.0, 4.0]))


@pytest.fixture(params=[None, MOVED], ids=["own frame", "moved"])
def frame(request, monkeypatch):
    """The frame of exports: the model's own, or another one."""
    monkeypatch.setattr(exports, "export_frame", lambda _: request.param)
    return request.param or Similarity(1.0, np.eye(3), np.zeros(3))


def places(model, frame):
    """Points of a model in the frame of its exports, by id."""
    return {key: frame(point.xyz[None])[0] for key, point in model.points3D.items()}


def check_picture(path, K, R, frame, used=None):
    """The colors of a picture are the directions of its pixels in the model's frame."""
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    height, width = pixels.shape[:2]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(K).T @ R @ frame.R
    wrong = np.abs(pixels - colors_of(rays))
    wrong = wrong if used is None else wrong[used]
    assert np.mean(wrong) < 2.5 and np.quantile(wrong, 0.99) < 12


@pytest.mark.parametrize("name", ["colmap", pytest.param("colmap-text", marks=pytest.mark.slow), "splat", "openmvs"])
@pytest.mark.parametrize("kinds", [("lens", "other"), ("pinhole",), ("fisheye",), ("panorama", "lens")], ids="+".join)
def test_colmap_reads_photos_without_distortion(make_run, frame, name, kinds):
    run = make_run(*kinds, until="scene")

    folder = sfm_app.export_scene(run.out, name)
    place = folder / ("sparse" if name == "openmvs" else "sparse/0")
    model = pycolmap.Reconstruction(place)

    assert folder == run.out / "export" / name
    assert (place / f"images.{'txt' if name == 'colmap-text' else 'bin'}").exists()
    truth = places(run.model, frame)
    shares = len(model.points3D) / len(truth)
    assert 0.9 < shares <= 1.0 and (shares == 1.0 or name == "splat" or "lens" in kinds)
    for key, point in model.points3D.items():
        np.testing.assert_allclose(point.xyz, truth[key], rtol=RELATIVE)
        assert point.color.tolist() == run.model.points3D[key].color.tolist()
    for camera in model.cameras.values():
        assert camera.model.name == "PINHOLE"
        if name == "splat":
            fx, fy, cx, cy = camera.params
            assert (fx, cx, cy) == (fy, camera.width / 2, camera.height / 2)
    assert model.compute_mean_reprojection_error() < EXACT_PX
    photo_of = json.loads((folder / "export.json").read_text("utf-8"))["photo_of"]
    poses = {image.name: image for image in run.model.images.values()}
    for image in model.images.values():
        camera, pose = model.cameras[image.camera_id], image.cam_from_world().matrix()
        assert image.name.isascii() and image.name.count(".") == 1 and not set(image.name) & set(" /")
        true = poses[photo_of[image.name]].cam_from_world().matrix()
        center = frame((-true[:, :3].T @ true[:, 3])[None])[0]
        np.testing.assert_allclose(-pose[:, :3].T @ pose[:, 3], center, rtol=RELATIVE, atol=RELATIVE)
        with Image.open(folder / "images" / image.name) as picture:
            assert picture.size == (camera.width, camera.height)
        mask = folder / "masks" / f"{image.name}.png"
        used = np.asarray(Image.open(mask)) > 0 if mask.exists() else None
        check_picture(folder / "images" / image.name, camera.calibration_matrix(), pose[:, :3], frame, used)
    assert len(photo_of) == len(model.images) == len({name.lower() for name in photo_of})


def test_an_off_center_photo_keeps_nearly_all_of_its_picture_in_splat(make_run):
    run = make_run("pinhole")
    folder = sfm_app.export_scene(run.out, "splat")
    (camera,) = pycolmap.Reconstruction(folder / "sparse" / "0").cameras.values()
    assert 0.85 < camera.width / 240 < 1.0 and 0.85 < camera.height / 160 < 1.0  # a crop would keep 0.83


@pytest.mark.parametrize("kinds", [("lens",), ("lens", "other"), ("fisheye",)], ids="+".join)
def test_transforms_json_projects_points_as_its_documentation_says(make_run, frame, kinds):
    run = make_run(*kinds)

    folder = sfm_app.export_scene(run.out, "nerfstudio")
    told = json.loads((folder / "transforms.json").read_text("utf-8"))
    cloud = trimesh.load(folder / told["ply_file_path"])

    truth = np.array([run.model.points3D[key].xyz for key in sorted(run.model.points3D)])
    np.testing.assert_allclose(cloud.vertices, frame(truth), rtol=RELATIVE, atol=1e-5)
    assert ("fl_x" in told) == (kinds == ("lens",))
    assert told["camera_model"] == "OPENCV" and "applied_transform" not in told
    assert len({"mask_path" in entry for entry in told["frames"]}) == 1
    photo_of = json.loads((folder / "export.json").read_text("utf-8"))["photo_of"]
    seen = 0
    for entry in told["frames"]:
        lens = {**told, **entry}
        world_from_cam = np.array(entry["transform_matrix"])
        assert np.linalg.det(world_from_cam[:3, :3]) == pytest.approx(1.0)
        at = (frame(truth) - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]  # x right, y up, z back
        ahead = at[:, 2] < -0.2 * frame.scale
        focal, center = np.array([-lens["fl_x"], lens["fl_y"]]), (lens["cx"], lens["cy"])
        x = center + focal * at[:, :2] / at[:, 2:]
        inside = ahead & (x > 2).all(axis=1) & (x < [lens["w"] - 2, lens["h"] - 2]).all(axis=1)
        seen += inside.sum()
        K = np.array([[lens["fl_x"], 0, lens["cx"]], [0, lens["fl_y"], lens["cy"]], [0, 0, 1]])
        mask = folder / entry["mask_path"] if "mask_path" in entry else None
        used = np.asarray(Image.open(mask)) > 0 if mask else None
        check_picture(folder / entry["file_path"], K, FLIP @ world_from_cam[:3, :3].T, frame, used)
        if len(kinds) == 1 and kinds[0] == "lens":  # undistorted, a point is where the lens shows it
            name = photo_of[entry["file_path"].removeprefix("images/")]
            image = next(image for image in run.model.images.values() if image.name == name)
            camera = run.model.cameras[image.camera_id]
            back = np.array(camera.img_from_cam(np.column_stack([(x - K[:2, 2]) / np.diag(K)[:2], np.ones(len(x))])))
            true = np.array([image.project_point(point) for point in truth[inside]])
            np.testing.assert_allclose(back[inside], true, atol=EXACT_PX)
    assert seen > 100


@pytest.mark.parametrize("name", ["colmap", "nerfstudio"])
def test_masks_go_along(make_run, name):
    run = make_run("pinhole", masks=True)
    folder = sfm_app.export_scene(run.out, name)
    masks = sorted(path.name for path in (folder / "masks").iterdir())
    assert masks == sorted(f"{path.name}.png" for path in (folder / "images").iterdir())
    used = np.asarray(Image.open(folder / "masks" / masks[0])) > 0
    assert used.shape == (160, 240)
    assert not used[:, :121].any() and used[3:-3, 125:-3].all()


@pytest.mark.parametrize("kind", ["lens", "other", "pinhole", "fisheye"])
def test_opencv_projects_where_the_camera_does(make_run, frame, kind):
    run = make_run(kind)

    folder = sfm_app.export_scene(run.out, "opencv")
    storage = cv2.FileStorage(str(folder / "c_1.yaml"), cv2.FILE_STORAGE_READ)
    K, terms = (storage.getNode(key).mat() for key in ("camera_matrix", "distortion_coefficients"))
    photos = storage.getNode("photos")

    assert (storage.getNode("image_width").real(), storage.getNode("image_height").real()) == (240, 160)
    assert storage.getNode("standard_deviations").getNode("fx").real() == 0.25
    images = {image.name: image for image in run.model.images.values()}
    assert photos.size() == len(images)
    for number in range(photos.size()):
        entry = photos.at(number)
        image = images[entry.getNode("name").string()]
        points = [point for point in image.points2D if point.has_point3D()]
        X = frame(np.array([run.model.points3D[point.point3D_id].xyz for point in points]))
        given = X[:, None], entry.getNode("rvec").mat(), entry.getNode("tvec").mat(), K, terms
        project = cv2.fisheye.projectPoints if kind == "fisheye" else cv2.projectPoints
        found = project(*given)[0].reshape(-1, 2) + 0.5  # OpenCV's first pixel is (0, 0)
        np.testing.assert_allclose(found, [point.xy for point in points], atol=EXACT_PX)


def test_opencv_cameras_are_read_by_our_own_reader(make_run):
    run = make_run("lens")
    given = read_given_cameras(sfm_app.export_scene(run.out, "opencv") / "c_1.yaml")
    (camera,) = given.cameras.values()
    np.testing.assert_allclose(camera.K, run.model.cameras[1].calibration_matrix(), rtol=1e-12)


@pytest.mark.parametrize("kind", ["panorama", "prism"])
def test_cameras_that_opencv_does_not_know_are_named(make_run, kind):
    run = make_run(kind)
    with pytest.raises(sfm_app.InputError, match="camera c 1 is left out: OpenCV") as caught:
        sfm_app.export_scene(run.out, "opencv")
    assert "--format cameras" in caught.value.hint
    assert not (run.out / "export" / "opencv").exists()


def test_the_other_cameras_are_written_for_opencv(make_run):
    run = make_run("lens", "panorama")
    folder = sfm_app.export_scene(run.out, "opencv")
    assert [path.name for path in folder.glob("*.yaml")] == ["c_1.yaml"]


@pytest.mark.parametrize("kinds", [("lens", "other"), ("fisheye",), ("panorama",)], ids="+".join)
def test_cameras_and_poses_are_read_from_json(make_run, frame, kinds):
    run = make_run(*kinds, until="scene")

    file = sfm_app.export_scene(run.out, "cameras")
    told = json.loads(file.read_text("utf-8"))
    given = read_given_cameras(file)

    assert file == run.out / "cameras.json"
    assert told["unregistered"] == {"lost.jpg": "no overlap"}
    for image in run.model.images.values():
        entry, camera = told["photos"][image.name], run.model.cameras[image.camera_id]
        pose, true = np.array(entry["cam_from_world"]), image.cam_from_world().matrix()
        X = np.array([[1.0, 2.0, 5.0], [0.0, -3.0, 4.0]])
        np.testing.assert_allclose(
            frame(X) @ pose[:, :3].T + pose[:, 3], frame.scale * (X @ true[:, :3].T + true[:, 3])
        )
        np.testing.assert_allclose(entry["center"], -pose[:, :3].T @ pose[:, 3], atol=1e-12)
        known = told["cameras"][entry["camera"]]
        assert (known["model"], known["deviations"]) == (camera.model.name, {"fx": 0.25})
        assert len(known["parameters"]) == len(known["params"])
        np.testing.assert_allclose(known["params"], camera.params, rtol=1e-15)
        if not camera.is_spherical():
            np.testing.assert_allclose(given.cameras[entry["camera"]].K, camera.calibration_matrix(), rtol=1e-12)


def test_the_dense_cloud_is_read_from_ply_and_from_laz(make_run, frame):
    run = make_run()
    points = frame(np.stack([run.cloud[c] for c in "xyz"], axis=1).astype(np.float64))

    plain = trimesh.load(sfm_app.export_scene(run.out, "cloud-ply"))
    laz, las = (laspy.read(sfm_app.export_scene(run.out, name)) for name in ("laz", "las"))
    assert las.header.are_points_compressed is False and np.array_equal(las.xyz, laz.xyz)

    np.testing.assert_allclose(plain.vertices, points, rtol=RELATIVE, atol=1e-6 * frame.scale)
    colors = np.stack([run.cloud[c] for c in ("red", "green", "blue")], axis=1)
    np.testing.assert_array_equal(plain.colors[:, :3], colors)
    raw = plain.metadata["_ply_raw"]["vertex"]["data"]
    normals = np.stack([raw[c] for c in ("nx", "ny", "nz")], axis=-1).reshape(-1, 3)
    np.testing.assert_allclose(normals, np.tile(frame.R[:, 0], (400, 1)), atol=1e-6)
    assert 1e-10 < laz.header.scales[0] / np.ptp(points, axis=0).max() < 1e-8
    np.testing.assert_allclose(laz.xyz, points, rtol=0, atol=0.51 * laz.header.scales[0])
    assert (laz.header.version, laz.header.point_count) == ("1.2", 400)
    np.testing.assert_array_equal(laz.blue // 257, run.cloud["blue"])


def read_bundle(file):
    """Focals, rotations, translations, points and sightings of a file of Bundler, as its manual defines it."""
    numbers = iter(" ".join(file.read_text().splitlines()[1:]).split())
    take = lambda count: np.array([float(next(numbers)) for _ in range(count)])  # noqa: E731
    cameras, points = take(2).astype(int)
    views = [(take(3), take(9).reshape(3, 3), take(3)) for _ in range(cameras)]
    found = []
    for _ in range(points):
        X, color = take(3), take(3)
        sightings = take(4 * int(take(1)[0])).reshape(-1, 4)
        found.append((X, color, sightings))
    return views, found


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [("lens", "other"), ("fisheye",)], ids="+".join)
def test_bundler_sees_points_where_the_photos_do(make_run, frame, kinds):
    run = make_run(*kinds)

    folder = sfm_app.export_scene(run.out, "bundler")
    views, points = read_bundle(folder / "bundle.out")
    photos = (folder / "list.txt").read_text().split()

    assert (folder / "bundle.out").read_text().startswith("# Bundle file v0.3\n")
    assert len(views) == len(photos) and all((folder / photo).exists() for photo in photos)
    written = {path.name for path in folder.iterdir()} - {"masks"}
    assert written == {"bundle.out", "export.json", "images", "list.txt"}
    truth = np.array(list(places(run.model, frame).values()))
    errors = []
    for X, _, sightings in points:
        assert np.abs(truth - X).max(axis=1).min() < RELATIVE * frame.scale
        for number, _, *x in sightings:
            (f, k1, k2), R, t = views[int(number)]
            at = R @ X + t
            assert k1 == k2 == 0.0 and at[2] < 0
            errors.append(np.abs(-f * at[:2] / at[2] - x).max())
    assert len(errors) >= 200 and max(errors) < 1e-3


@pytest.mark.slow
def test_the_record_names_the_files_of_the_user(make_run):
    run = make_run("lens", until="scene")
    names = [*(image.name for image in run.model.images.values()), "lost.jpg"]
    photos = tuple(Photo(name, 60, 40, "g", original=f"my {name}.heic") for name in names)
    write_photo_list(PhotoSet(run.place.photos, photos), dict.fromkeys(names), run.place)
    record = json.loads((sfm_app.export_scene(run.out, "colmap") / "export.json").read_text("utf-8"))
    assert set(record["photo_of"].values()) == {photo.path for photo in photos[:-1]}
    assert record["unregistered"] == {"my lost.jpg.heic": "no overlap"}


@pytest.mark.slow
def test_a_folder_is_the_same_every_time(make_run):
    run = make_run("fisheye", masks=True)
    one, two = (sfm_app.export_scene(run.out, "splat", run.out / name) for name in ("one", "two"))
    files = sorted(path.relative_to(one) for path in one.rglob("*") if path.is_file())
    assert len(files) > 20
    assert all((one / name).read_bytes() == (two / name).read_bytes() for name in files)
