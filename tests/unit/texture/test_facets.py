"""Neighbors, connected components and distinct numbers."""

import numpy as np
import pytest
from painted_box import strip

from sfm_app.texture.sightings import NONE, components, distinct, facets
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


@pytest.mark.parametrize("size", [50, 4000])
def test_different_numbers_ascend_whether_there_are_few_or_many(size):
    numbers = np.random.default_rng(1).integers(0, size, 50)

    np.testing.assert_array_equal(distinct(numbers, size), np.unique(numbers))
    assert len(distinct(numbers[:0], size)) == 0


def test_components_hang_together():
    mesh = strip(4)
    group = np.array([0, 0, 1, 1, 0, 0, 1, NONE], np.int64)
    of, count = components(group, mesh.neighbors)
    assert count == 3
    assert of.tolist() == [0, 0, 1, 2, 0, 0, 1, NONE]
