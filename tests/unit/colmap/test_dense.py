"""The dense workspace: views, maps, masks, fusion and surfaces."""

import pickle
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.dense import (
    MASKED,
    DenseStore,
    cameras_of_photos,
    drop_estimates,
    mask_depths,
    publish_maps,
    read_depth,
    read_gray,
    read_views,
    undistort,
    undistort_mask,
    used_pixels,
    write_fusion_views,
)
from sfm_app.colmap.surface import FUSED, fuse, open_points, positions, simplify
from sfm_app.errors import BackendError
from sfm_app.photos.masks import save_mask
from sfm_app.progress import Progress
from sfm_app.stereo import DepthEstimate, DepthMap
from sfm_app.surface import fusion
from sfm_app.surface.fusion import fuse_points
from sfm_app.tasks import Shared
from sfm_app.types import Surface

pytestmark = pytest.mark.slow

NORMAL = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
DISTANCE = 5.0
BOX = np.array([[-50.0] * 3, [50.0] * 3])


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    """Three undistorted views of the plane NORMAL'X = DISTANCE, with its true maps."""
    place = tmp_path_factory.mktemp("dense")
    (place / "photos").mkdir()
    (place / "sparse").mkdir()
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=120, height=90, params=[110, 105, 63, 41])
    )
    for index, x in enumerate((-0.4, 0.0, 0.4), start=1):
        name = f"{index}.png"
        cv2.imwrite(str(place / "photos" / name), np.full((90, 120, 3), (40 * index, 100, 200), np.uint8))
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), np.array([-x, 0.1 * x, 0]))
        image = pycolmap.Image(image_id=index, name=name, camera_id=1)
        model.add_image_with_trivial_frame(image, pose)
    at = np.random.default_rng(0).uniform(-1.2, 1.2, (60, 2))
    points = np.column_stack([at, (DISTANCE - at @ NORMAL[:2]) / NORMAL[2]])
    for image in model.images.values():
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(image.project_point(xyz)) for xyz in points])
    for index, xyz in enumerate(points):
        track = pycolmap.Track()
        for image_id in (1, 2, 3):
            track.add_element(image_id, index)
        model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    model.write(place / "sparse")
    undistort(place / "sparse", place / "photos", place / "dense", 1000, 1, Progress())
    views = read_views(place / "dense")
    for view in views:
        y, x = np.mgrid[: view.height, : view.width] + view.sample_px
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view.K).T @ view.R
        depth = ((DISTANCE - NORMAL @ view.center) / (rays @ NORMAL)).astype(np.float32)
        normals = np.broadcast_to((-view.R @ NORMAL).astype(np.float32), (*depth.shape, 3))
        DenseStore(place / "dense").write_maps(view, DepthMap(depth, normals))
    write_fusion_views(place / "dense", views)
    return place / "dense", views


def test_views_are_those_of_the_model(workspace):
    dense, views = workspace
    assert [view.name for view in views] == ["1.png", "2.png", "3.png"]
    np.testing.assert_allclose(views[0].center, [-0.4, 0.04, 0], atol=1e-12)
    np.testing.assert_allclose(views[0].K, [[110, 0, 63], [0, 105, 41], [0, 0, 1]])
    assert read_gray(dense, views[0]).shape == (90, 120)
    assert all(np.all(np.diff(view.point_ids) > 0) for view in views)
    np.testing.assert_allclose(views[1].points @ NORMAL, DISTANCE, atol=1e-9)


def test_fused_points_lie_on_the_plane_and_face_the_cameras(workspace):
    dense, _ = workspace

    seen = fuse(dense, dense / FUSED)
    np.testing.assert_array_equal(fuse(dense, dense / "cached.ply", cache_gb=0.25), seen)
    records = open_points(dense / FUSED)
    assert (dense / "cached.ply").read_bytes() == (dense / FUSED).read_bytes()
    assert len(seen) == len(records)
    assert set(seen) == {1, 2, 3}
    records = records[seen == 3]
    points, normals = positions(records), np.stack([records[c] for c in ("nx", "ny", "nz")], axis=1)

    assert 1000 < len(points) < 120 * 90
    assert abs(np.median(points @ NORMAL) - DISTANCE) < 4e-4  # depths taken half a pixel aside would make it 2e-3
    assert np.max(np.abs(points @ NORMAL - DISTANCE)) < 0.02
    # with the three planes of the normal map in the wrong order this is 1
    np.testing.assert_allclose(normals, np.broadcast_to(-NORMAL, normals.shape), atol=1e-3)


