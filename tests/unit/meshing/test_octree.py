"""How fine Poisson's cells are, and the cubes on their common grid."""

import numpy as np
import pytest

from sfm_app.meshing.octree import CELLS, cell_sizes, choose_cell, count_bent, count_cells, cube_around, find_size


class Cells:
    """Oriented points, and figures of their cells."""

    def __init__(self, points, normals):
        self.points, self.normals = points, normals
        self.sizes = list(cell_sizes(np.ptp(points, axis=0).max(), 12))

    def choose(self, **least):
        return choose_cell(self.sizes, self.points_per_cell, self.bent_share, **least)

    def points_per_cell(self, cell):
        return len(self.points) / count_cells(self.points, cell)

    def bent_share(self, cell):
        bent, told = count_bent(self.points, self.normals, cell)
        return bent / max(told, 1)


def plane(count=40_000, width=1.0, bump=0.0, seed=4):
    """Points on a plane, and a share of them on rods of a hundredth of its size before it."""
    rng = np.random.default_rng(seed)
    points, normals = rng.uniform(0, 1, (count, 3)) * [1, width, 0], np.tile([0.0, 0.0, 1.0], (count, 1))
    rods, angle = rng.random(count) < bump, rng.uniform(0, 2 * np.pi, count)
    normals[rods] = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=1)[rods]
    points[rods, 0] = np.round(points[rods, 0], 1)
    points[rods] += 0.005 * normals[rods] + [0.0, 0.0, 0.1]
    return Cells(points, normals)


@pytest.mark.parametrize("wanted", [1.4, 5.6])
@pytest.mark.parametrize("width", [1.0, 1.3, 7.0])
def test_cells_of_a_plane_hold_as_many_points_as_wanted(wanted, width):
    cells = plane(width=width)

    cell = find_size(cells.sizes, cells.points_per_cell, wanted)

    assert 0.9 * wanted < cells.points_per_cell(cell) < 1.1 * wanted


def test_cells_do_not_jump_as_a_far_point_enlarges_the_box():
    flat = plane(30_000)
    sides = [
        cells.choose()
        for far in np.linspace(0, 2, 21)
        for cells in [Cells(np.vstack([flat.points, [1 + far, 0, 0]]), np.vstack([flat.normals, [0, 0, 1]]))]
    ]

    assert max(sides) < 1.1 * min(sides)


def test_cells_are_large_on_walls_and_small_where_there_are_rods():
    shares = [0.0, 0.03, 0.06, 0.1, 0.3, 0.6]
    held = []
    for share in shares:
        cells = plane(bump=share)
        held.append(cells.points_per_cell(cells.choose()))

    assert 0.9 * CELLS.most_points < held[0] < 1.1 * CELLS.most_points
    assert 0.9 * CELLS.least_points < held[-1] < 1.1 * CELLS.least_points
    assert any(1.1 * CELLS.least_points < value < 0.9 * CELLS.most_points for value in held)
    assert (np.diff(held) < 0.1).all()


def test_between_the_two_about_as_many_cells_are_bent_as_may_be():
    cells = plane(bump=0.03)
    cell = cells.choose()

    assert CELLS.least_points < cells.points_per_cell(cell) < CELLS.most_points
    assert 0.5 * CELLS.bent_share < cells.bent_share(2 * cell) < 2.0 * CELLS.bent_share


def test_more_points_are_held_where_fewer_triangles_are_wanted():
    cells = plane()

    assert 7.2 < cells.points_per_cell(cells.choose(least=8.0)) < 8.8


def test_where_no_size_holds_enough_it_is_the_coarsest():
    assert find_size([1.0, 2.0], {1.0: 1.0, 2.0: 1.1}.get, 1.4) == 2.0
    assert find_size([1.0, 2.0], {1.0: 1.5, 2.0: 5.0}.get, 1.4) == 1.0
    assert find_size([1.0, 2.0], {1.0: 1.0, 2.0: 4.0}.get, 2.0) == pytest.approx(2**0.5)


def test_cells_are_counted_once_and_bent_ones_among_those_with_two_points():
    points = np.array([[0.1, 0.1, 0.1], [0.2, 0.9, 0.3], [-0.1, 0.1, 0.1], [5.5, 0.0, 0.0], [5.6, 0.1, 0.2]])
    normals = np.array([[0.0, 0, 1], [0, 1, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0]])

    assert count_cells(points, 1.0) == 3
    assert count_bent(points, normals, 1.0) == (1, 2)


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
        np.testing.assert_allclose(
            start / (CELLS.alignment * 0.05), np.round(start / (CELLS.alignment * 0.05)), atol=1e-6
        )
        assert side[0] < 4.5 * max(30 * 0.05, (high - low).max() + 2 * CELLS.alignment * 0.05)
