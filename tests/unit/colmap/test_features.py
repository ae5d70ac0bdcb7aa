"""SIFT features and matches: of masked and enlarged photos, in chunks, and in processes of their own."""

import shutil
import sqlite3
from contextlib import closing

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial import cKDTree

from sfm_app.colmap.database import create_database, digest_matches, open_database, read_match_graph, unmatched_pairs
from sfm_app.colmap.features import (
    FEATURES,
    MATCHES,
    SiftInputs,
    SiftSettings,
    enter_rows,
    exhaustive_pairs,
    find_in_chunk,
    find_sift,
    match_chunk,
    match_chunk_apart,
    photos_without_features,
    write_inputs,
)
from sfm_app.colmap.worker_process import ProcessGroup
from sfm_app.errors import BackendError
from sfm_app.matching.features import chunks
from sfm_app.progress import Progress
from sfm_app.settings import MatchSettings
from sfm_app.types import Photo, PhotoSet


class Counted(Progress):
    def __init__(self):
        self.steps = 0

    def advance(self, steps=1):
        self.steps += steps


OPTIONS = MatchSettings(max_features=200)
BLOCK = 50
"""Photos of a block in COLMAP's exhaustive matching."""
COUNT = BLOCK + 3


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A database of small photos that overlap, with features and matches by COLMAP's own exhaustive matching."""
    place = tmp_path_factory.mktemp("sift")
    (place / "photos").mkdir()
    rng = np.random.default_rng(0)
    wall = Image.fromarray(rng.integers(0, 255, (20, 40, 3), np.uint8)).resize((320, 160), Image.Resampling.BICUBIC)
    photos = []
    for number in range(COUNT):
        photos.append(Photo(f"{number:02d}.png", 96, 96, "g"))
        left, top = int(rng.integers(0, 224)), int(rng.integers(0, 64))
        wall.crop((left, top, left + 96, top + 96)).save(place / "photos" / photos[-1].name)
    create_database(place / "empty.db", PhotoSet(place / "photos", tuple(photos), (), None))
    shutil.copyfile(place / "empty.db", place / "whole.db")
    settings = SiftSettings(place / "photos", None, OPTIONS)
    find_sift(place / "whole.db", settings, [photo.name for photo in photos], 1, Progress())
    matching = pycolmap.FeatureMatchingOptions()
    matching.skip_geometric_verification, matching.num_threads = True, 1
    pycolmap.match_exhaustive(place / "whole.db", matching_options=matching, device=pycolmap.Device.cpu)
    return place


def inputs_of(place, database, folder):
    inputs = SiftInputs(SiftSettings(place / "photos", None, OPTIONS), folder)
    write_inputs(database, inputs)
    return inputs


@pytest.mark.slow
def test_chunks_give_what_colmap_gives_for_all_at_once(made, tmp_path):
    database = tmp_path / "parts.db"
    shutil.copyfile(made / "empty.db", database)
    names = photos_without_features(database)
    assert sorted(names) == list(range(1, COUNT + 1))

    inputs = inputs_of(made, database, tmp_path / "features")
    for chunk in reversed(chunks(list(names.values()), 20, 1)):
        found = find_in_chunk(inputs, chunk)
        enter_rows(database, found.path, FEATURES)
        assert found.count == len(chunk) and not found.path.exists()
    assert photos_without_features(database) == {}

    inputs, pairs = inputs_of(made, database, tmp_path / "matches"), exhaustive_pairs(sorted(names))
    assert any(a > b for a, b in pairs)
    for chunk in chunks(pairs, 700, 1):
        enter_rows(database, match_chunk(inputs, chunk).path, MATCHES)
    assert unmatched_pairs(database, pairs) == []
    with open_database(database) as reader:
        assert reader.num_matches() > 1000
    assert digest_matches(database) == digest_matches(made / "whole.db")


@pytest.mark.slow
def test_a_process_of_its_own_matches_the_same(made, tmp_path):
    inputs, pairs = inputs_of(made, made / "whole.db", tmp_path / "matches"), [(1, 2), (4, 1), (3, 5)]
    counted = Counted()
    here, apart = match_chunk(inputs, pairs), match_chunk_apart(inputs, ProcessGroup(), counted, pairs)
    assert (here.count, apart.count) == (3, 0)
    assert rows_of(here.path) == rows_of(apart.path) and len(rows_of(apart.path)) == 3
    assert counted.steps == 3


