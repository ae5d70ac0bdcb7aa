"""The rotations of all photos from those of pairs, and how far each pair contradicts them.

A pair that joins two facades which look alike has a relative pose as good as any by its own matches. Loops of photos
reveal it: the rotations along a loop must multiply to the identity. Rotation averaging (Hartley et al. 2013; Chatterjee
and Govindu 2013) tests all loops at once: find the R_i that minimize the angles of R_j' R_ij R_i, first their sum,
which many wrong pairs do not move far, then a robust sum of squares, which they do not move at all.
"""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sfm_app.types import PairId

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

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
    for done in range(SUM_ROUNDS + SQUARE_ROUNDS):
        left = _residuals(rotations, edges, turns)
        angles = np.linalg.norm(left, axis=1)
        if done < SUM_ROUNDS:
            factors = strengths / np.maximum(angles, LEAST_ANGLE)
        else:
            factors = strengths / (1.0 + (angles / np.radians(SCALE_DEG)) ** 2) ** 2
        steps = _solve_steps(len(photos), edges, left, factors)
        rotations = rotations @ Rotation.from_rotvec(steps).as_matrix()
        if done > SUM_ROUNDS and np.abs(steps).max() < LEAST_STEP:
            break
    angles = np.degrees(np.linalg.norm(_residuals(rotations, edges, turns), axis=1))
    return dict(zip(photos, rotations, strict=True)), dict(zip(relative, angles.tolist(), strict=True))


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
    loops = np.array(list(_loops(edges.tolist())), np.int64).reshape(-1, 3)
    if not len(loops):
        return loops, np.zeros(0, np.bool_)
    first, second, across = turns[loops[:, 0]], turns[loops[:, 1]], turns[loops[:, 2]]
    around = np.einsum("nji,njk,nkl->nil", across, second, first)
    return loops, np.degrees(Rotation.from_matrix(around).magnitude()) < LOOP_DEG


def _loops(edges: Sequence[Sequence[int]]) -> Iterator[tuple[int, int, int]]:
    """Yield numbers of the edges a-b, b-c and a-c of every three photos a < b < c that are all connected."""
    number = {(a, b): k for k, (a, b) in enumerate(edges)}
    after: dict[int, list[int]] = {}
    for a, b in number:
        after.setdefault(a, []).append(b)
    for (a, b), k in number.items():
        yield from ((k, number[b, c], number[a, c]) for c in after.get(b, ()) if (a, c) in number)


def _propagate_along_tree(count: int, edges: IndexArray, turns: FloatArray, strengths: FloatArray) -> FloatArray:
    """Return (count, 3, 3) rotations along the strongest edges, from the first photo of every group on."""
    group, near = list(range(count)), [[] for _ in range(count)]  # type: ignore[var-annotated]
    for k in np.argsort(-strengths, kind="stable"):
        a, b = edges[k].tolist()
        if group[a] != group[b]:
            old, new = group[b], group[a]
            group = [new if name == old else name for name in group]
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
    L, b = 1e-9 * factors.max() * np.eye(count), np.zeros((count, 3))
    np.add.at(L, (i, i), factors)
    np.add.at(L, (j, j), factors)
    np.add.at(L, (i, j), -factors)
    np.add.at(L, (j, i), -factors)
    np.add.at(b, j, factors[:, None] * left)
    np.add.at(b, i, -factors[:, None] * left)
    return np.asarray(np.linalg.solve(L, b), np.float64)
