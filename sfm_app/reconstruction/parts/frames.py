"""A common frame for all fragments from their joins, and which joins contradict the others.

Around a loop of joins the similarities must multiply to the identity. All loops are asked at once, as in the averaging
of rotations: the frames that minimize the errors of all joins are found robustly, rotations first, then the logarithms
of the scales, then the shifts. A join that is off by more than bending parts explain is dropped, the worst one first,
and the frames are found again: chains do not drift where a loop closes them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.similarity import Similarity
from sfm_app.posegraph.groups import DisjointGroups, connected_groups
from sfm_app.posegraph.rotations import average_rotations
from sfm_app.reconstruction.parts.joins import Fragment, Join

FloatArray = NDArray[np.float64]

MOST_DEG, MOST_SCALE, MOST_SHIFT = 8.0, 0.15, 0.2
"""Errors of a join above which it contradicts the others: its angle, the logarithm of its scale, and its shift as a
share of the radius of the smaller fragment. Chosen by hand: parts that bend stay below, look-alikes do not."""
ROUNDS, LEAST_ERROR = 40, 1e-4
"""Rounds of reweighting towards the least sum of errors, and error below which a join gets no more weight."""


@dataclass(frozen=True, slots=True)
class JoinError:
    """How far a similarity is from what others say."""

    off_deg: float
    scale: float
    """Logarithm of the ratio of scales."""
    shift: float
    """As a share of the radius of the smaller fragment."""

    @property
    def excess(self) -> float:
        """The largest of the three errors, as a multiple of its limit."""
        return max(self.off_deg / MOST_DEG, abs(self.scale) / MOST_SCALE, self.shift / MOST_SHIFT)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Fragments in common frames."""

    frames: Mapping[int, Similarity]
    """From the frame of each fragment to the common one, for the largest group of joined fragments."""
    kept: tuple[tuple[Join, JoinError], ...]
    """Joins with their errors."""
    dropped: tuple[tuple[Join, JoinError], ...]
    """Joins that contradict the others, with their errors when they were dropped."""


def align_fragments(fragments: Sequence[Fragment], joins: Sequence[Join]) -> Alignment:
    """Find a common frame for the fragments that joins connect, without joins that contradict the others.

    Args:
        fragments: models of parts.
        joins: similarities between two of them.
    """
    radii = [fragment.radius for fragment in fragments]
    left = list(joins)
    dropped: list[tuple[Join, JoinError]] = []
    while True:
        frames = _synchronize(left, len(fragments))
        errors = [join_error(join, frames, radii) for join in left]
        # a single loop is equally far off in all of its joins: the one with least evidence goes
        ranked = sorted(range(len(left)), key=lambda k: (-errors[k].excess / left[k].weight, k))
        worst = next((k for k in ranked if errors[k].excess > 1.0), None)
        if worst is None:
            break
        dropped.append((left.pop(worst), errors[worst]))
    main = _main_group(fragments, left)
    kept = tuple(zip(left, errors, strict=True))
    return Alignment({number: frames[number] for number in sorted(main)}, kept, tuple(dropped))


def _main_group(fragments: Sequence[Fragment], joins: Sequence[Join]) -> set[int]:
    """Return the joined fragments that have most photos together."""
    groups = connected_groups([(join.first, join.second) for join in joins], range(len(fragments)))

    def count_photos(group: set[int]) -> int:
        return len({photo for number in group for photo in fragments[number].placed.photos.tolist()})

    return max(groups, key=lambda group: (count_photos(group), -min(group)), default=set())


def join_error(join: Join, frames: Mapping[int, Similarity], radii: Sequence[float]) -> JoinError:
    """Return how far a join is from the frames of its fragments.

    Args:
        join: of two fragments.
        frames: of all fragments.
        radii: of all fragments, in their own units.
    """
    expected = frames[join.first].inverse().compose(frames[join.second])
    return difference(join, expected, radii)


def difference(join: Join, expected: Similarity, radii: Sequence[float]) -> JoinError:
    """Return how far a join is from another similarity between its fragments.

    Args:
        join: of two fragments.
        expected: from the second fragment into the first.
        radii: of all fragments, in their own units.
    """
    cosine = (np.trace(expected.R.T @ join.similarity.R) - 1.0) / 2.0
    smaller = min(radii[join.first], expected.scale * radii[join.second])
    return JoinError(
        float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        float(np.log(join.similarity.scale / expected.scale)),
        float(np.linalg.norm(join.similarity(join.middle) - expected(join.middle))) / max(smaller, 1e-300),
    )


