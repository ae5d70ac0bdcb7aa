"""What is cut from a surface, and what stays."""

import numpy as np
import pytest

from sfm_app.meshing import drop_islands, octree_depth, trim_unsupported
from sfm_app.meshing.clean import select_faces
from sfm_app.types import Surface

UP = np.array([0.0, 0.0, 1.0])


def sheet(size: int, step: float = 1.0, origin=(0.0, 0.0, 0.0), flipped: bool = False) -> Surface:
    """A square grid of size x size cells in the plane z = 0, facing +z."""
    y, x = np.mgrid[: size + 1, : size + 1]
    vertices = np.stack([x * step, y * step, np.zeros_like(x)], axis=-1).reshape(-1, 3) + origin
    at = np.arange((size + 1) ** 2).reshape(size + 1, size + 1)
    a, b, c, d = (corner.ravel() for corner in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    colors = np.arange(len(vertices) * 3).reshape(-1, 3) % 256
    return Surface(vertices, faces[:, ::-1] if flipped else faces, colors.astype(np.uint8))


def together(*parts: Surface) -> Surface:
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    return Surface(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)]),
        np.concatenate([part.colors for part in parts]),
    )


def test_surface_beyond_the_points_is_cut_off():
    surface = sheet(60)
    points = surface.vertices[surface.vertices[:, 0] <= 20]

    found = trim_unsupported(surface, points, np.broadcast_to(UP, points.shape))

    reach = found.vertices[:, 0].max() - 20
    assert 3 <= reach <= 12
    assert np.isin(np.arange(21), found.vertices[:, 0]).all()


def test_small_holes_stay_closed():
    surface = sheet(40)
    hole = np.linalg.norm(surface.vertices - [20, 20, 0], axis=1) < 3

    points = surface.vertices[~hole]
    found = trim_unsupported(surface, points, np.broadcast_to(UP, points.shape))

    assert len(found.faces) == len(surface.faces)


def test_the_back_that_nobody_measured_is_cut_off():
    front, back = sheet(20), sheet(20, origin=(0, 0, -1), flipped=True)
    normals = np.broadcast_to(UP, front.vertices.shape)

    found = trim_unsupported(together(front, back), front.vertices, normals)

    np.testing.assert_array_equal(found.vertices, front.vertices)


def test_sparser_background_is_kept_as_well():
    near, far = sheet(30), sheet(10, step=3.0, origin=(100, 0, 0))
    both = together(near, far)

    found = trim_unsupported(both, both.vertices, np.broadcast_to(UP, both.vertices.shape))

    assert len(found.faces) == len(both.faces)


def test_without_points_nothing_is_supported():
    assert len(trim_unsupported(sheet(5), np.empty((0, 3)), np.empty((0, 3))).faces) == 0


@pytest.mark.parametrize(("share", "left"), [(0.0, 2), (0.05, 2), (0.15, 1)])
def test_islands_below_the_share_are_dropped(share, left):
    surface = together(sheet(9), sheet(3, origin=(50, 0, 0)))  # 162 and 18 of 180 triangles: 10 %

    found = drop_islands(surface, share)

    assert len(found.faces) == {2: 180, 1: 162}[left]
    assert found.vertices[:, 0].max() == {2: 53, 1: 9}[left]


def test_selection_keeps_corners_and_colours_together():
    surface = sheet(6)
    keep = np.arange(len(surface.faces)) % 3 == 0

    found = select_faces(surface, keep)

    np.testing.assert_array_equal(found.vertices[found.faces], surface.vertices[surface.faces[keep]])
    np.testing.assert_array_equal(found.colors[found.faces], surface.colors[surface.faces[keep]])
    assert set(found.faces.ravel()) == set(range(len(found.vertices)))
    assert found.faces.dtype == np.int64


def test_octree_cells_match_the_spacing_of_the_points():
    points = sheet(128).vertices

    assert octree_depth(points, 12) in (6, 7)
    assert octree_depth(points * 100, 12) == octree_depth(points, 12)
    assert octree_depth(points, 5) == 5
    assert octree_depth(points[:3], 10) == 10
