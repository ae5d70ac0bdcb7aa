"""The rotations of all photos from those of pairs, and how far each pair contradicts them.

A pair that joins two facades which look alike has a relative pose as good as any by its own matches. Loops of photos
reveal it: the rotations along a loop must multiply to the identity. Rotation averaging (Hartley et al. 2013; Chatterjee
and Govindu 2013) tests all loops at once: find the R_i that minimize the angles of R_j' R_ij R_i, first their sum,
which many wrong pairs do not move far, then a robust sum of squares, which they do not move at all.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sfm_app.jit import kernel
from sfm_app.types import PairId
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

if TYPE_CHECKING:
    from scipy import sparse


class DisjointGroups:
    """Photos in groups that are joined one by one; the smaller of two groups is added to the larger."""

    def __init__(self, photos: Iterable[int]) -> None:
        self.members = {photo: [photo] for photo in photos}
        self.name = {photo: photo for photo in self.members}

    def join(self, a: int, b: int) -> list[int]:
        """Join the groups of two photos, and return the photos that change their group; none if it is the same."""
        larger, smaller = self.name[a], self.name[b]
        if larger == smaller:
            return []
        if len(self.members[larger]) < len(self.members[smaller]):
            larger, smaller = smaller, larger
        photos = self.members.pop(smaller)
        self.members[larger] += photos
        self.name |= dict.fromkeys(photos, larger)
        return photos


def connected_groups(pairs: Iterable[PairId], photos: Iterable[int] = ()) -> list[set[int]]:
    """Group the photos that pairs connect, the largest first; `photos` without a pair form groups of their own."""
    edges = list(pairs)
    groups = DisjointGroups([*photos, *(photo for pair in edges for photo in pair)])
    for a, b in edges:
        groups.join(a, b)
    return sorted(map(set, groups.members.values()), key=lambda group: (-len(group), min(group)))


def partners_of(pairs: Iterable[PairId]) -> dict[int, set[int]]:
    """Return the photos that pairs connect with each photo."""
    partners: dict[int, set[int]] = {}
    for a, b in pairs:
        partners.setdefault(a, set()).add(b)
        partners.setdefault(b, set()).add(a)
    return partners


# Corrections of a fold. Averaging begins along a tree, and a tree through a look-alike misplaces a whole street. The
# pairs of its true place then contradict the rotations, all by the same turn. The street is turned if these pairs
# weigh more than the least cut between the two ends (Ford and Fulkerson 1956).


class CORRECTIONS:
    """When a part of the photos is turned. Chosen by hand."""

    contradicts_deg: float = 10.0
    """Angle from which a pair contradicts the rotations. Chosen by hand: right pairs are below 5 degrees."""
    min_pairs: int = 3
    """Contradicting pairs that have to agree on a turn."""
    unit: float = 1000.0
    """Flows are whole numbers of the largest weight over this."""
    max_turns: int = 20
    """Most parts of a graph that turn."""


@dataclass(frozen=True, slots=True, eq=False)
class RotationCorrection:
    """A rotation of a part of the photos that satisfies pairs which contradict its place."""

    photos: BoolArray
    """(count,) mask of the part."""
    R: FloatArray
    """(3, 3) applied to their rotations from the right."""
    gain: float
    """Weight of the satisfied pairs, less that of the pairs across the cut."""


def find_corrections(
    count: int, edges: IndexArray, residuals: FloatArray, strengths: FloatArray
) -> Iterator[RotationCorrection]:
    """Yield corrections that satisfy more than they break, strongest first; residuals (E, 3) are of R_j' R_ij R_i."""
    from scipy.spatial.transform import Rotation

    explained = np.degrees(np.linalg.norm(residuals, axis=1)) <= CORRECTIONS.contradicts_deg
    unexplained, turns = ~explained, Rotation.from_rotvec(residuals)
    while unexplained.any():
        seed = int(np.argmax(np.where(unexplained, strengths, -1.0)))
        alike, reverse = (
            unexplained & (np.degrees((turns * turn).magnitude()) < AVERAGING.agreement_deg)
            for turn in (turns[seed].inv(), turns[seed])
        )
        group = _find_linked(count, edges, alike | reverse, seed)
        unexplained &= ~group
        if np.count_nonzero(group) < CORRECTIONS.min_pairs:
            continue
        ends = np.where((reverse & ~alike)[:, None], edges[:, ::-1], edges)[group]
        side, cut_weight = find_cut(
            count, edges[explained], strengths[explained], (np.unique(ends[:, 0]), np.unique(ends[:, 1]))
        )
        gain = float(strengths[group].sum()) - cut_weight
        if gain > 0.0:
            yield RotationCorrection(~side, turns[seed].as_matrix(), gain)


