"""SIFT on a few photos or pairs at a time gives the rows of COLMAP's work on all of them."""

import shutil
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from PIL import Image

from sfm_app.colmap.database import create_database, digest_matches, open_database, unmatched_pairs
from sfm_app.colmap.features import (
    FEATURES,
    MATCHES,
    SiftInputs,
    SiftSettings,
    enter_rows,
    exhaustive_pairs,
    find_and_match,
    find_in_chunk,
    match_chunk,
    match_chunk_apart,
    photos_without_features,
    write_snapshot,
)
from sfm_app.colmap.worker_process import ProcessGroup
from sfm_app.errors import BackendError
from sfm_app.matching.features import chunks
from sfm_app.progress import SilentProgress
from sfm_app.settings import MatchSettings
from sfm_app.types import Photo, PhotoSet


class Counted(SilentProgress):
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
    find_and_match(place / "whole.db", settings, [photo.name for photo in photos], 1, SilentProgress())
    return place


def inputs_of(place, database, folder):
    folder.mkdir()
    settings = SiftSettings(place / "photos", None, OPTIONS)
    inputs = SiftInputs(folder / "photos.db", folder / "features.db", settings, folder)
    write_snapshot(database, inputs.snapshot, (*FEATURES, *MATCHES))
    write_snapshot(database, inputs.features, MATCHES)
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
        assert found.count == len(chunk)
        assert not found.path.exists()
    assert photos_without_features(database) == {}

    inputs, pairs = inputs_of(made, database, tmp_path / "matches"), exhaustive_pairs(sorted(names))
    assert any(a > b for a, b in pairs)
    for chunk in chunks(pairs, 700, 1):
        enter_rows(database, match_chunk(inputs, chunk).path, MATCHES)
    assert unmatched_pairs(database, [(min(pair), max(pair)) for pair in pairs]) == []
    with open_database(database) as reader:
        assert reader.num_matches() > 1000
    assert digest_matches(database) == digest_matches(made / "whole.db")


def test_a_process_of_its_own_matches_the_same(made, tmp_path):
    inputs, pairs = inputs_of(made, made / "whole.db", tmp_path / "matches"), [(1, 2), (4, 1), (3, 5)]
    counted = Counted()

    here, apart = match_chunk(inputs, pairs), match_chunk_apart(inputs, ProcessGroup(), counted, pairs)

    assert (here.count, apart.count) == (3, 0)
    assert here.in_force == apart.in_force
    assert rows_of(here.path) == rows_of(apart.path)
    assert len(rows_of(apart.path)) == 3
    assert counted.steps == 3


def test_a_process_that_is_stopped_leaves_nothing(made, tmp_path):
    inputs, group = inputs_of(made, made / "whole.db", tmp_path / "matches"), ProcessGroup()
    before = sorted(path.name for path in inputs.folder.iterdir())
    group.stop()

    with pytest.raises(BackendError, match="killed"):
        match_chunk_apart(inputs, group, SilentProgress(), [(1, 2)])

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
    assert [len(part) for part in chunks(range(90), 40, 2)] == [23, 23, 23, 21]
    assert chunks([], 8, 2) == []
