"""The database and the model of an earlier run, continued with other photos."""

import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import (
    create_database,
    digest_matches,
    open_database,
    photo_names,
    read_features,
    unmatched_pairs,
)
from sfm_app.colmap.growth import forget_changed_matches, grow_database, model_in_database
from sfm_app.colmap.model import posed_photo_ids
from sfm_app.types import Photo, PhotoSet
from sfm_app.types.camera import EQUIRECTANGULAR


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
        assert cameras[1] == cameras[2] != cameras[3] == cameras[4]
        assert database.num_cameras() == 2


def test_photos_that_left_are_forgotten_with_their_pairs(earlier, tmp_path):
    path = tmp_path / "database.db"

    grow_database(path, earlier, photo_set(tmp_path, b="one", d="two", e="two"), {"b.jpg", "d.jpg"})

    keypoints, matches = read_features(path)
    assert photo_names(path) == {1: "b.jpg", 3: "d.jpg", 4: "e.jpg"}
    assert keypoints.keys() == {1, 3} and matches.keys() == {(1, 3)}


def test_a_replaced_photo_gets_an_id_that_no_photo_had(earlier, tmp_path):
    path = tmp_path / "database.db"

    grow_database(path, earlier, photo_set(tmp_path, b="one", c="one", d="two"), {"b.jpg", "c.jpg"})

    assert photo_names(path) == {1: "b.jpg", 2: "c.jpg", 4: "d.jpg"}
    assert read_features(path)[1].keys() == {(1, 2)}


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

    assert forget_changed_matches(path, earlier) == {"d.jpg"}
    assert read_features(path)[1].keys() == {(1, 2)}


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
    assert used and max(used) < 10
    assert part.num_points3D() <= model.num_points3D()
