"""The database: photos, calibrations and relative poses; and that of an earlier run, continued with other photos."""

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
    camera_model,
    create_database,
    digest_matches,
    open_database,
    photo_names,
    read_features,
    read_match_graph,
    unmatched_pairs,
    write_calibrations,
    write_match_graph,
    write_pose_graph,
)
from sfm_app.colmap.growth import forget_changed_matches, grow_database, model_in_database
from sfm_app.colmap.model import model_from_seed, posed_photo_ids
from sfm_app.geometry.epipolar import TwoViewSeed
from sfm_app.types import Calibration, Intrinsics, Photo, PhotoSet, PoseGraph, RelativePose
from sfm_app.types.camera import EQUIRECTANGULAR

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
    assert (two.model.name, two.has_prior_focal_length) == ("OPENCV", False)
    assert list(two.params) == [120, 90, 50, 50, 0, 0, 0, 0]


@pytest.mark.parametrize(
    ("found", "model"),
    [
        (calibration(aspect=1.02, held=("aspect",)), SQUARE_PIXELS),
        (calibration(aspect=1.004), SQUARE_PIXELS),
        (calibration(aspect=1.006, held=("center",)), "OPENCV"),
        (calibration(aspect=1 / 1.006), "OPENCV"),
    ],
)
def test_pixels_are_square_where_the_photos_ask_for_nothing_else(found, model):
    assert camera_model(found) == model


@pytest.mark.parametrize(("aspect", "place"), [(1.0, 3), (0.75, 4)])
def test_the_lens_is_handed_on(stored, aspect, place):
    path, photos, _, _ = stored
    found = calibration(aspect=aspect, distortion=(-0.2,))
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
    assert rows_of(path) == apart and len(apart["cameras"]) == len(apart["rigs"]) == len(apart["frames"]) == 3
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
    assert np.allclose(posed[2].cam_from_world().translation, [-1, 0, 0]) and model.num_points3D() == 12


def photo_set(place, **groups):
    return PhotoSet(place, tuple(Photo(f"{name}.jpg", 100, 80, group) for name, group in groups.items()))


@pytest.fixture
def earlier(tmp_path):
    """The database of three photos of which all pairs are matched."""
    path = tmp_path / "earlier.db"
    create_database(path, photo_set(tmp_path, b="one", c="one", d="two"))
    rng = np.random.default_rng(0)
    with open_database(path) as database:
        for photo in (1, 2, 3):
            database.write_keypoints(photo, rng.uniform(0, 80, (9, 6)).astype(np.float32))
        for pair in ((1, 2), (1, 3)):
            database.write_matches(*pair, np.full((pair[1] + 2, 2), pair[1], np.uint32))
        database.write_matches(2, 3, np.zeros((0, 2), np.uint32))
    return path


def test_known_photos_keep_ids_keypoints_and_matches(earlier, tmp_path):
    path, digest = tmp_path / "database.db", digest_matches(earlier)

    grow_database(path, earlier, photo_set(tmp_path, a="two", b="one", c="one", d="two"), {"b.jpg", "c.jpg", "d.jpg"})

    before, after = read_features(earlier), read_features(path)
    assert photo_names(path) == {1: "b.jpg", 2: "c.jpg", 3: "d.jpg", 4: "a.jpg"}
    assert all(np.array_equal(after[0][photo], before[0][photo]) for photo in (1, 2, 3)) and 4 not in after[0]
    assert after[1].keys() == before[1].keys() == {(1, 2), (1, 3)}
    assert all(np.array_equal(rows, before[1][pair]) for pair, rows in after[1].items())
    assert unmatched_pairs(path, [(1, 3), (2, 3), (3, 4)]) == [(3, 4)]  # also those without any match are known
    assert digest_matches(earlier) == digest
    assert not [file.name for file in tmp_path.iterdir() if file.name.startswith(".") or "wal" in file.name]
    with open_database(path) as database:
        cameras = {photo: database.read_image(photo).camera_id for photo in (1, 2, 3, 4)}
        assert cameras[1] == cameras[2] != cameras[3] == cameras[4] and database.num_cameras() == 2


