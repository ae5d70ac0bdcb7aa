import collections
import contextlib
import sqlite3

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import (
    SQUARE_PIXELS,
    TWO_FOCALS,
    camera_model,
    create_database,
    open_database,
    read_match_graph,
    write_calibrations,
    write_match_graph,
    write_pose_graph,
)
from sfm_app.colmap.model import model_from_seed
from sfm_app.geometry.epipolar import TwoViewSeed
from sfm_app.types import Calibration, Intrinsics, Photo, PhotoSet, PoseGraph, RelativePose

NAMES = ("b.png", "a.png", "c.png")


@pytest.fixture
def stored(tmp_path):
    """Three photos of two cameras with keypoints and one matched pair."""
    rng = np.random.default_rng(0)
    groups = {"b.png": "one", "a.png": "one", "c.png": "two"}
    sizes = {"one": (120, 90), "two": (100, 100)}
    for name in NAMES:
        Image.new("RGB", sizes[groups[name]]).save(tmp_path / name)
    photos = PhotoSet(tmp_path, tuple(Photo(name, *sizes[groups[name]], groups[name]) for name in NAMES))
    path = tmp_path / "database.db"
    create_database(path, photos)
    keypoints = rng.uniform(0, 90, (20, 2)).astype(np.float32)
    matches = np.column_stack([np.arange(12), np.arange(12)[::-1]]).astype(np.uint32)
    with open_database(path) as database:
        for image_id in (1, 2, 3):
            database.write_keypoints(image_id, keypoints)
        database.write_matches(1, 2, matches)
    return path, photos, keypoints, matches


def test_photos_are_numbered_by_name_and_share_cameras_by_group(stored):
    path, photos, keypoints, _ = stored

    graph = read_match_graph(path, photos)

    assert [image.name for image in graph.images.values()] == ["a.png", "b.png", "c.png"]
    assert [image.group for image in graph.images.values()] == ["one", "one", "two"]
    assert list(graph.matches) == [(1, 2)]
    x1, x2 = graph.points((1, 2))
    assert np.allclose(x1, keypoints[:12]) and np.allclose(x2, keypoints[:12][::-1])
    with open_database(path) as database:
        cameras = [database.read_image(image_id).camera_id for image_id in (1, 2, 3)]
    assert cameras[0] == cameras[1] != cameras[2]


def test_a_match_graph_makes_a_database_that_reads_the_same(stored, tmp_path):
    path, photos, _, _ = stored
    graph, copy = read_match_graph(path, photos), tmp_path / "folder" / "copy.db"

    for _ in range(2):  # what was there before goes
        write_match_graph(copy, graph)

    again = read_match_graph(copy, photos)
    assert again.images == graph.images
    for photo, keypoints in graph.keypoints.items():
        np.testing.assert_array_equal(again.keypoints[photo], keypoints)
    np.testing.assert_array_equal(again.matches[1, 2], graph.matches[1, 2])
    for database in (path, copy):
        write_calibrations(database, graph, Intrinsics({"one": calibration(), "two": TWO}))
    assert {table: rows for table, rows in rows_of(copy).items() if table != "keypoints"} == {
        table: rows for table, rows in rows_of(path).items() if table != "keypoints"
    }


KINDS = {"calibrated": "CALIBRATED", "uncalibrated": "UNCALIBRATED", "planar": "PLANAR", "rotation": "PANORAMIC"}


@pytest.mark.parametrize("kind", KINDS)
def test_relative_poses_replace_the_two_view_geometries(stored, kind):
    path, photos, _, matches = stored
    graph = read_match_graph(path, photos)
    still = RelativePose(np.eye(3), np.eye(3)[0], np.ones(12, bool), 5.0, 1.0, "calibrated")
    write_pose_graph(path, graph, PoseGraph({(1, 2): still}, {}, ()))
    R, t = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix(), np.array([0.6, 0.0, -0.8])
    inliers = np.arange(12) % 2 == 0
    pose = RelativePose(R, t, inliers, 9.0, 1.0, kind)

    write_pose_graph(path, graph, PoseGraph({(1, 2): pose}, {(1, 3): "contradicts other pairs"}, ()))

    with open_database(path) as database:
        geometry = database.read_two_view_geometry(1, 2)
        assert database.num_verified_image_pairs() == 1
    assert geometry.config == getattr(pycolmap.TwoViewGeometryConfiguration, KINDS[kind]).value
    np.testing.assert_allclose(geometry.cam2_from_cam1.matrix(), np.column_stack([R, t]), atol=1e-12)
    X = np.random.default_rng(0).uniform([-1, -1, 4], [1, 1, 6], (5, 3))
    np.testing.assert_allclose(np.einsum("ni,ij,nj->n", X @ R.T + t, geometry.E, X), 0, atol=1e-12)
    assert np.array_equal(geometry.inlier_matches, matches[inliers])

    write_pose_graph(path, graph, PoseGraph({}, {}, ()))
    with open_database(path) as database:
        assert database.num_verified_image_pairs() == 0


def calibration(f=130.0, aspect=1.0, **others):
    K = np.array([[f, 0, 66], [0, f * aspect, 41], [0, 0, 1]])
    return Calibration(K, 120, 90, "zero-curves", **{"identifiable": True, **others})


