"""Blocks of points."""

import numpy as np
import pytest

from sfm_app.meshing.blocks import split_points


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
