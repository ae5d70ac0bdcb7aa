"""The pose graph: relative poses of pairs that agree with each other."""

import logging
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sfm_app.geometry.epipolar import FIRST, SECOND
from sfm_app.numerical import FAILURES
from sfm_app.posegraph.look_alikes import find_look_alikes
from sfm_app.posegraph.pair_pose import Pair, estimate_pose, is_in_front, pose_distances, refine_pose
from sfm_app.posegraph.rotations import average_rotations, check_loops, connected_groups
from sfm_app.types import EpipolarFit, Intrinsics, LookAlikes, MatchGraph, PairId, PoseGraph, RelativePose, ViewGraph
from sfm_app.types.arrays import FloatArray

# Poses re-estimated with the rotation known from other pairs, so that only the direction of translation is sought.
#
# F of few matches on a facade also fits mismatches that lie right by accident. With the rotation known from loops
# of other pairs, two matches determine the direction, and the matches that then agree are of the scene.

SAMPLES = 200
"""Samples of two matches, each of which gives a direction (docs/algorithms.md, From K to relative poses). Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
MIN_KEPT_SHARE = 0.9
"""A pose whose rotation diverges is accepted with the rotation of the other pairs, if that keeps this share of its
inliers: a long lens does not determine how far the camera has turned. docs/algorithms.md, From K to relative poses.
Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
HELD_ROUNDS, HELD_SIGMA = 8, 0.2
"""Rounds of reweighted least squares with fixed rotation, and the scale of the loss in thresholds. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""
NEAR_THRESHOLDS = 3.0
"""With the rotation of the other pairs, matches within this many thresholds are used. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
LEAST_GUIDED_IN_FRONT, MOST_TURN_DEG = 0.95, 2.0
"""A guided pose is accepted if at least this share of its inliers lies in front of both cameras and its rotation
changed by at most this angle. On the photo sets with truth none of the pairs found so was wrong (docs/algorithms.md,
From K to relative poses)."""


def guided_pose(pair: Pair, R: FloatArray, min_inliers: int, seed: int) -> RelativePose | None:
    """Estimate the pose of a pair whose rotation is known; None if its matches do not confirm it.

    Args:
        pair: matches and cameras.
        R: (3, 3) rotation of view 2 from view 1, known from the other pairs.
        min_inliers: least number of inliers of a pose.
        seed: seed of the sampling.
    """
    if len(pair.lines) < min_inliers:
        return None
    t = sample_direction(pair, R, np.random.default_rng(seed))
    if t is None:
        return None
    near = pose_distances(pair.lines, R, t) <= NEAR_THRESHOLDS * pair.max_error_px
    if np.count_nonzero(near) < min_inliers:
        return None
    turned, moved = refine_pose(pair.lines[near], R, t)
    inliers = pair.inliers(turned, moved)
    if np.count_nonzero(inliers) < min_inliers:
        return None
    if np.degrees(Rotation.from_matrix(R.T @ turned).magnitude()) > MOST_TURN_DEG:
        free = np.count_nonzero(inliers)
        turned, moved = R, refine_direction(pair, R, t)
        inliers = pair.inliers(turned, moved)
        if np.count_nonzero(inliers) < max(min_inliers, MIN_KEPT_SHARE * free):
            return None
    found = pair.pose(turned, moved, inliers, guided=True)
    return found if found.in_front >= LEAST_GUIDED_IN_FRONT and found.kind != "rotation" else None


def _epipolar_normals(pair: Pair, R: FloatArray) -> FloatArray:
    """Return (N, 3), for each match the vector that the translation is perpendicular to, given R."""
    return np.asarray(np.cross(pair.lines[:, FIRST] @ R.T, pair.lines[:, SECOND]), np.float64)


