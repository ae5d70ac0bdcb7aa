"""The triangles of a surface and their neighbors, and the texels that belong to each."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sfm_app.texture import pages
from sfm_app.texture.facets import NONE, SPARSE, distinct, facets
from sfm_app.texture.pages import owners
from sfm_app.texture.view_selection import _match_labels
from sfm_app.types import Surface


def test_neighbors_share_an_edge_that_no_third_triangle_has():
    rng = np.random.default_rng(6)
    faces = np.array([rng.permutation(12)[:3] for _ in range(40)])
    mesh = facets(Surface(rng.normal(size=(14, 3)), faces, np.zeros((14, 3), np.uint8)))

    edges = [[frozenset((face[k], face[(k + 1) % 3])) for k in range(3)] for face in faces.tolist()]
    alone = two = 0
    for f, own in enumerate(edges):
        for k, edge in enumerate(own):
            others = [g for g, there in enumerate(edges) if g != f and edge in there]
            assert mesh.neighbors[f, k] == (others[0] if len(others) == 1 else NONE)
            alone, two = alone + (len(others) != 1), two + (len(others) == 1)
    assert min(alone, two) > 10
    for v in range(14):
        fan = mesh.fans[mesh.fan_starts[v] : mesh.fan_starts[v + 1]]
        assert fan.tolist() == np.flatnonzero((faces == v).any(axis=1)).tolist()


@pytest.mark.parametrize("size", [50, 60 * SPARSE])
def test_different_numbers_ascend_whether_there_are_few_or_many(size):
    numbers = np.random.default_rng(1).integers(0, size, 50)

    np.testing.assert_array_equal(distinct(numbers, size), np.unique(numbers))
    assert len(distinct(numbers[:0], size)) == 0


def test_texels_have_the_same_owners_in_bands(monkeypatch):
    rng = np.random.default_rng(2)
    corners = rng.uniform(0, 100, (30, 1, 2)) + rng.uniform(-12, 12, (30, 3, 2))
    triangles = np.arange(30)

    whole = owners((96, 90), triangles, corners)
    monkeypatch.setattr(pages, "BAND", 16)
    with ThreadPoolExecutor(3) as threads:
        in_bands = owners((96, 90), triangles, corners, threads.map)

    assert 0.1 < np.mean(whole != NONE) < 0.9
    np.testing.assert_array_equal(in_bands, whole)


def test_labels_are_matched_with_those_of_the_neighbors():
    labels = np.array([[4, 2, 7], [7, 4, NONE], [5, NONE, NONE]], np.int32)
    neighbors = np.array([[1, NONE, 2], [NONE, NONE, 0], [0, NONE, NONE]], np.int32)
    same = np.full((3, 3, 3), NONE, np.int8)

    _match_labels(labels, neighbors, same)

    assert same[0, 0].tolist() == [2, 0, NONE]
    assert same[1, 2].tolist() == [1, NONE, 0]
    assert same[2, 0].tolist() == same[0, 2].tolist() == same[0, 1].tolist() == [NONE] * 3
