"""One set of tests for every registered way to find and match features, ours and any plug-in's."""

import numpy as np
import pytest
from PIL import Image

from sfm_app.api import open_run
from sfm_app.colmap.database import create_database, read_match_graph
from sfm_app.geometry.epipolar import cross_matrix, sampson_distance
from sfm_app.matching.features import fill_database
from sfm_app.photos.masks import save_mask
from sfm_app.plugins import load_plugins
from sfm_app.settings import Settings
from sfm_app.types import Photo, PhotoSet

METHODS = load_plugins().features
RUN_HERE = [name for name, method in METHODS.items() if not method.unavailable()]
PAIRS = [(1, 2), (2, 3)]


@pytest.fixture(scope="module", params=RUN_HERE)
def method(request):
    return METHODS[request.param]


@pytest.fixture(scope="module")
def place(rendered, tmp_path_factory):
    """Three photos of a scene, one of which turns its back on the others, and a white one; the third has a mask."""
    folder, truth = rendered
    root = tmp_path_factory.mktemp("features")
    names = sorted(truth.cameras)[:3]
    (root / "photos").mkdir()
    for name in names:
        (root / "photos" / name).symlink_to(folder / name)
    Image.new("RGB", (480, 320), "white").save(root / "photos" / "white photo.png")
    used = np.ones((320, 480), bool)
    used[:, :240] = False
    for name in (*names, "white photo.png"):
        save_mask(root / "masks", name, used if name == names[2] else np.ones((320, 480), bool))
    photos = PhotoSet(root / "photos", tuple(Photo(name, 480, 320, "g") for name in (*names, "white photo.png")))
    return root, photos, truth


def found(method, place, out, pairs=PAIRS, workers=1, masks=False, **matching):
    root, photos, _ = place
    settings = {
        "workers": workers,
        "matching": {"max_image_size_px": 320, **matching},
        "photos": {"masks": str(root / "masks") if masks else ""},
    }
    out.mkdir(exist_ok=True)
    with open_run(out, Settings.from_mapping(settings), None) as run:
        for name in ("photos", "masks"):
            if not (out / name).exists():
                (out / name).symlink_to(root / name)
        if not run.workspace.database.exists():
            create_database(run.workspace.database, photos)
        fill_database(method, run, pairs)
        return read_match_graph(run.workspace.database, photos)


@pytest.fixture(scope="module")
def graph(method, place, tmp_path_factory):
    return found(method, place, tmp_path_factory.mktemp("plain") / "out")


def test_most_matches_of_neighbors_are_right(place, graph):
    _, _, truth = place
    K = truth.K
    for pair in PAIRS:
        poses = [truth.cam_from_world[graph.images[photo].name] for photo in pair]
        R = poses[1][:, :3] @ poses[0][:, :3].T
        t = poses[1][:, 3] - R @ poses[0][:, 3]
        F = np.linalg.inv(K).T @ cross_matrix(t) @ R @ np.linalg.inv(K)
        distances = sampson_distance(F, *graph.points(pair))
        assert 40 <= len(distances) <= len(graph.keypoints[pair[0]]) and np.mean(distances < 1.5) > 0.7
        assert 0.0 < np.median(distances) < 0.6  # half a pixel aside, and it would be more


def test_only_the_given_pairs_are_matched(graph):
    assert list(graph.matches) == PAIRS


def test_keypoints_lie_in_their_photo_and_are_matched_once(graph):
    for points in graph.keypoints.values():
        assert points.shape[1:] == (2,) and (points >= 0).all() and (points <= (480, 320)).all()
    for (first, second), rows in graph.matches.items():
        for column, photo in zip(rows.T, (first, second), strict=True):
            assert len(np.unique(column)) == len(column) and column.max() < len(graph.keypoints[photo])


def test_a_white_photo_has_nothing(graph):
    white = next(image.id for image in graph.images.values() if image.name == "white photo.png")
    assert len(graph.keypoints[white]) <= 5


def test_nothing_is_found_where_the_mask_is_black(method, place, graph, tmp_path):
    masked = found(method, place, tmp_path / "out", pairs=[], masks=True)
    assert masked.keypoints[3][:, 0].min() >= 240
    right = np.count_nonzero(graph.keypoints[3][:, 0] >= 240)
    assert 0.8 * right <= len(masked.keypoints[3]) <= 1.2 * right
    np.testing.assert_array_equal(masked.keypoints[1], graph.keypoints[1])


def test_the_limits_of_the_settings_hold(method, place, graph, tmp_path):
    few = found(method, place, tmp_path / "few", pairs=[], max_features=100)
    small = found(method, place, tmp_path / "small", pairs=[(1, 2)], max_image_size_px=240)
    for photo in (1, 2):
        assert 50 <= len(few.keypoints[photo]) <= 200  # SIFT counts one with two directions as one
        assert small.keypoints[photo].max() > 250  # in pixels of the photo all the same
    assert len(small.matches.get((1, 2), [])) < len(graph.matches[1, 2])


def test_more_workers_and_a_second_call_give_the_same(method, place, graph, tmp_path):
    other = found(method, place, tmp_path / "out", pairs=PAIRS[:1], workers=3)
    assert list(other.matches) == PAIRS[:1]
    for again in (found(method, place, tmp_path / "out", workers=2), found(method, place, tmp_path / "out")):
        for photo, points in graph.keypoints.items():
            np.testing.assert_array_equal(again.keypoints[photo], points)
        assert list(again.matches) == PAIRS
        for pair in PAIRS:
            np.testing.assert_array_equal(again.matches[pair], graph.matches[pair])