@pytest.mark.parametrize(
    ("photos", "known", "pair"), [("bde", {1: "b.jpg", 3: "d.jpg"}, (1, 3)), ("bcd", {1: "b.jpg", 2: "c.jpg"}, (1, 2))]
)
def test_photos_that_left_or_are_replaced_are_forgotten_with_their_pairs(earlier, tmp_path, photos, known, pair):
    path, groups = tmp_path / "database.db", {"b": "one", "c": "one", "d": "two", "e": "two"}
    grow_database(path, earlier, photo_set(tmp_path, **{name: groups[name] for name in photos}), set(known.values()))
    keypoints, matches = read_features(path)
    assert photo_names(path) == {**known, 4: f"{photos[-1]}.jpg"}, "a new photo gets an id that no photo had"
    assert keypoints.keys() == known.keys() and matches.keys() == {pair}


def test_new_panoramas_have_their_camera(earlier, tmp_path):
    wide = PhotoSet(
        tmp_path, (*photo_set(tmp_path, b="one").photos, Photo("p.jpg", 200, 100, "p", projection=EQUIRECTANGULAR))
    )
    grow_database(tmp_path / "database.db", earlier, wide, {"b.jpg"})
    with open_database(tmp_path / "database.db") as database:
        image = database.read_image(4)
        assert database.read_camera(image.camera_id).model.name == "EQUIRECTANGULAR"


def test_matches_of_features_that_came_out_otherwise_are_dropped(earlier, tmp_path):
    path = tmp_path / "database.db"
    grow_database(path, earlier, photo_set(tmp_path, b="one", c="one", d="two"), {"b.jpg", "c.jpg", "d.jpg"})
    assert forget_changed_matches(path, earlier) == frozenset()
    with open_database(path) as database:
        moved = np.array(database.read_keypoints(3))
        moved[4, 0] += 0.5
        database.update_keypoints(3, moved)
    assert forget_changed_matches(path, earlier) == {"d.jpg"} and read_features(path)[1].keys() == {(1, 2)}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Five photos of a synthetic scene: the database, the model on disk, and how many keypoints photos have."""
    place = tmp_path_factory.mktemp("grown")
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 1, 5, 50
    with open_database(place / "database.db") as database:
        model = pycolmap.synthesize_dataset(options, database)
        counts = {key: len(database.read_keypoints(key)) for key in model.images}
    camera = model.cameras[1]
    camera.params = [1.01 * value for value in camera.params]  # as refined by the last adjustment
    (place / "sparse").mkdir()
    model.write(place / "sparse")
    return place, model, counts


def test_known_photos_have_their_poses_points_and_refined_camera(made):
    place, model, counts = made
    part = model_in_database(place / "database.db", place / "sparse", {1, 2, 4}, counts)
    assert posed_photo_ids(part) == [1, 2, 4] and len(part.images) == 5
    for photo in (1, 2, 4):
        pose, true = (one.images[photo].cam_from_world().matrix() for one in (part, model))
        assert np.allclose(pose, true, atol=1e-12)
    assert np.allclose(part.cameras[1].params, model.cameras[1].params)
    assert 20 < part.num_points3D() <= model.num_points3D()
    tracks = [{element.image_id for element in point.track.elements} for point in part.points3D.values()]
    assert all(len(track) >= 2 and track <= {1, 2, 4} for track in tracks)


def test_keypoints_that_only_the_earlier_run_had_are_left_out(made):
    place, model, counts = made
    fewer = counts | {1: 10}
    part = model_in_database(place / "database.db", place / "sparse", set(counts), fewer)
    used = {element.point2D_idx for point in part.points3D.values() for element in point.track.elements
            if element.image_id == 1}  # fmt: skip
    assert used and max(used) < 10 and part.num_points3D() <= model.num_points3D()