def _find_linked(count: int, edges: IndexArray, chosen: BoolArray, seed: int) -> BoolArray:
    """Return a mask (E,) of the chosen pairs that shared photos connect with the pair `seed`."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    i, j = edges[chosen].T
    _, part = connected_components(sparse.coo_array((np.ones(len(i)), (i, j)), shape=(count, count)), directed=False)
    return np.asarray(chosen & (part[edges[:, 0]] == part[edges[seed, 0]]), np.bool_)


def find_cut(
    count: int, edges: IndexArray, strengths: FloatArray, ends: tuple[IndexArray, IndexArray]
) -> tuple[BoolArray, float]:
    """Return a mask of the photos on the side of the first ends, and the weight across; inf without a cut."""
    from scipy import sparse
    from scipy.sparse.csgraph import breadth_first_order, maximum_flow

    if np.intersect1d(*ends).size or not len(edges):
        return np.zeros(count, np.bool_), float("inf")
    unit = max(float(strengths.max()) / CORRECTIONS.unit, 1e-300)
    capacity = _make_network(count, edges, np.maximum(1, np.round(strengths / unit)).astype(np.int64), ends)
    maximum = maximum_flow(capacity, count, count + 1)
    residual = sparse.csr_array((capacity - maximum.flow) > 0)
    reached = np.zeros(count + 2, np.bool_)
    reached[breadth_first_order(residual, count, return_predecessors=False)] = True
    return reached[:count], float(maximum.flow_value) * unit


def _make_network(
    count: int, edges: IndexArray, whole: IndexArray, ends: tuple[IndexArray, IndexArray]
) -> "sparse.csr_array":
    """Return capacities between photos, and from a source to the first ends and from the second ends to a sink."""
    from scipy import sparse

    first, second = ends
    most = np.full(len(first) + len(second), min(int(whole.sum()) + 1, np.iinfo(np.int32).max // 4))
    rows = np.concatenate([edges[:, 0], edges[:, 1], np.full(len(first), count), second])
    columns = np.concatenate([edges[:, 1], edges[:, 0], first, np.full(len(second), count + 1)])
    values = np.concatenate([whole, whole, most]).astype(np.int32)
    return sparse.coo_array((values, (rows, columns)), shape=(count + 2, count + 2)).tocsr()


class AVERAGING:
    """Rotation averaging; docs/algorithms/relative-poses.md."""

    agreement_deg: float = 5.0
    """Largest angle of the product of rotations along a loop that agree, and of two equal turns. Chosen by hand."""
    scale_deg: float = 3.0
    """Scale of the robust sum of squares (Geman and McClure). Chosen by hand."""
    sum_rounds: int = 15
    """Rounds of the sum of angles. Chosen by hand."""
    square_rounds: int = 50
    """Rounds of the robust sum of squares after it. Chosen by hand."""
    min_angle: float = 1e-3
    """Radians; smaller angles get no more weight. Chosen by hand."""
    min_step: float = 1e-7
    """Radians; smaller steps end the search. Chosen by hand."""
    loop_block: int = 100_000
    """Loops that are checked at once, to bound the memory. Chosen by hand."""
    dense_photos: int = 400
    """Most photos for which a dense system costs less than conjugate gradients. Counted."""


def average_rotations(
    relative: Mapping[PairId, FloatArray], weights: Mapping[PairId, float]
) -> tuple[dict[int, FloatArray], dict[PairId, float]]:
    """Estimate the rotations (3, 3) of all photos from those of pairs, and the angle of each pair in degrees."""
    if not relative:
        return {}, {}
    photos = sorted({photo for pair in relative for photo in pair})
    index = {photo: number for number, photo in enumerate(photos)}
    edges = np.array([[index[a], index[b]] for a, b in relative], np.int64)
    turns, strengths = np.array(list(relative.values())), np.array([weights[pair] for pair in relative])
    support = strengths * loop_support(edges, turns, strengths)
    rotations = _propagate_along_tree(len(photos), edges, turns, support)
    rotations = _descend(rotations, edges, turns, strengths, AVERAGING.sum_rounds)
    rotations = _apply_corrections(rotations, edges, turns, strengths)
    angles = np.degrees(np.linalg.norm(_residuals(rotations, edges, turns), axis=1))
    return dict(zip(photos, rotations, strict=True)), dict(zip(relative, angles.tolist(), strict=True))


def _descend(
    rotations: FloatArray, edges: IndexArray, turns: FloatArray, strengths: FloatArray, sum_rounds: int
) -> FloatArray:
    """Return the rotations (I, 3, 3) that minimize the angles of pairs near given ones."""
    from scipy.spatial.transform import Rotation

    for done in range(sum_rounds + AVERAGING.square_rounds):
        residuals = _residuals(rotations, edges, turns)
        angles = np.linalg.norm(residuals, axis=1)
        if done < sum_rounds:
            factors = strengths / np.maximum(angles, AVERAGING.min_angle)
        else:
            factors = strengths / (1.0 + (angles / np.radians(AVERAGING.scale_deg)) ** 2) ** 2
        steps = _solve_steps(len(rotations), edges, residuals, factors)
        rotations = rotations @ Rotation.from_rotvec(steps).as_matrix()
        if done > sum_rounds and np.abs(steps).max() < AVERAGING.min_step:
            break
    return rotations


def _apply_corrections(
    rotations: FloatArray, edges: IndexArray, turns: FloatArray, strengths: FloatArray
) -> FloatArray:
    for _ in range(CORRECTIONS.max_turns):
        residuals = _residuals(rotations, edges, turns)
        for correction in find_corrections(len(rotations), edges, residuals, strengths):
            corrected = np.where(correction.photos[:, None, None], rotations @ correction.R, rotations)
            if _robust_cost(_residuals(corrected, edges, turns), strengths) < _robust_cost(residuals, strengths):
                rotations = _descend(corrected, edges, turns, strengths, 0)
                break
        else:
            break
    return rotations


def _robust_cost(residuals: FloatArray, strengths: FloatArray) -> float:
    """Return the sum of squares that the last rounds minimize."""
    squares = (np.linalg.norm(residuals, axis=1) / np.radians(AVERAGING.scale_deg)) ** 2
    return float(np.sum(strengths * squares / (1.0 + squares)))


def loop_support(edges: IndexArray, turns: FloatArray, strengths: FloatArray) -> FloatArray:
    """Return (E,), in (0, 1], the share of the loops through each pair that agree, by their weaker other pair."""
    loops, agree = check_loops(edges, turns)
    sums = np.zeros((2, len(edges)))
    for column, others in ((0, (1, 2)), (1, (0, 2)), (2, (0, 1))):
        weight = np.minimum(*(strengths[loops[:, other]] for other in others))
        np.add.at(sums[0], loops[:, column], weight * agree)
        np.add.at(sums[1], loops[:, column], weight)
    least = np.median(strengths) * 0.1
    return np.asarray((sums[0] + least) / (sums[1] + least), np.float64)


def check_loops(edges: IndexArray, turns: FloatArray) -> tuple[IndexArray, BoolArray]:
    """Return (L, 3) edges of every loop of three photos, and whether it agrees; edges have the smaller photo first."""
    from scipy.spatial.transform import Rotation

    order = np.lexsort(edges.T[::-1])
    starts = np.searchsorted(edges[order, 0], np.arange(edges.max(initial=0) + 2))
    loops = order[_find_loops(edges[order], starts)] if len(edges) else np.zeros((0, 3), np.int64)
    agree = np.zeros(len(loops), np.bool_)
    for start in range(0, len(loops), AVERAGING.loop_block):
        first, second, across = (turns[column] for column in loops[start : start + AVERAGING.loop_block].T)
        products = np.einsum("nji,njk,nkl->nil", across, second, first)
        agree[start : start + AVERAGING.loop_block] = (
            np.degrees(Rotation.from_matrix(products).magnitude()) < AVERAGING.agreement_deg
        )
    return loops, agree


@kernel
def _find_loops(edges: IndexArray, starts: IndexArray) -> IndexArray:
    """Return (L, 3) sorted edges a-b, b-c and a-c of every triangle; `starts` has the first edge from each photo."""
    loops, count = np.empty((len(edges), 3), np.int64), 0
    for k in range(len(edges)):
        a, b = edges[k]
        i, j = k + 1, starts[b]
        while i < starts[a + 1] and j < starts[b + 1]:
            if edges[i, 1] == edges[j, 1]:
                if count == len(loops):
                    loops = np.concatenate((loops, np.empty_like(loops)))
                loops[count, 0], loops[count, 1], loops[count, 2] = k, j, i
                count += 1
            if edges[i, 1] <= edges[j, 1]:
                i += 1
            else:
                j += 1
    return loops[:count].copy()


def _propagate_along_tree(count: int, edges: IndexArray, turns: FloatArray, strengths: FloatArray) -> FloatArray:
    """Return (count, 3, 3) rotations along the strongest edges, from the first photo of every group on."""
    groups, neighbors = DisjointGroups(range(count)), [[] for _ in range(count)]  # type: ignore[var-annotated]
    for k in np.argsort(-strengths, kind="stable"):
        a, b = edges[k].tolist()
        if groups.join(a, b):
            neighbors[a].append((b, turns[k]))
            neighbors[b].append((a, turns[k].T))
    rotations, placed = np.tile(np.eye(3), (count, 1, 1)), set[int]()
    for root in range(count):
        waiting = [] if root in placed else [root]
        placed.add(root)
        while waiting:
            a = waiting.pop()
            for b, turn in neighbors[a]:
                if b not in placed:
                    rotations[b] = turn @ rotations[a]
                    placed.add(b)
                    waiting.append(b)
    return rotations


def _residuals(rotations: FloatArray, edges: IndexArray, turns: FloatArray) -> FloatArray:
    """Return the rotation vectors (E, 3) of R_j' R_ij R_i."""
    from scipy.spatial.transform import Rotation

    products = np.einsum("nji,njk,nkl->nil", rotations[edges[:, 1]], turns, rotations[edges[:, 0]])
    return np.asarray(Rotation.from_matrix(products).as_rotvec(), np.float64)


def _solve_steps(count: int, edges: IndexArray, residuals: FloatArray, factors: FloatArray) -> FloatArray:
    """Fit steps (count, 3) by weighted least squares of step_j - step_i = left; the free turn of each group stays 0."""
    from scipy import sparse
    from scipy.sparse.linalg import cg

    i, j = edges.T
    b = np.zeros((count, 3))
    np.add.at(b, j, factors[:, None] * residuals)
    np.add.at(b, i, -factors[:, None] * residuals)
    rows, columns = np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i])
    values = np.concatenate([factors, factors, -factors, -factors])
    L = sparse.coo_array((values, (rows, columns)), shape=(count, count)).tocsr()
    L = sparse.csr_array(L + sparse.diags_array(np.full(count, 1e-9 * factors.max())))
    if count <= AVERAGING.dense_photos:
        return np.asarray(np.linalg.solve(L.toarray(), b), np.float64)
    inverse = sparse.diags_array(1.0 / L.diagonal())
    return np.column_stack([cg(L, column, M=inverse)[0] for column in b.T])
