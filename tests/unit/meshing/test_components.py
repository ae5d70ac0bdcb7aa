"""Which parts of a surface stay."""

import numpy as np
import pytest

from sfm_app.geometry.triangles import select_faces
from sfm_app.meshing import drop_islands


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
