"""The rotations of all photos from those of pairs, and how far each pair contradicts them.

A pair that joins two facades which look alike has a relative pose as good as any by its own matches. Loops of photos
reveal it: the rotations along a loop must multiply to the identity. Rotation averaging (Hartley et al. 2013; Chatterjee
and Govindu 2013) tests all loops at once: find the R_i that minimize the angles of R_j' R_ij R_i, first their sum,
which many wrong pairs do not move far, then a robust sum of squares, which they do not move at all.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from scipy.sparse.linalg import cg
from scipy.spatial.transform import Rotation

from sfm_app.jit import kernel
from sfm_app.types import PairId
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

# Groups of photos that pairs connect.


class DisjointGroups:
    """Photos in groups that are joined one by one; the smaller of two groups is added to the larger.

    Args:
        photos: each starts as a group of its own.
    """

    def __init__(self, photos: Iterable[int]) -> None:
        self.members = {photo: [photo] for photo in photos}
        self.name = {photo: photo for photo in self.members}

    def join(self, a: int, b: int) -> list[int]:
        """Join the groups of two photos, and return the photos that changed their group; none if it was the same.

        Args:
            a, b: photos.
        """
        kept, gone = self.name[a], self.name[b]
        if kept == gone:
            return []
        if len(self.members[kept]) < len(self.members[gone]):
            kept, gone = gone, kept
        moved = self.members.pop(gone)
        self.members[kept] += moved
        self.name |= dict.fromkeys(moved, kept)
        return moved


def connected_groups(pairs: Iterable[PairId], photos: Iterable[int] = ()) -> list[set[int]]:
    """Group the photos that pairs connect, the largest group first.

    Args:
        pairs: connections between two photos.
        photos: form groups of their own if no pair connects them.
    """
    known = list(pairs)
    groups = DisjointGroups([*photos, *(photo for pair in known for photo in pair)])
    for a, b in known:
        groups.join(a, b)
    return sorted(map(set, groups.members.values()), key=lambda group: (-len(group), min(group)))


# Undo folds: parts of a graph that a few wrong pairs hold in a wrong place, against more right ones.
#
# Averaging begins along a tree, and a tree that passes through a look-alike puts a whole street where it is not.
# The pairs that join the street to its true place then contradict the rotations, all by the same turn. It costs
# less to let them have their way, and to turn the street by it, if the pairs that have to give way for this weigh
# less: those of the least cut between the two ends (Ford and Fulkerson 1956).

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

    photos: BoolArray
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


def _is_small(turns: Rotation) -> BoolArray:
    return np.asarray(np.degrees(turns.magnitude()) < SAME_DEG, np.bool_)


def _find_linked(count: int, edges: IndexArray, chosen: BoolArray, seed: int) -> BoolArray:
    """Return (E,) which of the chosen pairs hang together with one of them by shared photos."""
    i, j = edges[chosen].T
    _, part = connected_components(sparse.coo_array((np.ones(len(i)), (i, j)), shape=(count, count)), directed=False)
    return np.asarray(chosen & (part[edges[:, 0]] == part[edges[seed, 0]]), np.bool_)


def find_cut(
    count: int, edges: IndexArray, strengths: FloatArray, ends: tuple[IndexArray, IndexArray]
) -> tuple[BoolArray, float]:
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


LOOP_DEG = 5.0
"""The three rotations of a loop agree if the angle of their product is smaller. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
SCALE_DEG = 3.0
"""Scale of the robust sum of squares (Geman and McClure). docs/algorithms.md, From K to relative poses. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""
SUM_ROUNDS, SQUARE_ROUNDS = 15, 50
"""Rounds of the sum of angles, and of the robust sum of squares after it. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
LEAST_ANGLE, LEAST_STEP = 1e-3, 1e-7
"""In radians: smaller angles get no more weight; smaller steps end the search. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""

MOST_TURNS = 20
"""Most parts of a graph that turn. Chosen by hand."""
LOOP_BLOCK = 100_000
"""Loops that are checked at once, to bound the memory. Chosen by hand."""
DENSE_PHOTOS = 400
"""Most photos for which a dense system is solved; conjugate gradients cost less for more. Counted."""
STEP_PRECISION, MOST_ITERATIONS = 1e-6, 2000
"""Relative precision of one step by conjugate gradients, and most iterations: the next rounds correct what is left.
Chosen by hand; not measured on their own."""


def average_rotations(
    relative: Mapping[PairId, FloatArray], weights: Mapping[PairId, float]
) -> tuple[dict[int, FloatArray], dict[PairId, float]]:
    """Estimate the rotations of all photos, and the angle of each pair to them.

    Args:
        relative: by pair (3, 3), the rotation of photo 2 from photo 1.
        weights: by pair, > 0.

    Returns:
        By photo, (3, 3) from the world, whose axes are those of the first photo of each group; by pair, degrees.
    """
    if not relative:
        return {}, {}
    photos = sorted({photo for pair in relative for photo in pair})
    index = {photo: number for number, photo in enumerate(photos)}
    edges = np.array([[index[a], index[b]] for a, b in relative], np.int64)
    turns, strengths = np.array(list(relative.values())), np.array([weights[pair] for pair in relative])
    support = strengths * loop_support(edges, turns, strengths)
    rotations = _propagate_along_tree(len(photos), edges, turns, support)
    rotations = _descend(rotations, edges, turns, strengths, SUM_ROUNDS)
    rotations = _undo_folds(rotations, edges, turns, strengths)
    angles = np.degrees(np.linalg.norm(_residuals(rotations, edges, turns), axis=1))
    return dict(zip(photos, rotations, strict=True)), dict(zip(relative, angles.tolist(), strict=True))


def _descend(
    rotations: FloatArray, edges: IndexArray, turns: FloatArray, strengths: FloatArray, sum_rounds: int
) -> FloatArray:
    """Return the rotations (I, 3, 3) that minimize the angles of pairs near given ones."""
    for done in range(sum_rounds + SQUARE_ROUNDS):
        left = _residuals(rotations, edges, turns)
        angles = np.linalg.norm(left, axis=1)
        if done < sum_rounds:
            factors = strengths / np.maximum(angles, LEAST_ANGLE)
        else:
            factors = strengths / (1.0 + (angles / np.radians(SCALE_DEG)) ** 2) ** 2
        steps = _solve_steps(len(rotations), edges, left, factors)
        rotations = rotations @ Rotation.from_rotvec(steps).as_matrix()
        if done > sum_rounds and np.abs(steps).max() < LEAST_STEP:
            break
    return rotations


def _undo_folds(rotations: FloatArray, edges: IndexArray, turns: FloatArray, strengths: FloatArray) -> FloatArray:
    """Return the rotations after parts of the graph have turned to where most pairs want them."""
    for _ in range(MOST_TURNS):
        left = _residuals(rotations, edges, turns)
        for turn in find_turns(len(rotations), edges, left, strengths):
            turned = np.where(turn.photos[:, None, None], rotations @ turn.by, rotations)
            if _robust_cost(_residuals(turned, edges, turns), strengths) < _robust_cost(left, strengths):
                rotations = _descend(turned, edges, turns, strengths, 0)
                break
        else:
            break
    return rotations


def _robust_cost(left: FloatArray, strengths: FloatArray) -> float:
    """Return the sum of squares that the last rounds minimize."""
    squares = (np.linalg.norm(left, axis=1) / np.radians(SCALE_DEG)) ** 2
    return float(np.sum(strengths * squares / (1.0 + squares)))


def loop_support(edges: IndexArray, turns: FloatArray, strengths: FloatArray) -> FloatArray:
    """Return (E,), in (0, 1], the share of the loops of three through each pair that agree; 1 if there is no loop.

    Args:
        edges: (E, 2) numbers of photos, the smaller first.
        turns: (E, 3, 3) rotation of photo 2 from photo 1.
        strengths: (E,) weights; a loop weighs as much as the weaker of the two other pairs in it.
    """
    loops, agree = check_loops(edges, turns)
    found = np.zeros((2, len(edges)))
    for one, others in ((0, (1, 2)), (1, (0, 2)), (2, (0, 1))):
        weight = np.minimum(*(strengths[loops[:, other]] for other in others))
        np.add.at(found[0], loops[:, one], weight * agree)
        np.add.at(found[1], loops[:, one], weight)
    least = np.median(strengths) * 0.1
    return np.asarray((found[0] + least) / (found[1] + least), np.float64)


def check_loops(edges: IndexArray, turns: FloatArray) -> tuple[IndexArray, NDArray[np.bool_]]:
    """Return (L, 3) numbers of the edges of every loop of three photos, and (L,) whether their rotations agree.

    Args:
        edges: (E, 2) numbers of photos, the smaller first.
        turns: (E, 3, 3) rotation of photo 2 from photo 1.
    """
    order = np.lexsort(edges.T[::-1])
    starts = np.searchsorted(edges[order, 0], np.arange(edges.max(initial=0) + 2))
    loops = order[_find_loops(edges[order], starts)] if len(edges) else np.zeros((0, 3), np.int64)
    agree = np.zeros(len(loops), np.bool_)
    for start in range(0, len(loops), LOOP_BLOCK):
        first, second, across = (turns[column] for column in loops[start : start + LOOP_BLOCK].T)
        around = np.einsum("nji,njk,nkl->nil", across, second, first)
        agree[start : start + LOOP_BLOCK] = np.degrees(Rotation.from_matrix(around).magnitude()) < LOOP_DEG
    return loops, agree


@kernel
def _find_loops(edges: IndexArray, starts: IndexArray) -> IndexArray:
    """Return (L, 3) numbers of the edges a-b, b-c and a-c of every three photos a < b < c that are all connected.

    Args:
        edges: (E, 2) sorted, the smaller photo first; E > 0.
        starts: first edge from each photo, and from one after the last.
    """
    found, count = np.empty((len(edges), 3), np.int64), 0
    for k in range(len(edges)):
        a, b = edges[k]
        i, j = k + 1, starts[b]
        while i < starts[a + 1] and j < starts[b + 1]:
            if edges[i, 1] == edges[j, 1]:
                if count == len(found):
                    found = np.concatenate((found, np.empty_like(found)))
                found[count, 0], found[count, 1], found[count, 2] = k, j, i
                count += 1
            if edges[i, 1] <= edges[j, 1]:
                i += 1
            else:
                j += 1
    return found[:count].copy()


def _propagate_along_tree(count: int, edges: IndexArray, turns: FloatArray, strengths: FloatArray) -> FloatArray:
    """Return (count, 3, 3) rotations along the strongest edges, from the first photo of every group on."""
    groups, near = DisjointGroups(range(count)), [[] for _ in range(count)]  # type: ignore[var-annotated]
    for k in np.argsort(-strengths, kind="stable"):
        a, b = edges[k].tolist()
        if groups.join(a, b):
            near[a].append((b, turns[k]))
            near[b].append((a, turns[k].T))
    rotations, placed = np.tile(np.eye(3), (count, 1, 1)), set[int]()
    for root in range(count):
        waiting = [] if root in placed else [root]
        placed.add(root)
        while waiting:
            a = waiting.pop()
            for b, turn in near[a]:
                if b not in placed:
                    rotations[b] = turn @ rotations[a]
                    placed.add(b)
                    waiting.append(b)
    return rotations


def _residuals(rotations: FloatArray, edges: IndexArray, turns: FloatArray) -> FloatArray:
    """Return the rotation vectors (E, 3) of R_j' R_ij R_i."""
    around = np.einsum("nji,njk,nkl->nil", rotations[edges[:, 1]], turns, rotations[edges[:, 0]])
    return np.asarray(Rotation.from_matrix(around).as_rotvec(), np.float64)


def _solve_steps(count: int, edges: IndexArray, left: FloatArray, factors: FloatArray) -> FloatArray:
    """Fit steps (count, 3) by weighted least squares of step_j - step_i = left; the free turn of each group stays 0."""
    i, j = edges.T
    b = np.zeros((count, 3))
    np.add.at(b, j, factors[:, None] * left)
    np.add.at(b, i, -factors[:, None] * left)
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    values = np.concatenate([factors, factors, -factors, -factors])
    L = sparse.coo_array((values, (rows, columns)), shape=(count, count)).tocsr()
    L = sparse.csr_array(L + sparse.diags_array(np.full(count, 1e-9 * factors.max())))
    if count <= DENSE_PHOTOS:
        return np.asarray(np.linalg.solve(L.toarray(), b), np.float64)
    inverse = sparse.diags_array(1.0 / L.diagonal())
    solved = [cg(L, column, rtol=STEP_PRECISION, maxiter=MOST_ITERATIONS, M=inverse)[0] for column in b.T]
    return np.column_stack(solved)