def test_maps_come_back_as_they_were(workspace):
    dense, views = workspace
    rng = np.random.default_rng(0)
    view = replace(views[0], name="other.png")
    maps = DepthMap(rng.uniform(1, 2, (90, 120)).astype(np.float32), rng.normal(size=(90, 120, 3)).astype(np.float32))
    store = DenseStore(dense)
    assert not store.has(view, "geometric")
    DenseStore(dense).write_maps(view, maps)
    np.testing.assert_array_equal(read_depth(dense, view, "geometric"), maps.depth)
    assert (store.has(view, "geometric"), store.has(view, "photometric")) == (True, False)


def test_estimates_come_and_go(workspace):
    dense, views = workspace
    store, depth = DenseStore(dense), np.full((90, 120), 3.0, np.float32)
    store.write_estimate(views[0], DepthEstimate(depth, depth / 4))

    found = store.read_estimate(views[0])

    np.testing.assert_array_equal(found.depth, depth)
    np.testing.assert_array_equal(found.confidence, depth / 4)
    small = views[0].halve(1)
    assert store.photo(small).shape == (small.height, small.width) == (45, 60)
    assert abs(store.photo(small).mean() - store.photo(views[0]).mean()) < 1
    assert not store.has(small, "photometric")
    store.write_estimate(small, DepthEstimate(depth[:45, :60], depth[:45, :60]))
    assert store.read_estimate(small).depth.shape == (45, 60)
    np.testing.assert_array_equal(store.read_estimate(views[0]).depth, depth)

    drop_estimates(dense, views)

    assert not store.has(views[0], "photometric") and not list(dense.rglob("*.photometric*"))
    assert store.has(views[0], "geometric")


def test_a_map_appears_complete_or_not_at_all(workspace, monkeypatch):
    dense, views = workspace
    store, view = DenseStore(dense), replace(views[0], name="killed.png")

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("pathlib.Path.replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        store.write_maps(view, DepthMap(np.ones((90, 120), np.float32), np.ones((90, 120, 3), np.float32)))

    assert not store.has(view, "geometric")


def test_the_box_cuts_the_points(workspace):
    dense, views = workspace
    fuse_points(dense, views, 2, np.array([[0.0, -50, -50], [50, 50, 50]]), dense / FUSED, 1.0)
    assert positions(open_points(dense / FUSED))[:, 0].min() >= 0


def test_points_of_one_photo_remain_where_no_others_are(workspace, tmp_path):
    dense, views = shutil.copytree(workspace[0], tmp_path / "dense"), workspace[1]
    texture = np.random.default_rng(0).integers(0, 255, (90, 120), np.uint8)
    texture[50:] = 128
    cv2.imwrite(str(dense / "images" / views[0].name), texture)
    for view in views[1:]:  # the left third is now in one photo only
        maps = DenseStore(dense).read_maps(view)
        maps.depth[:, :40] = 0
        DenseStore(dense).write_maps(view, maps)
    seen = fuse(dense, dense / FUSED)
    everything = open_points(dense / FUSED)
    sure, lone = everything[seen >= 2], everything[seen == 1]
    gaps, _ = cKDTree(positions(sure)).query(positions(lone))
    near = 2.5 * DISTANCE / 110

    fuse_points(dense, views, 2, BOX, dense / "chosen.ply", 1.0)
    chosen = {point.tobytes() for point in open_points(dense / "chosen.ply")}

    def kept(points):
        return np.array([point.tobytes() in chosen for point in points])

    assert kept(sure).all()
    pixels = views[0].K @ (views[0].R @ positions(lone).T + views[0].t[:, None])
    row = pixels[1] / pixels[2]
    beside = (gaps > 4 * near) & (gaps < 6 * near)
    shown = beside & (row < 47)
    assert np.count_nonzero(shown) > 150 and np.mean(kept(lone[shown])) > 0.96  # but those on the border of the photo
    for out in (gaps < 2 * near, gaps > 14 * near, beside & (row > 56)):
        assert np.count_nonzero(out) > 90 and not kept(lone[out]).any()


def test_a_fusion_that_is_stopped_leaves_nothing_behind(workspace, tmp_path, monkeypatch):
    dense, views = workspace

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(fusion, "open_points", stop)
    with pytest.raises(KeyboardInterrupt):
        fuse_points(dense, views, 2, BOX, tmp_path / FUSED, 1.0)
    assert not list(tmp_path.iterdir())


def wavy(size: int) -> Surface:
    """A square of two halves, flat on the left, wavy on the right, in the unit square."""
    y, x = np.mgrid[: size + 1, : size + 1] / size
    z = np.where(x > 0.5, 0.03 * (1 - np.cos(8 * np.pi * (x - 0.5))), 0.0)
    at = np.arange((size + 1) ** 2).reshape(size + 1, size + 1)
    a, b, c, d = (corner.ravel() for corner in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    colors = np.broadcast_to(np.uint8([200, 100, 50]), vertices.shape)
    return Surface(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]), colors)


