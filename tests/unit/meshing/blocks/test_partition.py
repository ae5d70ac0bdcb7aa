"""Blocks of points, and the cubes on their common grid."""

import numpy as np
import pytest

from sfm_app.meshing.blocks.partition import ALIGNMENT, cube_around, occupied_cells, split_points


@pytest.mark.parametrize("blocks", [1, 2, 3, 7, 16])
def test_every_point_is_in_one_block_and_blocks_are_as_large(blocks):
    points = np.random.default_rng(blocks).normal(size=(20_000, 3)) * [30, 20, 2]

    partition = split_points(points, blocks)

    numbers = partition.find_blocks(points)
    low, high = np.moveaxis(partition.boxes[numbers], 1, 0)
    sizes = np.bincount(numbers, minlength=blocks)
    assert len(partition.boxes) == len(sizes) == blocks
    assert ((points >= low) & (points < high)).all()
    assert 0.8 < sizes.min() * blocks / len(points) <= 1.0
    assert sizes.max() * blocks / len(points) < 1.2


def test_blocks_are_cut_across_their_longest_side():
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3)) * [50, 20, 1]

    partition = split_points(points, 4)

    assert np.isinf(partition.boxes[:, :, 2]).all()


def test_cubes_hold_their_points_on_a_common_grid():
    rng = np.random.default_rng(1)
    for _ in range(50):
        low = rng.uniform(-100, 100, 3)
        high = low + rng.uniform(1, 30, 3)
        cube = cube_around(low, high, 0.05)
        side = 1.1 * (cube.anchors[1] - cube.anchors[0])
        start = cube.anchors.mean(axis=0) - side / 2

        assert (cube.anchors[0] <= low).all()
        assert (cube.anchors[1] >= high).all()
        np.testing.assert_allclose(side, 0.05 * 2**cube.depth)
        np.testing.assert_allclose(start / (ALIGNMENT * 0.05), np.round(start / (ALIGNMENT * 0.05)), atol=1e-6)
        assert side[0] < 4.5 * max(30 * 0.05, (high - low).max() + 2 * ALIGNMENT * 0.05)


def test_cells_are_counted_once():
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.9, 0.3], [-0.1, 0.1, 0.1], [5.5, 0.0, 0.0]])

    assert occupied_cells(points, 1.0) == 3
