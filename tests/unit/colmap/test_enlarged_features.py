"""Photos that show much are searched at their own size; the others are enlarged, too."""

import cv2
import numpy as np
import pytest
from PIL import Image

from sfm_app.colmap.database import create_database, read_match_graph
from sfm_app.colmap.features import SiftSettings, find_and_match
from sfm_app.progress import SilentProgress
from sfm_app.settings import MatchSettings
from sfm_app.types import Photo, PhotoSet

SIZE = 320, 240
RICH, POOR, EMPTY = "rich.png", "sub/poor.png", "empty.png"


def grain(cell_px, seed=0):
    """Spots of about one size."""
    width, height = SIZE
    coarse = np.random.default_rng(seed).integers(0, 255, (height // cell_px, width // cell_px), np.uint8)
    return cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photos")
    (folder / "sub").mkdir()
    poor = np.full(SIZE[::-1], 128, np.uint8)
    poor[:120, :160] = grain(6)[:120, :160]
    for name, pixels in {RICH: grain(6), POOR: poor, EMPTY: np.full_like(poor, 90)}.items():
        Image.fromarray(pixels).save(folder / name)
    return folder


def find(place, database, **options):
    """Keypoints (N, 2) of each photo, by name."""
    photos = PhotoSet(place, tuple(Photo(name, *SIZE, "g") for name in (RICH, POOR, EMPTY)))
    if not database.exists():
        create_database(database, photos)
    find_and_match(
        database, SiftSettings(place, None, MatchSettings(**options)), (RICH, POOR, EMPTY), 1, SilentProgress(), ()
    )
    graph = read_match_graph(database, photos)
    return {graph.images[key].name: at for key, at in graph.keypoints.items()}


def as_set(keypoints):
    return {tuple(row) for row in keypoints.tolist()}


@pytest.mark.slow
def test_only_photos_that_show_little_are_enlarged(place, tmp_path):
    own = find(place, tmp_path / "own.db", enlarge_below=0)
    enlarged = find(place, tmp_path / "enlarged.db", enlarge_below=100_000)
    between = (len(own[POOR]) + len(own[RICH])) // 2
    found = find(place, tmp_path / "between.db", enlarge_below=between)

    assert 20 < len(own[POOR]) < 0.5 * len(own[RICH])
    assert len(enlarged[POOR]) > len(own[POOR])
    assert len(enlarged[RICH]) > len(own[RICH])
    np.testing.assert_array_equal(found[RICH], own[RICH])
    np.testing.assert_array_equal(found[POOR], enlarged[POOR])
    assert not len(found[EMPTY])


@pytest.mark.slow
def test_what_a_killed_run_has_found_stays(place, tmp_path):
    """Photos with keypoints are not searched again, also with other options."""
    database = tmp_path / "kept.db"
    first = find(place, database, enlarge_below=0)
    again = find(place, database, enlarge_below=100_000)
    assert first.keys() == again.keys() == {RICH, POOR, EMPTY}
    for name, keypoints in first.items():
        np.testing.assert_array_equal(again[name], keypoints)


@pytest.mark.slow
def test_a_photo_has_no_more_features_than_asked_for(place, tmp_path):
    own = find(place, tmp_path / "own.db", enlarge_below=0)
    cut = find(place, tmp_path / "cut.db", enlarge_below=0, max_features=100)
    assert len(own[RICH]) > 150
    assert len(cut[RICH]) == 100
    assert {tuple(row) for row in cut[RICH].tolist()} <= {tuple(row) for row in own[RICH].tolist()}
