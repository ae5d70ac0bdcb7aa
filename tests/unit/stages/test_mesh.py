"""From true depth maps of a ball seen all round to its closed surface."""

import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.dense import DenseStore, map_file, read_views, write_fusion_views
from sfm_app.colmap.surface import open_points, positions
from sfm_app.errors import ReconstructionError
from sfm_app.geometry.triangles import areas, unique_edges, vertex_normals
from sfm_app.plugins import load_plugins
from sfm_app.products import SURFACE, hash_surface, read_surface
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages import mesh
from sfm_app.stereo import DepthMap
from sfm_app.surface import blocks, fusion, refining
from sfm_app.synthetic.cameras import look_at

pytestmark = pytest.mark.slow

FEW_BLOCKS = 14_000
"""Points of a block with which the ball has three; 8000 give four."""

DISTANCE, FOCAL, WIDTH, HEIGHT = 4.0, 190.0, 120, 110
WAYS = np.array([[np.cos(a) * np.cos(e), np.sin(e), np.sin(a) * np.cos(e)] for e in (-0.9, 0, 0.9) for a in range(6)])


def write_model(place):
    """Cameras all round the unit ball, and points on it."""
    model = pycolmap.Reconstruction()
    params = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=WIDTH, height=HEIGHT, params=params)
    model.add_camera_with_trivial_rig(camera)
    for index, way in enumerate(WAYS, start=1):
        pose = pycolmap.Rigid3d(look_at(DISTANCE * way, np.zeros(3)))
        model.add_image_with_trivial_frame(pycolmap.Image(image_id=index, name=f"{index:02d}.png", camera_id=1), pose)
    points = np.random.default_rng(0).normal(size=(200, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    for image in model.images.values():
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.zeros(2)) for _ in points])
    for index, xyz in enumerate(points):
        track = pycolmap.Track()
        for image_id in model.images:
            track.add_element(image_id, index)
        model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    (place / "sparse").mkdir(parents=True)
    model.write(place / "sparse")


def true_maps(view):
    """Depth and normals of the ball."""
    y, x = np.mgrid[: view.height, : view.width] + view.sample_px
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view.K).T
    center = view.t  # of the ball, in the camera
    a, b = np.sum(rays**2, axis=-1), rays @ center
    root = b**2 - a * (center @ center - 1)
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, 0)
    normals = np.where(root[..., None] > 0, rays * depth[..., None] - center, 0)
    grazing = -np.sum(normals * rays, axis=-1) < 0.3 * np.sqrt(a)
    return DepthMap(
        *(np.where(m, 0, v).astype(np.float32) for m, v in ((grazing, depth), (grazing[..., None], normals)))
    )


@pytest.fixture(scope="module")
def dense(tmp_path_factory):
    place = tmp_path_factory.mktemp("ball") / "dense"
    write_model(place)
    (place / "images").mkdir()
    for view in read_views(place):
        cv2.imwrite(str(place / "images" / view.name), np.full((HEIGHT, WIDTH, 3), (40, 90, 200), np.uint8))
        DenseStore(place).write_maps(view, true_maps(view))
    write_fusion_views(place, read_views(place))
    return place


def run_in(dense, workers=2, **options):
    settings = Settings.from_mapping({"mesh": options})
    return RunContext(settings, Workspace(dense.parent), load_plugins(), make_executor(workers), workers)


def made(dense, **options):
    run = run_in(dense, **{"max_image_size_px": 0} | options)
    if not run.workspace.photos.exists():  # without distortion: those of the workspace are the originals
        run.workspace.photos.symlink_to(dense / "images")
    return mesh.make(SimpleNamespace(model_dir=dense / "sparse"), dense, run), run.statistics


@pytest.fixture(scope="module")
def ball(dense):
    return made(dense)


def copied(dense, target):
    for name in ("dense", "surface"):
        shutil.copytree(dense.parent / name, target / name)
    return target / "dense"


def assert_closed(surface):
    """Two triangles at each edge, and the Euler characteristic of a sphere."""
    edges, edge_of = unique_edges(surface.faces)
    assert np.array_equal(np.bincount(edge_of.ravel()), np.full(len(edges), 2))
    assert len(surface.vertices) - len(edges) + len(surface.faces) == 2


def test_a_closed_thing_seen_all_round_is_closed(ball):
    surface, counts = ball
    corners = surface.vertices[surface.faces]
    assert_closed(surface)
    assert np.sum(np.linalg.det(corners)) / 6 == pytest.approx(4 / 3 * np.pi, rel=0.02)
    assert np.percentile(np.abs(np.linalg.norm(surface.vertices, axis=1) - 1), 95) < 0.01
    assert counts["triangles"] == len(surface.faces) < 0.6 * counts["raw_triangles"]


