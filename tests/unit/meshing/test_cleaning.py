"""Meshes are cut, lose islands, and become oriented manifolds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.geometry.triangles import areas, select_faces, unique_edges
from sfm_app.meshing.cleaning import cut, drop_islands, make_manifold
from sfm_app.types import Surface


def total(surface):
    return areas(surface.vertices, surface.faces).sum()


def test_the_border_runs_where_the_support_is_zero(sheet):
    surface = sheet(20)

    found = cut(surface, surface.vertices[:, 0] - 7.3 + 0.2 * surface.vertices[:, 1])

    assert total(found) == pytest.approx(20 * (12.7 + 0.2 * 10), rel=1e-9)
    assert (found.vertices[:, 0] + 0.2 * found.vertices[:, 1]).min() == pytest.approx(7.3)
    corners = found.vertices[found.faces]
    assert np.all(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0)


@pytest.mark.parametrize(("value", "share"), [(1.0, 1.0), (-1.0, 0.0), (0.0, 0.0)])
def test_all_or_nothing_stays(sheet, value, share):
    surface = sheet(5)

    assert total(cut(surface, np.full(len(surface.vertices), value))) == pytest.approx(share * total(surface))


def with_faces(surface, faces, vertices=None):
    points = surface.vertices if vertices is None else np.concatenate([surface.vertices, vertices])
    return Surface(points, np.concatenate([surface.faces, faces]), np.zeros((len(points), 3), np.uint8))


def is_clean(surface):
    faces = surface.faces
    edges, edge_of = unique_edges(faces)
    forward = faces < np.roll(faces, -1, axis=1)
    uses = [np.bincount(edge_of[way], minlength=len(edges)) for way in (forward, ~forward)]
    border = edges[np.sum(uses, axis=0) == 1]
    ends = np.bincount(border.ravel(), minlength=len(surface.vertices))
    fans = np.bincount(faces.ravel(), minlength=len(surface.vertices)) - np.bincount(
        edges[np.sum(uses, axis=0) == 2].ravel(), minlength=len(surface.vertices)
    )
    return (
        np.isfinite(surface.vertices).all()
        and np.max(uses) <= 1
        and np.array_equal(fans, ends // 2)  # triangles less inner edges: 1 for an open fan, 0 for a closed one
        and ends.max(initial=0) <= 2
        and len(np.unique(np.sort(faces, axis=1), axis=0)) == len(faces)
        and len(np.unique(faces)) == len(surface.vertices) == len(surface.colors)
        and areas(surface.vertices, faces).min() > 0
    )


def test_a_clean_surface_stays_as_it_is(sheet):
    surface = sheet(8)

    found = make_manifold(surface)

    assert is_clean(found)
    np.testing.assert_array_equal(found.vertices[found.faces], surface.vertices[surface.faces])
    np.testing.assert_array_equal(found.colors[found.faces], surface.colors[surface.faces])


@pytest.mark.parametrize(
    ("faces", "vertices"),
    [
        ([[0, 0, 1]], None),  # a point twice
        ([[0, 1, 2]], None),  # on one line
        ([[10, 9, 0]], None),  # the first triangle again, turned round
        ([[0, 10, 81]], [[0.2, 0.2, 0.1]]),  # a third and smaller triangle at an edge
        ([[0, 1, 81]], [[np.nan, 0, 0]]),
    ],
)
def test_what_does_not_belong_goes(faces, vertices, sheet):
    surface = sheet(8)

    found = make_manifold(with_faces(surface, faces, vertices))

    assert is_clean(found)
    assert len(surface.faces) - 1 <= len(found.faces) <= len(surface.faces)


def test_fans_that_touch_are_split(sheet, together):
    surface = together(sheet(2), sheet(2, origin=(2, 2, 0)))
    surface.faces[surface.faces == 9] = 8  # the corner of the second is that of the first

    found = make_manifold(surface)

    assert is_clean(found)
    assert len(found.faces) == len(surface.faces)
    assert len(found.vertices) == 18


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_any_soup_becomes_a_manifold(seed):
    rng = np.random.default_rng(seed)
    count = int(rng.integers(4, 12))
    faces = rng.integers(0, count, (int(rng.integers(1, 40)), 3))
    soup = Surface(rng.normal(size=(count, 3)), faces, rng.integers(0, 255, (count, 3)).astype(np.uint8))

    found = make_manifold(soup)

    assert not len(found.faces) or is_clean(found)
    assert len(found.faces) or not np.any(areas(soup.vertices, faces) > 1e-3)


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