TWO = Calibration(np.array([[120.0, 0, 50], [0, 90, 50], [0, 0, 1]]), 100, 100, "guess", False, "no pairs")


def cameras_of(path):
    """What COLMAP reads: the camera of each photo, and what the database holds besides."""
    with open_database(path) as database:
        used = [database.read_image(image_id).camera_id for image_id in (1, 2, 3)]
        return [database.read_camera(camera_id) for camera_id in used]


def rows_of(path):
    """Everything in the database by table, but for the numbers it would give out next."""
    with contextlib.closing(sqlite3.connect(path)) as database:
        found = collections.defaultdict(list)
        for line in database.iterdump():
            if line.startswith("INSERT INTO "):
                found[line.split('"')[1]].append(line)
        return {table: rows for table, rows in found.items() if table != "sqlite_sequence"}


def test_only_a_k_that_is_known_counts_as_prior_knowledge(stored):
    path, photos, _, _ = stored

    write_calibrations(path, read_match_graph(path, photos), Intrinsics({"one": calibration(), "two": TWO}))

    one, same, two = cameras_of(path)
    assert (one.model.name, list(one.params), one.has_prior_focal_length) == (SQUARE_PIXELS, [130, 66, 41, 0], True)
    assert one.camera_id == same.camera_id
    assert (two.model.name, two.has_prior_focal_length) == (TWO_FOCALS, False)
    assert list(two.params) == [120, 90, 50, 50, 0, 0, 0, 0]


@pytest.mark.parametrize(
    ("found", "model"),
    [
        (calibration(aspect=1.02, held=("aspect",)), SQUARE_PIXELS),
        (calibration(aspect=1.004), SQUARE_PIXELS),
        (calibration(aspect=1.006, held=("center",)), TWO_FOCALS),
        (calibration(aspect=1 / 1.006), TWO_FOCALS),
    ],
)
def test_pixels_are_square_where_the_photos_ask_for_nothing_else(found, model):
    assert camera_model(found) == model


@pytest.mark.parametrize(("aspect", "place"), [(1.0, 3), (0.75, 4)])
def test_the_lens_is_handed_on(stored, aspect, place):
    path, photos, _, _ = stored
    found = calibration(aspect=aspect, radial=-0.2)

    write_calibrations(path, read_match_graph(path, photos), Intrinsics({"one": found, "two": TWO}))

    camera = cameras_of(path)[0]
    assert camera.params[place] == -0.2 and not np.any(camera.params[place + 1 :])
    assert camera.mean_focal_length() == pytest.approx(np.mean([130, 130 * aspect]))


def test_a_group_can_be_of_several_cameras_and_of_one_again(stored, tmp_path):
    path, photos, _, _ = stored
    graph = read_match_graph(path, photos)
    whole = Intrinsics({"one": calibration(), "two": TWO})
    split = Intrinsics(
        {"two": TWO, "one #2": calibration(99.0), "one": calibration()}, {"a.png": "one", "b.png": "one #2"}
    )
    write_calibrations(path, graph, whole)
    before = rows_of(path)

    write_calibrations(path, graph, split)
    focals = [camera.params[0] for camera in cameras_of(path)]
    apart = rows_of(path)
    write_calibrations(path, graph, split)

    assert focals == [130, 99, 120]
    assert [camera.camera_id for camera in cameras_of(path)] == [1, 2, 3]  # by first photo, whatever the order of names
    assert rows_of(path) == apart
    assert len(apart["cameras"]) == len(apart["rigs"]) == len(apart["frames"]) == 3
    write_calibrations(path, graph, whole)
    assert rows_of(path) == before
    assert len(before["cameras"]) == len(before["rigs"]) == 2 and len(before["frames"]) == 3


def test_cameras_are_those_of_a_fresh_database(stored):
    path, photos, _, _ = stored
    fresh = rows_of(path)

    write_calibrations(path, read_match_graph(path, photos), Intrinsics({"two": TWO, "one": calibration()}))

    found = rows_of(path)
    assert set(found) == set(fresh)
    assert [table for table in found if found[table] != fresh[table]] == ["cameras"]


def test_a_seed_of_photos_of_two_cameras_becomes_a_model(stored):
    path, photos, _, matches = stored
    graph = read_match_graph(path, photos)
    cameras = {"one": calibration(), "one #2": calibration(99.0), "two": TWO}
    write_calibrations(path, graph, Intrinsics(cameras, {"b.png": "one #2"}))
    pose = RelativePose(np.eye(3), np.array([-1.0, 0, 0]), np.ones(12, bool), 10.0, 1.0, "calibrated")
    write_pose_graph(path, graph, PoseGraph({(1, 2): pose}, {}, ()))
    X = np.random.default_rng(1).uniform([-1, -1, 4], [1, 1, 6], (12, 3))
    seed = TwoViewSeed(np.eye(3), np.array([-1.0, 0, 0]), X, np.ones(12, bool), 10.0, 1.0)

    model = model_from_seed(path, (1, 2), matches, seed)

    posed = {image.image_id: image for image in model.images.values() if image.has_pose}
    assert sorted(posed) == [1, 2]
    assert [model.cameras[posed[key].camera_id].params[0] for key in (1, 2)] == [130, 99]
    assert np.allclose(posed[2].cam_from_world().translation, [-1, 0, 0])
    assert model.num_points3D() == 12