def refine_direction(pair: Pair, R: FloatArray, t: FloatArray) -> FloatArray:
    """Refine the direction of translation (3,) by robust least squares of the distances, with R fixed.

    Args:
        pair: matches and cameras.
        R: (3, 3) rotation of view 2 from view 1; it is kept fixed.
        t: (3,) unit vector to start from.
    """
    normals = _epipolar_normals(pair, R)
    best = t
    for _ in range(HELD_ROUNDS):
        distances = pose_distances(pair.lines, R, best) / (HELD_SIGMA * pair.max_error_px)
        algebraic = np.abs(np.einsum("ni,i->n", normals, best))
        # Sampson's distance is the algebraic one over its gradient, which hardly changes with t
        gradients = np.where(distances > 0, algebraic / np.maximum(distances, 1e-12), 1.0)
        weights = 1.0 / (np.maximum(gradients, 1e-12) ** 2 * (1.0 + distances**2))
        _, axes = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights, normals, normals))
        best = axes[:, 0] * np.sign(axes[:, 0] @ t or 1.0)
    return np.asarray(best, np.float64)


def sample_direction(pair: Pair, R: FloatArray, rng: np.random.Generator) -> FloatArray | None:
    """Estimate the direction of translation (3,) that most matches agree with, given R.

    It is the best of `SAMPLES` directions from two matches each; None if no sample gives one.

    Args:
        pair: matches and cameras.
        R: (3, 3) rotation of view 2 from view 1; it is kept fixed.
        rng: draws the samples; its state moves on.
    """
    normals = _epipolar_normals(pair, R)
    picks = rng.integers(len(normals), size=(SAMPLES, 2))
    found = np.cross(normals[picks[:, 0]], normals[picks[:, 1]])
    lengths = np.linalg.norm(found, axis=1)
    best, lowest = None, np.inf
    for t in found[lengths > 1e-12] / lengths[lengths > 1e-12, None]:
        distances = pose_distances(pair.lines, R, t) / pair.max_error_px
        cost = float(np.sum(distances**2 / (1.0 + distances**2)))
        if cost < lowest:
            best, lowest = np.asarray(t, np.float64), cost
    if best is None:
        return None
    # t and -t have the same epipolar lines
    front, behind = (np.count_nonzero(is_in_front(pair.lines, R, sign * best)) for sign in (1.0, -1.0))
    return best if front >= behind else -best


logger = logging.getLogger("sfm_app")

ParallelMap = Callable[[Callable[[Any], Any], Sequence[Any], str], list[Any]]
"""Results of a function in the order of its arguments, computed in parallel; the text labels a progress bar."""

