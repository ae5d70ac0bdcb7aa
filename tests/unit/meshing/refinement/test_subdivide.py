import numpy as np
import pytest

from sfm_app.geometry.triangles import areas, unique_edges, vertex_normals
from sfm_app.meshing.refinement import split_long_edges
from sfm_app.synthetic.shapes import ball
from sfm_app.types import Surface


def closed_ball():
    """A sphere whose vertices are joined, with uneven triangles."""
    shape = ball(1.0, segments=14)
    _, first, one = np.unique(shape.vertices.round(6), axis=0, return_index=True, return_inverse=True)
    faces = one.ravel()[shape.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    colors = np.random.default_rng(0).integers(0, 256, (len(first), 3)).astype(np.uint8)
    return Surface(shape.vertices[first], faces, colors)


@pytest.mark.parametrize("longest", [0.3, 0.2, 0.1])
def test_edges_are_halved_and_the_surface_stays_what_it_is(longest):
    before = closed_ball()
    after = split_long_edges(before, np.full(len(before.vertices), longest))

    assert areas(after.vertices, after.faces).sum() == pytest.approx(areas(before.vertices, before.faces).sum())
    edges, edge_of = unique_edges(after.faces)
    assert (np.bincount(edge_of.ravel()) == 2).all(), "it stays closed"
    directed = np.concatenate([after.faces[:, [0, 1]], after.faces[:, [1, 2]], after.faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed), "all triangles are turned the same way"
    assert (vertex_normals(after.vertices, after.faces) * after.vertices).sum(axis=1).min() > 0.5
    assert np.array_equal(after.vertices[: len(before.vertices)], before.vertices)
    assert len(after.faces) > len(before.faces) and len(edges) == 3 * len(after.faces) // 2


def test_short_edges_stay():
    before = closed_ball()
    after = split_long_edges(before, np.full(len(before.vertices), 9.0))

    assert np.array_equal(after.faces, before.faces) and np.array_equal(after.vertices, before.vertices)


def test_only_where_it_is_asked_for():
    before = closed_ball()
    after = split_long_edges(before, np.where(before.vertices[:, 1] > 0, 0.1, np.inf))

    assert after.vertices[len(before.vertices) :, 1].min() > -1e-9


def test_a_new_vertex_has_the_mean_color():
    corners = np.array([[0.0, 0, 0], [4.0, 0, 0], [0.0, 1, 0]])
    flat = Surface(corners, np.array([[0, 1, 2]]), np.array([[0, 0, 0], [200, 100, 255], [0, 0, 0]], np.uint8))
    after = split_long_edges(flat, np.full(3, 4.05))

    assert len(after.faces) == 2 and after.colors[3].tolist() == [100, 50, 127]
    assert after.vertices[3].tolist() == [2.0, 0.5, 0.0]