def test_a_process_that_is_stopped_leaves_nothing(made, tmp_path):
    inputs, group = inputs_of(made, made / "whole.db", tmp_path / "matches"), ProcessGroup()
    before = sorted(path.name for path in inputs.folder.iterdir())
    group.stop()
    with pytest.raises(BackendError, match="killed"):
        match_chunk_apart(inputs, group, Progress(), [(1, 2)])
    assert sorted(path.name for path in inputs.folder.iterdir()) == before


def rows_of(part):
    with closing(sqlite3.connect(part)) as connection:
        return connection.execute("SELECT pair_id, rows, cols, data FROM matches ORDER BY pair_id").fetchall()


@pytest.mark.parametrize("count", [0, 1, 5, BLOCK, 2 * BLOCK + 7])
def test_every_pair_is_listed_once(count):
    pairs = exhaustive_pairs(range(1, count + 1))
    assert len({(min(pair), max(pair)) for pair in pairs}) == len(pairs) == count * (count - 1) // 2


def test_chunks_keep_all_workers_busy():
    assert [len(part) for part in chunks(range(11), 8, 2)] == [6, 5]
    assert [len(part) for part in chunks(range(100), 8, 2)] == [8] * 12 + [4]
    assert [len(part) for part in chunks(range(90), 40, 2)] == [23, 23, 23, 21] and chunks([], 8, 2) == []


SIZE = 320, 240
RICH, POOR, EMPTY, DARK, HAZY = NAMES = "rich.png", "sub/poor.png", "empty.png", "dark.png", "hazy.png"


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
    faint = np.uint8(grain(6) // 20)
    pictures = {RICH: grain(6), POOR: poor, EMPTY: np.full_like(poor, 90), DARK: faint, HAZY: faint + np.uint8(190)}
    for name, pixels in pictures.items():
        Image.fromarray(pixels).save(folder / name)
    return folder


def find(place, database, **options):
    """Keypoints (N, 2) of each photo, by name."""
    photos = PhotoSet(place, tuple(Photo(name, *SIZE, "g") for name in NAMES))
    if not database.exists():
        create_database(database, photos)
    find_sift(database, SiftSettings(place, None, MatchSettings(**options)), NAMES, 1, Progress())
    graph = read_match_graph(database, photos)
    return {graph.images[key].name: at for key, at in graph.keypoints.items()}


@pytest.mark.slow
def test_only_photos_that_show_little_are_enlarged(place, tmp_path):
    own = find(place, tmp_path / "own.db", enlarge_below=0)
    enlarged = find(place, tmp_path / "enlarged.db", enlarge_below=100_000)
    between = (len(own[POOR]) + len(own[RICH])) // 2
    found = find(place, tmp_path / "between.db", enlarge_below=between)
    assert 20 < len(own[POOR]) < 0.5 * len(own[RICH]) and len(enlarged[POOR]) > len(own[POOR])
    assert len(enlarged[RICH]) > len(own[RICH])
    np.testing.assert_array_equal(found[RICH], own[RICH])
    np.testing.assert_array_equal(found[POOR], enlarged[POOR])
    assert not len(found[EMPTY])


@pytest.mark.slow
@pytest.mark.parametrize("name", [DARK, HAZY])
def test_faint_photos_have_the_features_of_clear_ones(place, tmp_path, name):
    found = find(place, tmp_path / "found.db", enlarge_below=100_000)
    assert len(find(place, tmp_path / "own.db", enlarge_below=0)[name]) < 0.2 * len(found[RICH])
    distances, _ = cKDTree(found[name]).query(found[RICH])
    assert len(found[name]) < 2 * len(found[RICH]) and np.mean(distances < 1.0) > 0.7


@pytest.mark.slow
def test_what_a_killed_run_has_found_stays(place, tmp_path):
    """Photos with keypoints are not searched again, also with other options."""
    database = tmp_path / "kept.db"
    first = find(place, database, enlarge_below=0)
    again = find(place, database, enlarge_below=100_000)
    assert first.keys() == again.keys() == set(NAMES)
    for name, keypoints in first.items():
        np.testing.assert_array_equal(again[name], keypoints)
