"""How fine a surface may be, and which parts of it stay."""

import numpy as np
import pytest

from sfm_app.geometry.triangles import select_faces
from sfm_app.meshing import drop_islands, octree_depth
from sfm_app.meshing.components import MARGIN, MIN_POINTS


@pytest.mark.parametrize(("share", "left"), [(0.0, 2), (0.05, 2), (0.15, 1)])
def test_islands_below_the_share_are_dropped(share, left, sheet, together):
    surface = together(sheet(9), sheet(3, origin=(50, 0, 0)))  # 162 and 18 of 180 triangles: 10 %

    found = drop_islands(surface, share)

    assert len(found.faces) == {2: 180, 1: 162}[left]
    assert found.vertices[:, 0].max() == {2: 53, 1: 9}[left]


def test_selection_keeps_corners_and_colors_together(sheet):
    surface = sheet(6)
    keep = np.arange(len(surface.faces)) % 3 == 0

    found = select_faces(surface, keep)

    np.testing.assert_array_equal(found.vertices[found.faces], surface.vertices[surface.faces[keep]])
    np.testing.assert_array_equal(found.colors[found.faces], surface.colors[surface.faces[keep]])
    assert set(found.faces.ravel()) == set(range(len(found.vertices)))
    assert found.faces.dtype == np.int64


def test_octree_cells_hold_a_point_or_so(sheet):
    points = sheet(127).vertices  # 128 x 128

    assert octree_depth(points, 12) in (6, 7)
    assert octree_depth(points * 100 + 7, 12) == octree_depth(points, 12)
    assert octree_depth(np.repeat(points, 4, axis=0), 12) >= octree_depth(points, 12)
    assert octree_depth(points, 5) == 5


@pytest.mark.parametrize("most", [3, 6, 9])
def test_the_octree_is_the_deepest_whose_occupied_cells_hold_enough(most):
    points = np.random.default_rng(most).uniform(-2, 3, (400, 3)) ** 3
    extent = MARGIN * np.ptp(points, axis=0).max()

    def occupied(depth):
        cells = np.floor((points - points.min(axis=0)) * (2**depth / extent))
        return len(np.unique(cells, axis=0))

    fits = [depth for depth in range(2, most + 1) if len(points) >= MIN_POINTS * occupied(depth)]
    assert octree_depth(points, most) == max(fits)
    cells = occupied(max(fits))
    assert octree_depth(points, most, cells) == max(fits)
    assert octree_depth(points, most, cells - 1) == max(fits) - 1


@pytest.mark.parametrize("points", [np.empty((0, 3)), np.ones((1, 3)), np.ones((50, 3))])
def test_points_without_extent_get_the_coarsest_octree(points):
    assert octree_depth(points, 10) == 1
