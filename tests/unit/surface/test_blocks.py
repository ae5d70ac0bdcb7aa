"""Fused points sorted by blocks, in files."""

import numpy as np
import pytest

from sfm_app.colmap.surface import positions
from sfm_app.meshing.blocks import split_points
from sfm_app.surface.blocks import POINTS, sort_points


@pytest.fixture
def records():
    rng = np.random.default_rng(3)
    found = np.zeros(5000, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1")])
    for name, size in zip("xyz", (30, 20, 2), strict=True):
        found[name] = size * rng.normal(size=len(found))
    found["red"] = rng.integers(0, 256, len(found))
    return found


@pytest.mark.parametrize("at_once", [700, 5000])
def test_every_point_is_in_one_file_and_in_the_bounds_of_its_block(records, at_once, tmp_path):
    partition = split_points(positions(records), 7)

    found = sort_points(records, partition, tmp_path, at_once)

    numbers = partition.find_blocks(positions(records))
    for number in range(7):
        own = found.read(number)
        np.testing.assert_array_equal(own, records[numbers == number])
        np.testing.assert_array_equal(found.bounds[number, 0], positions(own).min(axis=0))
        np.testing.assert_array_equal(found.bounds[number, 1], positions(own).max(axis=0))


def test_a_box_holds_the_points_of_all_blocks_that_it_meets(records, tmp_path):
    found = sort_points(records, split_points(positions(records), 7), tmp_path)
    for seed in range(20):
        corners = np.random.default_rng(seed).uniform(-1, 1, (2, 3)) * [60, 40, 4]
        box = np.stack([corners.min(axis=0), corners.max(axis=0)])
        inside = ((positions(records) >= box[0]) & (positions(records) <= box[1])).all(axis=1)

        got = found.read_box(box)

        np.testing.assert_array_equal(np.sort(got, order=("x", "y", "z")),
                                      np.sort(records[inside], order=("x", "y", "z")))  # fmt: skip


def test_a_killed_run_begins_the_files_again_but_keeps_finished_ones(records, tmp_path):
    partition = split_points(positions(records), 3)
    (tmp_path / f"{POINTS}-unfinished").mkdir()
    (tmp_path / f"{POINTS}-unfinished" / "0").write_bytes(b"half a record")
    first = sort_points(records, partition, tmp_path)

    again = sort_points(records[:0], partition, tmp_path)

    assert sum(len(first.read(number)) for number in range(3)) == len(records)
    np.testing.assert_array_equal(again.bounds, first.bounds)


def test_a_block_without_points_has_an_empty_file(records, tmp_path):
    partition = split_points(positions(records), 4)
    few = records[partition.find_blocks(positions(records)) != 2]

    found = sort_points(few, partition, tmp_path)

    assert len(found.read(2)) == 0
    assert len(found.read_box(np.array([[-1e9] * 3, [1e9] * 3]))) == len(few)