def test_normals_point_outward_and_colors_are_those_of_the_photos(ball):
    surface, _ = ball
    normals = vertex_normals(surface.vertices, surface.faces)
    assert np.sum(normals * surface.vertices, axis=1).min() > 0.5
    np.testing.assert_array_equal(np.median(surface.colors, axis=0), [200, 90, 40])


def test_fewer_faces_do_not_fuse_again_and_one_worker_gives_the_same_bytes(dense, ball):
    stamp = (dense.parent / "surface" / "fused.ply").stat().st_mtime_ns
    few, _ = made(dense, faces=500)
    again, _ = made(dense, workers=1)
    assert (dense.parent / "surface" / "fused.ply").stat().st_mtime_ns == stamp
    assert 400 < len(few.faces) <= 500
    for name in ("vertices", "faces", "colors"):
        np.testing.assert_array_equal(getattr(again, name), getattr(ball[0], name))
        np.testing.assert_array_equal(getattr(read_surface(run_in(dense).workspace), name), getattr(again, name))


@pytest.mark.parametrize("watertight", [False, True])
def test_what_no_photo_sees_is_open_or_closed_as_asked(dense, tmp_path, watertight):
    half = tmp_path / "dense"
    shutil.copytree(dense, half)
    for view in read_views(half):
        if view.center[2] < 1.0:
            map_file(half, view).unlink()
    write_fusion_views(half, read_views(half))

    found, _ = made(half, watertight=watertight)

    assert -0.75 < found.vertices[:, 2].min() < 0.2
    edges, edge_of = unique_edges(found.faces)
    border = np.bincount(edge_of.ravel(), minlength=len(edges)) == 1
    assert border.any() != watertight
    ends = found.vertices[edges[border]]
    assert watertight or np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).sum() < 3.0 * np.pi  # one border, not frayed


def test_maps_that_agree_on_nothing_give_an_error_that_says_so(dense, tmp_path):
    poor = tmp_path / "dense"
    shutil.copytree(dense, poor)
    for view, factor in zip(read_views(poor)[:3], (1.0, 1.6, 2.7), strict=True):
        maps = true_maps(view)
        DenseStore(poor).write_maps(view, DepthMap(maps.depth * np.float32(factor), maps.normals))
    for view in read_views(poor)[3:]:
        map_file(poor, view).unlink()
    write_fusion_views(poor, read_views(poor))

    with pytest.raises(ReconstructionError, match=r"3 depth maps agree on only \d+ points") as err:
        made(poor)
    assert "points.ply" in err.value.hint


def test_without_depth_maps_there_is_no_surface(dense, tmp_path):
    shutil.copytree(dense / "sparse", tmp_path / "dense" / "sparse")
    with pytest.raises(ReconstructionError, match="no photo has a depth map"):
        made(tmp_path / "dense")


def test_a_ball_in_blocks_is_the_ball(dense, ball, tmp_path):
    place = copied(dense, tmp_path)
    found, counts = made(place, block_points=8000)
    again, _ = made(place, workers=1, block_points=8000)

    assert counts["blocks"] >= 4
    assert_closed(found)
    assert np.percentile(np.abs(np.linalg.norm(found.vertices, axis=1) - 1), 95) < 0.01
    assert 0.5 * len(ball[0].faces) < len(found.faces) < 2.0 * len(ball[0].faces)
    normals = vertex_normals(found.vertices, found.faces)
    assert np.quantile(np.sum(normals * found.vertices, axis=1), 0.005) > 0.95
    np.testing.assert_array_equal(np.median(found.colors, axis=0), [200, 90, 40])
    np.testing.assert_array_equal(again.vertices, found.vertices)


@pytest.mark.parametrize("block_points", [4_000_000, FEW_BLOCKS])
def test_refined_with_photos_that_show_nothing_a_ball_stays_a_ball(dense, tmp_path, block_points):
    place = copied(dense, tmp_path)
    found, counts = made(place, max_image_size_px=1600, block_points=block_points)
    assert_closed(found)
    assert np.percentile(np.abs(np.linalg.norm(found.vertices, axis=1) - 1), 95) < 0.015
    assert ("blocks" in counts) == (block_points == FEW_BLOCKS) == ("refined_triangles" not in counts)


def test_a_refinement_that_fails_leaves_the_surface(dense, ball, tmp_path, monkeypatch):
    def fail(*_):
        raise np.linalg.LinAlgError("a singular matrix")

    monkeypatch.setattr(refining, "refine", fail)

    found, counts = made(copied(dense, tmp_path), max_image_size_px=1600)

    assert counts["refinement_failed"] == "the computation failed: a singular matrix"
    np.testing.assert_array_equal(found.vertices, ball[0].vertices)


