import numpy as np
import pytest
from PIL import Image

from sfm_app.colmap.database import (
    SQUARE_PIXELS,
    TWO_FOCALS,
    create_database,
    opened,
    read_match_graph,
    write_calibrations,
    write_epipolar_fits,
)
from sfm_app.types import Calibration, EpipolarFit, Photo, PhotoSet

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
    create_database(path, tmp_path, photos)
    keypoints = rng.uniform(0, 90, (20, 2)).astype(np.float32)
    matches = np.column_stack([np.arange(12), np.arange(12)[::-1]]).astype(np.uint32)
    with opened(path) as database:
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
    with opened(path) as database:
        cameras = [database.read_image(image_id).camera_id for image_id in (1, 2, 3)]
    assert cameras[0] == cameras[1] != cameras[2]


def test_fits_replace_the_two_view_geometries(stored):
    path, photos, _, matches = stored
    graph = read_match_graph(path, photos)
    inliers = np.arange(12) < 9

    for F in (np.eye(3), np.diag([1.0, 2, 3])):
        fit = EpipolarFit(F, inliers, np.ones(12), 5, 0.3)
        write_epipolar_fits(path, graph, {(1, 2): fit})

    with opened(path) as database:
        geometry = database.read_two_view_geometry(1, 2)
    assert np.allclose(geometry.F, np.diag([1.0, 2, 3]))
    assert np.array_equal(geometry.inlier_matches, matches[:9])


def test_only_a_k_that_is_known_counts_as_prior_knowledge(stored):
    path, photos, _, _ = stored
    graph = read_match_graph(path, photos)
    square = Calibration(np.array([[130.0, 0, 66], [0, 130, 41], [0, 0, 1]]), 120, 90, "zero-curves", True)
    guess = Calibration(np.array([[120.0, 0, 50], [0, 90, 50], [0, 0, 1]]), 100, 100, "guess", False, "no pairs")

    write_calibrations(path, graph, {"one": square, "two": guess})

    with opened(path) as database:
        one, two = (database.read_camera(database.read_image(image_id).camera_id) for image_id in (1, 3))
    assert (one.model.name, list(one.params), one.has_prior_focal_length) == (SQUARE_PIXELS, [130, 66, 41, 0], True)
    assert (two.model.name, two.has_prior_focal_length) == (TWO_FOCALS, False)
    assert list(two.params) == [120, 90, 50, 50, 0, 0, 0, 0]
