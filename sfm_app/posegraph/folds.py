"""Undo folds: parts of a graph that a few wrong pairs hold in a wrong place, against more right ones.

Averaging begins along a tree, and a tree that passes through a look-alike puts a whole street where it is not. The
pairs that join the street to its true place then contradict the rotations, all by the same turn. It costs less to let
them have their way, and to turn the street by it, if the pairs that have to give way for this weigh less: those of the
least cut between the two ends (Ford and Fulkerson 1956).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

CONTRADICTS_DEG, SAME_DEG = 10.0, 5.0
"""Angle from which a pair contradicts the rotations, and up to which two pairs do so by the same turn. Chosen by hand:
right pairs of a town are off by less than 5 degrees."""
LEAST_PAIRS = 3
"""Contradicting pairs that have to agree on a turn. Chosen by hand."""
UNIT = 1000.0
"""Flows are whole numbers of weights divided by this many parts of the largest weight. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """A part of the photos, and how it has to turn to satisfy pairs that contradict its place."""

    photos: Mask
    """(count,) that turn."""
    by: FloatArray
    """(3, 3) applied to their rotations from the right."""
    gain: float
    """Weight of the pairs that are satisfied, less that of the pairs that give way."""


def find_turns(count: int, edges: IndexArray, left: FloatArray, strengths: FloatArray) -> Iterator[Turn]:
    """Yield turns that satisfy more than they break, those of the strongest contradictions first.

    Args:
        count: photos.
        edges: (E, 2) numbers of photos.
        left: (E, 3) rotation vectors of R_j' R_ij R_i.
        strengths: (E,) weights.
    """
    held = np.degrees(np.linalg.norm(left, axis=1)) <= CONTRADICTS_DEG
    open_, turns = ~held, Rotation.from_rotvec(left)
    while open_.any():
        seed = int(np.argmax(np.where(open_, strengths, -1.0)))
        alike, reverse = (open_ & _is_small(turns * way) for way in (turns[seed].inv(), turns[seed]))
        group = _find_linked(count, edges, alike | reverse, seed)
        open_ &= ~group
        if np.count_nonzero(group) < LEAST_PAIRS:
            continue
        ends = np.where((reverse & ~alike)[:, None], edges[:, ::-1], edges)[group]
        side, given = find_cut(count, edges[held], strengths[held], (np.unique(ends[:, 0]), np.unique(ends[:, 1])))
        gain = float(strengths[group].sum()) - given
        if gain > 0.0:
            yield Turn(~side, turns[seed].as_matrix(), gain)


def _is_small(turns: Rotation) -> Mask:
    return np.asarray(np.degrees(turns.magnitude()) < SAME_DEG, np.bool_)


def _find_linked(count: int, edges: IndexArray, chosen: Mask, seed: int) -> Mask:
    """Return (E,) which of the chosen pairs hang together with one of them by shared photos."""
    i, j = edges[chosen].T
    _, part = connected_components(sparse.coo_array((np.ones(len(i)), (i, j)), shape=(count, count)), directed=False)
    return np.asarray(chosen & (part[edges[:, 0]] == part[edges[seed, 0]]), np.bool_)


def find_cut(
    count: int, edges: IndexArray, strengths: FloatArray, ends: tuple[IndexArray, IndexArray]
) -> tuple[Mask, float]:
    """Return which photos stay on the side of the first ends, and the weight of the pairs across; inf without a cut.

    Args:
        count: photos.
        edges: (E, 2) of the pairs that hold.
        strengths: (E,) their weights.
        ends: (K,) photos that must be on the one side, and (L,) on the other.
    """
    if np.intersect1d(*ends).size or not len(edges):
        return np.zeros(count, np.bool_), float("inf")
    unit = max(float(strengths.max()) / UNIT, 1e-300)
    capacity = _make_network(count, edges, np.maximum(1, np.round(strengths / unit)).astype(np.int64), ends)
    found = maximum_flow(capacity, count, count + 1)
    residual = sparse.csr_array((capacity - found.flow) > 0)
    reached = np.zeros(count + 2, np.bool_)
    reached[breadth_first_order(residual, count, return_predecessors=False)] = True
    return reached[:count], float(found.flow_value) * unit


def _make_network(
    count: int, edges: IndexArray, whole: IndexArray, ends: tuple[IndexArray, IndexArray]
) -> sparse.csr_array:
    """Return capacities between photos, and from a source to the first ends and from the second ends to a sink."""
    first, second = ends
    most = np.full(len(first) + len(second), min(int(whole.sum()) + 1, np.iinfo(np.int32).max // 4))
    rows = np.concatenate([edges[:, 0], edges[:, 1], np.full(len(first), count), second])
    columns = np.concatenate([edges[:, 1], edges[:, 0], first, np.full(len(second), count + 1)])
    values = np.concatenate([whole, whole, most]).astype(np.int32)
    return sparse.coo_array((values, (rows, columns)), shape=(count + 2, count + 2)).tocsr()