def marbled(view, radius):
    """What a camera sees of a ball whose color varies smoothly in space."""
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(view.K).T @ view.R
    a, b = np.sum(rays**2, axis=-1), rays @ view.center
    root = b**2 - a * (view.center @ view.center - radius**2)
    places = view.center + rays * ((-b - np.sqrt(np.maximum(root, 0))) / a)[..., None]
    value = np.zeros_like(a)
    for way in np.random.default_rng(3).normal(size=(12, 3)):
        value += np.cos(14.0 * places @ way)
    return np.where(root > 0, np.clip(128 + 20 * value, 0, 255), 255).astype(np.uint8)


@pytest.mark.parametrize("block_points", [4_000_000, FEW_BLOCKS])
def test_a_ball_that_is_too_small_grows_to_what_the_photos_show(dense, ball, tmp_path, block_points):
    place, radius = copied(dense, tmp_path), 1.008
    for view in read_views(place):
        cv2.imwrite(str(place / "images" / view.name), marbled(view, radius))
    found, _ = made(place, max_image_size_px=1600, block_points=block_points)
    assert np.median(np.linalg.norm(ball[0].vertices, axis=1)) == pytest.approx(1.0, abs=0.002)
    assert np.median(np.linalg.norm(found.vertices, axis=1)) == pytest.approx(radius, abs=0.004)


def test_a_run_that_was_killed_makes_the_missing_blocks_only(dense, ball, tmp_path, monkeypatch):
    place, done, whole = copied(dense, tmp_path), [], blocks.mesh_block

    def stop_at_third(task):
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(task.number)
        return whole(task)

    def count(task):
        done.append(task.path.exists())
        return whole(task)

    monkeypatch.setattr(blocks, "mesh_block", stop_at_third)
    with pytest.raises(KeyboardInterrupt):
        made(place, workers=1, block_points=8000)
    done.clear()
    monkeypatch.setattr(blocks, "mesh_block", count)
    found, _ = made(place, workers=1, block_points=8000)

    assert done[:2] == [True, True]
    assert not any(done[2:])
    assert len(found.faces) > 1000
    assert not (tmp_path / "surface" / blocks.BLOCKS).exists()


def test_fused_in_blocks_the_points_are_the_same_but_for_their_rims(dense, ball, tmp_path, monkeypatch):
    shutil.copytree(dense, tmp_path / "dense")
    whole = positions(open_points(dense.parent / "surface" / "fused.ply"))
    monkeypatch.setattr(fusion, "MOST_PIXELS", WIDTH * HEIGHT * len(WAYS) // 3)

    _, counts = made(tmp_path / "dense")
    parts = positions(open_points(tmp_path / "surface" / "fused.ply"))

    assert counts["fusion_blocks"] == 3
    assert len(parts) == pytest.approx(len(whole), rel=0.05)
    assert np.mean(cKDTree(whole).query(parts)[0] < 1e-6) > 0.8
    assert np.percentile(cKDTree(parts).query(whole)[0], 99) < 0.02
    assert not (tmp_path / "surface" / fusion.FUSING).exists()


def make_with_map(dense, workers=2, *, normal_map=True, **options):
    tables = {"mesh": {"max_image_size_px": 0} | options, "texture": {"normal_map": normal_map}}
    run = RunContext(
        Settings.from_mapping(tables), Workspace(dense.parent), load_plugins(), make_executor(workers), workers
    )
    mesh.make(SimpleNamespace(model_dir=dense / "sparse"), dense, run)
    return run.workspace


@pytest.mark.parametrize("block_points", [4_000_000, FEW_BLOCKS])
def test_the_fine_surface_is_kept_for_a_normal_map_and_changes_nothing_else(dense, ball, tmp_path, block_points):
    place, options = copied(dense, tmp_path), {"faces": 500, "block_points": block_points}
    light = (make_with_map(place, normal_map=False, **options).surface / SURFACE).read_bytes()
    assert not Workspace(tmp_path).fine_surface.exists()

    kept = make_with_map(place, **options)
    fine = kept.fine_surface.read_bytes()

    assert (kept.surface / SURFACE).read_bytes() == light
    stored = np.load(kept.fine_surface)
    vertices, faces = stored["vertices"].astype(float), stored["faces"].astype(int)
    assert np.percentile(np.abs(np.linalg.norm(vertices, axis=1) - 1), 95) < 0.01
    assert len(faces) > 3 * 500 and set(faces.ravel()) == set(range(len(vertices)))
    assert areas(vertices, faces).sum() == pytest.approx(4 * np.pi, rel=0.02)  # blocks neither overlap nor gape
    corners = vertices[faces]
    outward = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.mean(np.sum(outward * corners.mean(axis=1), axis=1) > 0) > 0.999

    whole = hash_surface(kept)
    kept.fine_surface.write_bytes(fine[:-1])
    assert hash_surface(kept) != whole