LEAST_IN_FRONT = 0.75
"""A pair with a smaller share of its inliers in front of both cameras has a wrong pose or wrong matches. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
AGREEMENT_DEG, GUESSED_DEG, SPREADS = 5.0, 15.0, 4.0
"""Largest angle between the rotation of a pair and those of its photos, the same if a camera is a guess, and the limit
as a multiple of the median angle; the larger limit holds. docs/algorithms.md, From K to relative poses. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""
SATURATION_INLIERS = 100.0
"""Number of inliers above which the weight of a pair hardly grows. docs/algorithms.md, From K to relative poses. Chosen
by hand; halved and doubled by `benchmarks.sensitivity`."""
FLAT_WEIGHT = 0.1
"""Weight factor of a pair whose matches lie on a plane: two poses explain it, and often the wrong one is chosen. Chosen
on kitchen25, where such pairs outvoted those that join its two halves; nothing changes on castle-P19, fountain-P11 and
temple16. All sets: benchmarks/corpus/tuning_sets.py."""
WEAK_FACTOR = 2.0
"""A pair with fewer inliers than this multiple of the minimum must be confirmed by a loop of other pairs.
docs/algorithms.md, From K to relative poses. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
CONTRADICTS, BEHIND, TOO_FEW = "contradicts other pairs", "points behind a camera", "too few matches fit the cameras"
NOT_COMPUTABLE = "its pose cannot be computed"
UNCONFIRMED = "few matches, and no other pair bears it out"
LOOKS_ALIKE = "equal things in different places"
NO_POSES: Mapping[PairId, RelativePose] = MappingProxyType({})
"""No relative pose is known before."""


@dataclass(frozen=True, slots=True)
class PoseGraphOptions:
    """Options for estimating and rejecting pairs."""

    max_error_px: float
    """Largest Sampson distance of an inlier."""
    min_inliers: int
    """A pair with fewer is dropped."""
    seed: int
    """Seed of the run."""


def build_pose_graph(
    matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, options: PoseGraphOptions, run_map: ParallelMap,
    known: Mapping[PairId, RelativePose] = NO_POSES,
) -> PoseGraph:  # fmt: skip
    """Build the graph of relative poses: without pairs that contradict others, with rejected pairs that others recover.

    Args:
        matches: keypoints and raw matches.
        views: fundamental matrices.
        intrinsics: cameras.
        options: thresholds and seed.
        run_map: computes pairs in parallel.
        known: relative poses of a model, which are not estimated again.
    """

    def make_pair(pair: PairId) -> Pair:
        cameras = [intrinsics.camera(matches.images[photo]) for photo in pair]
        return Pair(matches.points(pair), cameras, options.max_error_px)

    def estimate_from_fit(item: tuple[PairId, EpipolarFit]) -> RelativePose | str | None:
        try:
            return estimate_pose(make_pair(item[0]), item[1])
        except FAILURES as err:
            logger.info("pair %s has no pose", item[0], exc_info=err)
            return NOT_COMPUTABLE

    fits = {pair: fit for pair, fit in views.fits.items() if pair not in known}
    found = dict(zip(fits, run_map(estimate_from_fit, list(fits.items()), "relative poses"), strict=True))
    poses, dropped = _split_plausible(found, options.min_inliers)
    poses |= known
    cameras = {photo: intrinsics.camera(image) for photo, image in matches.images.items()}
    apart = find_look_alikes(matches, poses, cameras)
    for pair in [pair for join in apart.joins for pair in join.pairs]:
        dropped[pair] = LOOKS_ALIKE
        del poses[pair]
    rotations, angles = average_pair_rotations(poses, {pair for pair, fit in views.fits.items() if fit.degeneracy})
    for pair in _contradicting_pairs(poses, angles):
        dropped[pair] = CONTRADICTS
        del poses[pair]

    def estimate_guided(pair: PairId) -> RelativePose | None:
        seed = int(np.random.SeedSequence([options.seed, *pair]).generate_state(1)[0])
        known = make_pair(pair)
        R = rotations[pair[1]] @ rotations[pair[0]].T
        try:
            return guided_pose(known, R, options.min_inliers, seed) if known.trusted else None
        except FAILURES:  # the reason that it has no pose is already recorded
            return None

    left = [pair for pair in _pairs_without_pose(matches.matches, poses, known) if dropped.get(pair) != LOOKS_ALIKE]
    for pair, pose in zip(left, run_map(estimate_guided, left, "relative poses by known rotations"), strict=True):
        if pose is not None and not apart.is_look_alike(pair, matches.matches[pair][pose.inliers]):
            poses[pair] = pose
            dropped.pop(pair, None)
    poses = dict(sorted(poses.items()))
    for pair in _unconfirmed_pairs(poses, WEAK_FACTOR * options.min_inliers):
        dropped[pair] = UNCONFIRMED
        del poses[pair]
    return PoseGraph(poses, dropped, _groups(poses), apart.joins, _joins_left(apart.doubtful, poses))


def _joins_left(joins: Iterable[LookAlikes], poses: Collection[PairId]) -> tuple[LookAlikes, ...]:
    stayed = (replace(join, pairs=tuple(pair for pair in join.pairs if pair in poses)) for join in joins)
    return tuple(join for join in stayed if join.pairs)


def with_model(graph: PoseGraph, photos: Collection[int], poses: Mapping[PairId, RelativePose]) -> PoseGraph:
    """Return the graph with the relative poses between the photos of a model replaced by those of the model.

    Args:
        graph: the graph so far; it is not changed.
        photos: those of the model.
        poses: relative poses of the model by pair.
    """
    kept = {pair: pose for pair, pose in graph.poses.items() if not (pair[0] in photos and pair[1] in photos)}
    gone = sorted(graph.poses.keys() - kept.keys() - poses.keys())
    dropped = dict(graph.dropped) | dict.fromkeys(gone, CONTRADICTS)
    entered = dict(sorted((kept | dict(poses)).items()))
    left = {pair: why for pair, why in dropped.items() if pair not in entered}
    return replace(graph, poses=entered, dropped=left, groups=_groups(entered))


def _pairs_without_pose(
    pairs: Iterable[PairId], poses: Mapping[PairId, RelativePose], known: Collection[PairId]
) -> list[PairId]:
    """Return the pairs without a pose whose photos are connected by pairs with one, and not both in known pairs."""
    settled = {photo for pair in known for photo in pair}
    pairs = [pair for pair in pairs if not settled.issuperset(pair)]
    group = {photo: number for number, photos in enumerate(_groups(poses)) for photo in photos}
    return [pair for pair in pairs if pair not in poses and group.get(pair[0], -1) == group.get(pair[1], -2)]


def _contradicting_pairs(poses: Mapping[PairId, RelativePose], angles: Mapping[PairId, float]) -> list[PairId]:
    """Return the pairs whose angles to the rotations of their photos, in degrees, exceed the limit."""
    typical = SPREADS * float(np.median(list(angles.values()) or [0.0]))
    limits = {
        pair: max(typical, GUESSED_DEG if poses[pair].kind == "uncalibrated" else AGREEMENT_DEG) for pair in angles
    }
    return [pair for pair, angle in angles.items() if angle > limits[pair]]


def average_pair_rotations(
    poses: Mapping[PairId, RelativePose], flat: Collection[PairId] = ()
) -> tuple[dict[int, FloatArray], dict[PairId, float]]:
    """Average the rotations of pairs, weighted by inliers, to those of photos; return these and how far pairs are off.

    Args:
        poses: of pairs.
        flat: pairs whose matches lie on one plane, or otherwise do not determine F: they get little weight.
    """
    weights = {
        pair: pose.inlier_count
        / (1.0 + pose.inlier_count / SATURATION_INLIERS)
        * (FLAT_WEIGHT if pair in flat else 1.0)
        for pair, pose in poses.items()
    }
    return average_rotations({pair: pose.R for pair, pose in poses.items()}, weights)


def _unconfirmed_pairs(poses: Mapping[PairId, RelativePose], firm: float) -> list[PairId]:
    """Return the pairs with fewer than `firm` inliers that no loop of three photos confirms.

    Such pairs may join places that only look alike, with no other pair to contradict them.
    """
    photos = sorted({photo for pair in poses for photo in pair})
    edges = np.searchsorted(photos, np.array(list(poses), np.int64).reshape(-1, 2))
    loops, agree = check_loops(edges, np.array([pose.R for pose in poses.values()]).reshape(-1, 3, 3))
    borne_out = set(loops[agree].ravel().tolist())
    return (
        [pair for k, (pair, pose) in enumerate(poses.items()) if pose.inlier_count < firm and k not in borne_out]
        if len(poses) > 1
        else []
    )


def _split_plausible(
    found: Mapping[PairId, RelativePose | str | None], min_inliers: int
) -> tuple[dict[PairId, RelativePose], dict[PairId, str]]:
    poses, dropped = {}, {}
    for pair, pose in found.items():
        if isinstance(pose, str):
            dropped[pair] = pose
        elif pose is None or pose.inlier_count < min_inliers:
            dropped[pair] = TOO_FEW
        elif pose.in_front < LEAST_IN_FRONT and pose.kind != "rotation":
            dropped[pair] = BEHIND
        else:
            poses[pair] = pose
    return poses, dropped


def _groups(poses: Mapping[PairId, RelativePose]) -> tuple[tuple[int, ...], ...]:
    groups = [tuple(sorted(group)) for group in connected_groups(poses)]
    name = {photo: group for group in groups for photo in group}
    inliers: Counter[tuple[int, ...]] = Counter()
    for pair, pose in poses.items():
        inliers[name[pair[0]]] += pose.inlier_count
    return tuple(sorted(groups, key=lambda group: (-len(group), -inliers[group], group)))
