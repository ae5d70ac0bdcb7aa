import numpy as np
import pytest

from sfm_app.geometry.triangles import vertex_normals
from sfm_app.meshing.fairness import OPTIONS, FairnessOptions, Neighbors, find_displacements
from tests.unit.meshing.relief import PIXEL, grid


def flat(x, y):
    return 0.0 * x


def rough(x, y):
    return PIXEL * np.random.default_rng(1).normal(size=x.shape)


def parts(surface):
    around = Neighbors.from_faces(surface.faces, len(surface.vertices))
    return (
        surface.vertices,
        vertex_normals(surface.vertices, surface.faces),
        around,
        around.edge_lengths(surface.vertices),
    )


def laplacian(around):
    count = len(around.inner)
    L = np.zeros((count, count))
    for v in range(count):
        others = around.others[around.starts[v] : around.starts[v + 1]]
        if around.inner[v]:
            L[v, others], L[v, v] = 1.0 / len(others), -1.0
    return L


def test_neighbors_of_a_grid():
    surface = grid(flat, half=0.1, step=0.05)
    around = Neighbors.from_faces(surface.faces, 25)

    assert np.diff(around.starts).sum() == 2 * (2 * 20 + 16)
    assert around.inner.reshape(5, 5)[1:-1, 1:-1].all() and around.inner.sum() == 9
    assert sorted(around.others[around.starts[12] : around.starts[13]]) == [6, 7, 11, 13, 17, 18]
    lengths = around.edge_lengths(surface.vertices)
    assert lengths[12] == pytest.approx(0.05 * (4 + 2 * np.sqrt(2)) / 6)


def test_the_displacements_solve_the_normal_equations():
    surface = grid(rough, half=0.06, step=0.02)
    vertices, normals, around, size = parts(surface)
    rng = np.random.default_rng(2)
    g, h = rng.normal(size=len(size)) / PIXEL, rng.uniform(0.0, 1.0, len(size)) / PIXEL**2

    found = find_displacements(vertices, normals, around, (g, h), size, FairnessOptions(steps=2000, accuracy=1e-9))

    L = laplacian(around)
    bend = ((L @ vertices) * normals).sum(axis=1)
    W = np.diag(around.inner / (OPTIONS.bend * size) ** 2 / (1 + (bend / (OPTIONS.crease * size)) ** 2))
    expected = np.linalg.solve(np.diag(h + OPTIONS.hold / size**2) + L.T @ W @ L, g - L.T @ W @ bend)
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-4 * np.abs(expected).max())


def test_without_photos_a_rough_surface_becomes_smooth():
    surface = grid(rough, half=0.2, step=0.02)
    vertices, normals, around, size = parts(surface)

    moved = vertices + find_displacements(vertices, normals, around, (0 * size, 0 * size), size)[:, None] * normals

    inner = around.inner
    L = laplacian(around)
    assert np.abs((L @ moved)[inner, 2]).mean() < 0.35 * np.abs((L @ vertices)[inner, 2]).mean()


def test_photos_that_are_sure_decide():
    surface = grid(flat, half=0.2, step=0.02)
    vertices, normals, around, size = parts(surface)
    wanted = PIXEL * np.sin(40.0 * vertices[:, 0])
    h = np.full(len(size), 1e4) / size**2

    found = find_displacements(vertices, normals, around, (h * wanted, h), size)

    assert found == pytest.approx(wanted, abs=0.1 * PIXEL)
