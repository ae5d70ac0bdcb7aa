"""The minimum cut is as small as SciPy's largest flow."""

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import maximum_flow

from sfm_app.meshing.min_cut import sink_side


def value_of(side, neighbors, capacity, excess):
    """The capacity from the source's side to the sink's, with that of the source and the sink themselves."""
    at, place = np.nonzero((neighbors >= 0) & ~side[:, None] & side[np.maximum(neighbors, 0)])
    return capacity[at, place].sum() + excess[side].clip(min=0).sum() - excess[~side].clip(max=0).sum()


def largest_flow(neighbors, capacity, excess):
    count = len(neighbors)
    whole = np.zeros((count + 2, count + 2), np.int32)
    at, place = np.nonzero(neighbors >= 0)
    whole[at, neighbors[at, place]] = capacity[at, place]
    whole[count, :count], whole[:count, count + 1] = excess.clip(min=0), -excess.clip(max=0)
    return maximum_flow(csr_array(whole), count, count + 1).flow_value


def tetrahedra(rng, count):
    """Neighbors (T, 4) like those of tetrahedra: random pairs, each once, some places without any."""
    free = [[*rng.permutation(4)] for _ in range(count)]
    neighbors = np.full((count, 4), -1, np.int32)
    for a, b in rng.integers(0, count, (4 * count, 2)):
        if a != b and free[a] and free[b] and b not in neighbors[a]:
            neighbors[a, free[a].pop()], neighbors[b, free[b].pop()] = b, a
    return neighbors


def grid(rng, side):
    """Neighbors (T, 4) of cells of a square: long ways, on which trees grow deep and orphans are many."""
    at = np.pad(np.arange(side * side, dtype=np.int32).reshape(side, side), 1, constant_values=-1)
    around = [at[:-2, 1:-1], at[2:, 1:-1], at[1:-1, :-2], at[1:-1, 2:]]
    return rng.permuted(np.stack(around, axis=-1).reshape(-1, 4), axis=1)


@pytest.mark.parametrize("shape", [tetrahedra, grid])
@pytest.mark.parametrize("most", [1, 3, 100_000])
def test_the_cut_is_minimal(shape, most):
    """Small capacities give many equal cuts and full edges, large ones sums that float numbers do not have."""
    crossing = 0
    for seed in range(60):
        rng = np.random.default_rng(seed)
        neighbors = shape(rng, int(rng.integers(2, 40 if shape is tetrahedra else 9)))
        capacity = rng.integers(0, most + 1, neighbors.shape).astype(np.int32)
        excess = rng.integers(-2 * most, 2 * most + 1, len(neighbors)) * (rng.random(len(neighbors)) < 0.6)

        side = sink_side(neighbors, capacity.copy(), excess.copy())

        expected = largest_flow(neighbors, capacity, excess)
        assert value_of(side, neighbors, capacity, excess) == expected
        crossing += expected > 0 and side.any() and not side.all()
    assert crossing > 20  # the graphs ask for cuts through them


def two(forward, backward, excess):
    neighbors = np.array([[-1, -1, 1, -1], [0, -1, -1, -1]], np.int32)
    capacity = np.array([[7, 7, forward, 7], [backward, 7, 7, 7]], np.int32)
    return sink_side(neighbors, capacity, np.array(excess, np.int64)).tolist()


def test_two_nodes_are_cut_where_the_capacity_is_least():
    assert two(3, 9, (5, -4)) == [False, True]  # 3 of 3, 4 and 5
    assert two(9, 0, (5, -4)) == [False, False]  # the sink's edge is full
    assert two(9, 0, (4, -5)) == [True, True]  # the source's edge is full
    assert two(0, 9, (5, -4)) == [False, True]  # the capacity has a direction
    assert two(0, 9, (-5, 4)) == [True, True]


def test_nodes_without_neighbors_stay_where_they_are_tied():
    side = sink_side(np.full((3, 4), -1, np.int32), np.full((3, 4), 9, np.int32), np.array([1, -1, 0], np.int64))
    assert side.tolist() == [False, True, False]


def test_a_capacity_from_the_source_may_exceed_32_bits():
    big = 2**40
    neighbors = np.array([[1, -1, -1, -1], [0, -1, -1, -1]], np.int32)
    capacity = np.full((2, 4), 2**30, np.int32)
    assert sink_side(neighbors, capacity, np.array([big, -big])).tolist() == [False, True]
