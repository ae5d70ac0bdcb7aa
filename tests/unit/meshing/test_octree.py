"""How fine Poisson's cells are, and the cubes on their common grid."""

import numpy as np
import pytest

from sfm_app.meshing.octree import (
    ALIGNMENT,
    MARGIN,
    MIN_POINTS,
    cell_sizes,
    choose_cell,
    cube_around,
    occupied_cells,
)


def sizes_of(points, most=12):
    """Yield sides of cells and mean numbers of points in an occupied one."""
    extent = np.ptp(points, axis=0).max()
    return ((cell, len(points) / occupied_cells(points, cell)) for cell in cell_sizes(extent, most))


@pytest.mark.parametrize("least", [1.4, 2.0, 2.7, 5.6])
@pytest.mark.parametrize("scale", [1.0, 1.3, 7.0])
def test_cells_of_a_plane_hold_as_many_points_as_asked_for(least, scale):
    points = np.random.default_rng(4).uniform(0, 1, (40_000, 3)) * [1, scale, 0]

    cell = choose_cell(sizes_of(points), least)

    assert 0.9 * least < len(points) / occupied_cells(points, cell) < 1.1 * least


def test_cells_grow_with_the_points_by_no_step():
    """A box that grows by a far point does not halve the cells."""
    points = np.random.default_rng(5).uniform(0, 1, (30_000, 3)) * [1, 1, 0]
    sides = [choose_cell(sizes_of(np.vstack([points, [1 + far, 0, 0]])), MIN_POINTS) for far in np.linspace(0, 2, 21)]

    assert max(sides) < 1.1 * min(sides)


@pytest.mark.parametrize("most", [3, 6, 9])
def test_cells_lie_between_two_sizes_of_which_one_holds_enough(most):
    points = np.random.default_rng(most).uniform(-2, 3, (400, 3)) ** 3

    cell = choose_cell(sizes_of(points, most), MIN_POINTS)

    extent = MARGIN * np.ptp(points, axis=0).max()
    fits = [
        depth for depth in range(2, most + 1) if len(points) >= MIN_POINTS * occupied_cells(points, extent / 2**depth)
    ]
    assert extent / 2 ** min(max(fits) + 1, most) <= cell <= extent / 2 ** max(fits)


def test_where_no_cells_hold_enough_they_are_the_coarsest():
    assert choose_cell(iter([(1.0, 1.0), (2.0, 1.1)]), 1.4) == 2.0
    assert choose_cell(iter([(1.0, 1.5), (2.0, 5.0)]), 1.4) == 1.0
    assert choose_cell(iter([(1.0, 1.0), (2.0, 4.0)]), 2.0) == pytest.approx(2**0.5)


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