def test_simplification_spares_what_is_curved_and_keeps_borders_and_colors(tmp_path):
    fine = wavy(40)
    found = simplify(fine, len(fine.faces) // 5, 0.0, tmp_path)
    assert 0.15 * len(fine.faces) < len(found.faces) <= 0.2 * len(fine.faces)
    middles = found.vertices[found.faces].mean(axis=1)[:, 0]
    assert np.count_nonzero(middles > 0.5) > 10 * np.count_nonzero(middles < 0.5)
    np.testing.assert_allclose(
        [found.vertices.min(axis=0)[:2], found.vertices.max(axis=0)[:2]], [[0, 0], [1, 1]], atol=0.01
    )
    assert np.all(np.abs(found.colors.astype(int) - [200, 100, 50]) <= 1) and not list(tmp_path.iterdir())


@pytest.mark.parametrize("max_error", [3e-3, 1e-2])
def test_simplification_by_error_stops_where_it_would_move_the_surface(tmp_path, max_error):
    fine = wavy(40)
    found = simplify(fine, len(fine.faces), max_error, tmp_path)
    fewer = simplify(fine, len(found.faces) // 2, max_error, tmp_path)
    threaded = simplify(fine, len(found.faces) // 2, max_error, tmp_path, threads=2)
    closest = trimesh.proximity.closest_point_naive(trimesh.Trimesh(found.vertices, found.faces), fine.vertices)[1]
    assert 0.05 * max_error < closest.max() < 2 * max_error and 20 < len(found.faces) < 0.5 * len(fine.faces)
    assert 0.7 * len(found.faces) // 2 < len(fewer.faces) <= len(found.faces) // 2
    np.testing.assert_array_equal(threaded.vertices, fewer.vertices)
    np.testing.assert_array_equal(threaded.faces, fewer.faces)


def test_missing_inputs_are_backend_errors(tmp_path, workspace):
    with pytest.raises(BackendError, match="undistorting photos"):
        undistort(tmp_path / "none", tmp_path, tmp_path / "dense", 100, 1, Progress())
    with pytest.raises(BackendError, match=r"depth map of 1\.png"):
        read_depth(tmp_path, workspace[1][0], "geometric")


SIZE = 240, 160
NAMES = ("1.png", "sub/2.png", "3.png")


def blots(seed):
    coarse = np.random.default_rng(seed).integers(0, 255, (SIZE[1] // 8, SIZE[0] // 8, 3), np.uint8)
    return Image.fromarray(coarse).resize(SIZE, Image.Resampling.BICUBIC)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """Three photos of a barrel lens and their masks: the left half, a thin cross, and none."""
    root = tmp_path_factory.mktemp("masks")
    used = {name: np.ones(SIZE[::-1], bool) for name in NAMES}
    used["1.png"][:, :120] = False
    used["sub/2.png"][80] = used["sub/2.png"][:, 60] = False
    for seed, name in enumerate(NAMES):
        (root / "photos" / name).parent.mkdir(parents=True, exist_ok=True)
        blots(seed).save(root / "photos" / name)
        save_mask(root / "masks", name, used[name])
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="OPENCV", width=240, height=160, params=[200, 205, 118, 83, -0.2, 0, 0, 0])
    )
    for index, name in enumerate(NAMES, start=1):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), np.array([-0.1 * index, 0, 0]))
        model.add_image_with_trivial_frame(pycolmap.Image(image_id=index, name=name, camera_id=1), pose)
    (root / "sparse").mkdir()
    model.write(root / "sparse")
    return root, used


@pytest.fixture
def dense(place, tmp_path):
    root, _ = place
    undistort(root / "sparse", root / "photos", tmp_path, 120, 1, Progress())
    views = read_views(tmp_path)
    cameras = pickle.loads(pickle.dumps(cameras_of_photos(root / "sparse")))  # noqa: S301 - as for another process
    for view in views:
        undistort_mask(Shared(cameras), root / "masks", tmp_path, view)
    return tmp_path, {view.name: view for view in views}


def test_masks_are_undistorted_as_photos_are(place, dense):
    root, used = place
    model = pycolmap.Reconstruction(root / "sparse")
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = 120
    square = np.ones((2 * 2 + 1, 2 * 2 + 1), np.uint8)
    for name, view in dense[1].items():
        bitmap = pycolmap.Bitmap.from_array(np.where(used[name], np.uint8(255), np.uint8(0)))
        theirs = pycolmap.undistort_image(options, bitmap, model.cameras[1])[0].to_array()
        seen = used_pixels(dense[0], view)

        assert seen.shape == theirs.shape == (view.height, view.width)
        near = cv2.erode(theirs, square)
        assert (near[seen] == 255).all()  # nothing masked shows through, and next to nothing is lost
        wide = cv2.erode(theirs, np.ones((2 * 2 + 5, 2 * 2 + 5), np.uint8))
        assert seen[wide == 255].all()
    assert used_pixels(dense[0], dense[1]["3.png"]).all()


def test_without_masks_all_is_used(place, tmp_path):
    root, _ = place
    undistort(root / "sparse", root / "photos", tmp_path, 120, 1, Progress())
    view = read_views(tmp_path)[0]
    depth = np.full((view.height, view.width), 3.0, np.float32)
    assert used_pixels(tmp_path, view) is None
    DenseStore(tmp_path).write_estimate(view, DepthEstimate(depth, depth / 4))
    assert (DenseStore(tmp_path).read_estimate(view).depth == 3).all()
    assert (mask_depths(tmp_path, view, depth) == 3).all()


def test_estimates_have_no_depth_where_the_photo_is_masked(dense):
    """And no doubt: else what is masked counts as one plain area with a wall beside it."""
    folder, views = dense
    view = views["sub/2.png"]
    used, depth = used_pixels(folder, view), np.full((view.height, view.width), 3.0, np.float32)

    DenseStore(folder).write_estimate(view, DepthEstimate(depth, np.full_like(depth, 0.05)))
    found = DenseStore(folder).read_estimate(view)

    np.testing.assert_array_equal(found.depth, np.where(used, 3, 0))
    np.testing.assert_allclose(found.confidence, np.where(used, 0.05, 1))
    small = view.halve(1)
    DenseStore(folder).write_estimate(small, DepthEstimate(depth[::2, ::2], np.full_like(depth[::2, ::2], 0.05)))
    all_used = used[: small.height * 2, : small.width * 2].reshape(small.height, 2, small.width, 2).all(axis=(1, 3))
    found = DenseStore(folder).read_estimate(small)
    np.testing.assert_array_equal(found.depth, np.where(all_used, 3, 0))


def test_nothing_is_fused_from_what_is_masked(dense):
    folder, views = dense
    normals = np.zeros((*used_pixels(folder, views["1.png"]).shape, 3), np.float32)
    normals[..., 2] = -1
    for view in views.values():
        depth = mask_depths(folder, view, np.full(normals.shape[:2], 4.0, np.float32))
        DenseStore(folder).write_maps(view, DepthMap(depth, normals), "final")
        publish_maps(folder, view)
        publish_maps(folder, view)  # a killed run does it twice
    view = views["1.png"]
    used = used_pixels(folder, view)
    np.testing.assert_array_equal(read_depth(folder, view, "geometric"), np.where(used, 4, np.float32(MASKED)))

    write_fusion_views(folder, [view])
    fuse(folder, folder / FUSED)
    points = positions(open_points(folder / FUSED))

    at = (points @ view.R.T + view.t) @ view.K.T
    col, row = np.rint(at[:, :2] / at[:, 2:]).astype(int).T
    assert len(points) == np.count_nonzero(used) and used[row, col].all()