def _synchronize(joins: Sequence[Join], count: int) -> dict[int, Similarity]:
    """Return the frames of all fragments that least contradict the joins; alone, each has its own."""
    frames = dict.fromkeys(range(count), Similarity(1.0, np.eye(3), np.zeros(3)))
    if not joins:
        return frames
    pairs = [(join.first, join.second) for join in joins]
    weights = {pair: join.weight for pair, join in zip(pairs, joins, strict=True)}
    turned = {pair: join.similarity.R.T for pair, join in zip(pairs, joins, strict=True)}
    rotations = {number: R.T for number, R in average_rotations(turned, weights)[0].items()}
    strengths = np.array([join.weight for join in joins])
    edges = np.array(pairs, np.int64)
    logs = np.log([join.similarity.scale for join in joins])[:, None]
    scales = np.exp(_robust_potentials(count, edges, logs, strengths, np.ones(len(joins)))[:, 0])
    turns = [Similarity(float(scale), rotations.get(k, np.eye(3)), np.zeros(3)) for k, scale in enumerate(scales)]
    # where the shared photos are, errors of rotations shift least
    steps = np.concatenate(
        [turns[join.first](join.similarity(join.middle)) - turns[join.second](join.middle) for join in joins]
    )
    sizes = np.full(len(joins), max(float(np.linalg.norm(steps, axis=1).mean()), 1e-300))
    shifts = _robust_potentials(count, edges, steps, strengths, sizes)
    return frames | {
        number: Similarity(float(scales[number]), rotations[number], shifts[number]) for number in sorted(rotations)
    }


def _robust_potentials(
    count: int, edges: NDArray[np.int64], steps: FloatArray, strengths: FloatArray, sizes: FloatArray
) -> FloatArray:
    """Return (count, k) values whose differences have the least sum of weighted distances to steps.

    The first fragment of each group has 0.

    Args:
        count: fragments.
        edges: (J, 2) numbers of fragments.
        steps: (J, k) wanted differences, second less first.
        strengths: (J,) weights.
        sizes: (J,) units in which errors are measured.
    """
    groups = DisjointGroups(range(count))
    for a, b in edges.tolist():
        groups.join(a, b)
    held = sorted({min(members) for members in groups.members.values()})
    free = np.setdiff1d(np.arange(count), held)
    A = np.zeros((len(edges), count))
    A[np.arange(len(edges)), edges[:, 1]] += 1.0
    A[np.arange(len(edges)), edges[:, 0]] -= 1.0
    values, weights = np.zeros((count, steps.shape[1])), strengths.copy()
    for _ in range(ROUNDS):
        root = np.sqrt(weights)[:, None]
        values[free] = np.linalg.lstsq(root * A[:, free], root * steps, rcond=None)[0]
        errors = np.linalg.norm(A @ values - steps, axis=1) / sizes
        weights = strengths / np.maximum(errors, LEAST_ERROR)
    return values


def loop_errors(fragments: Sequence[Fragment], joins: Sequence[Join]) -> list[tuple[tuple[int, ...], JoinError]]:
    """Return the error around each loop that a join closes, with the fragments of the loop.

    The strongest joins form a tree. Each other join closes one loop with it.

    Args:
        fragments: models of parts.
        joins: similarities between two of them.
    """
    groups, near = DisjointGroups(range(len(fragments))), dict[int, list[tuple[int, Similarity]]]()
    radii = [fragment.radius for fragment in fragments]
    found, closing = [], []
    for join in sorted(joins, key=lambda join: (-join.weight, join.first, join.second)):
        if groups.join(join.first, join.second):
            near.setdefault(join.first, []).append((join.second, join.similarity))
            near.setdefault(join.second, []).append((join.first, join.similarity.inverse()))
        else:
            closing.append(join)
    for join in closing:
        way, similarity = _way(near, join.first, join.second)
        found.append((way, difference(join, similarity, radii)))
    return found


def _way(
    near: Mapping[int, Sequence[tuple[int, Similarity]]], start: int, end: int
) -> tuple[tuple[int, ...], Similarity]:
    """Return the fragments on the way along the tree, and the similarity from the end's frame into the start's."""
    waiting: list[tuple[tuple[int, ...], Similarity]] = [((start,), Similarity(1.0, np.eye(3), np.zeros(3)))]
    while waiting:
        way, so_far = waiting.pop()
        if way[-1] == end:
            return way, so_far
        waiting += [((*way, other), so_far.compose(step)) for other, step in near[way[-1]] if other not in way[-2:-1]]
    raise ValueError("no joins lead from one fragment to the other")
