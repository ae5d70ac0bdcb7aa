"""The pose graph: relative poses of pairs that agree with each other."""

import logging
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from sfm_app.geometry.epipolar import FIRST, SECOND
from sfm_app.geometry.poses import is_in_front, pose_distances
from sfm_app.numerical import FAILURES
from sfm_app.posegraph.look_alikes import find_look_alikes
from sfm_app.posegraph.pair_pose import Pair, estimate_pose, refine_pose
from sfm_app.posegraph.rotations import average_rotations, check_loops, connected_groups
from sfm_app.types import EpipolarGeometry, Evidence, PairId, PoseGraph, RelativePose
from sfm_app.types.arrays import FloatArray

logger = logging.getLogger("sfm_app")

ParallelMap = Callable[[Callable[[Any], Any], Sequence[Any], str], list[Any]]
"""Results of a function in the order of its arguments, computed in parallel; the text labels a progress bar."""

CONTRADICTS, BEHIND, TOO_FEW = "contradicts other pairs", "points behind a camera", "too few matches fit the cameras"
NOT_COMPUTABLE = "its pose cannot be computed"
UNCONFIRMED = "few matches, and no other pair bears it out"
LOOKS_ALIKE = "equal things in different places"

# Poses with the rotation known from other pairs. F of few matches on a facade also fits mismatches. With the rotation
# from loops of other pairs, two matches determine the direction of translation.


class GUIDED:
    """Poses with a known rotation; docs/algorithms/relative-poses.md."""

    samples: int = 200
    """Samples of two matches, each of which gives a direction. Chosen by hand."""
    min_kept_share: float = 0.9
    """Share of its inliers that a pose must keep with the rotation of the other pairs. Chosen by hand."""
    near_thresholds: float = 3.0
    """Largest distance of the matches that are refined, in inlier thresholds. Chosen by hand."""
    min_in_front: float = 0.95
    """Share of the inliers that must lie in front of both cameras. Measured on photo sets with truth."""
    max_rotation_deg: float = 2.0
    """Largest change of the rotation by refinement. Measured on photo sets with truth."""


def guided_pose(pair: Pair, R: FloatArray, min_inliers: int, seed: int) -> RelativePose | None:
    """Estimate the pose of a pair with a known rotation R (3, 3); None if its matches do not confirm it."""
    from scipy.spatial.transform import Rotation

    if len(pair.lines) < min_inliers:
        return None
    t = sample_direction(pair, R, np.random.default_rng(seed))
    if t is None:
        return None
    near = pose_distances(pair.lines, R, t) <= GUIDED.near_thresholds * pair.max_error_px
    if np.count_nonzero(near) < min_inliers:
        return None
    refined_R, refined_t = refine_pose(pair.lines[near], R, t)
    inliers = pair.inliers(refined_R, refined_t)
    if np.degrees(Rotation.from_matrix(R.T @ refined_R).magnitude()) > GUIDED.max_rotation_deg:
        least = GUIDED.min_kept_share * np.count_nonzero(inliers)
        refined_R, refined_t, inliers = R, t, pair.inliers(R, t)
        if np.count_nonzero(inliers) < least:
            return None
    if np.count_nonzero(inliers) < min_inliers:
        return None
    pose = pair.pose(refined_R, refined_t, inliers, guided=True)
    return pose if pose.in_front >= GUIDED.min_in_front and pose.kind != "rotation" else None


def sample_direction(pair: Pair, R: FloatArray, rng: np.random.Generator) -> FloatArray | None:
    """Estimate the direction of translation (3,) by samples of two matches, given R; None if no sample gives one."""
    # the translation is perpendicular to each of them
    normals = np.cross(pair.lines[:, FIRST] @ R.T, pair.lines[:, SECOND])
    picks = rng.integers(len(normals), size=(GUIDED.samples, 2))
    directions = np.cross(normals[picks[:, 0]], normals[picks[:, 1]])
    lengths = np.linalg.norm(directions, axis=1)
    best, lowest = None, np.inf
    for t in directions[lengths > 1e-12] / lengths[lengths > 1e-12, None]:
        distances = pose_distances(pair.lines, R, t) / pair.max_error_px
        cost = float(np.sum(distances**2 / (1.0 + distances**2)))
        if cost < lowest:
            best, lowest = np.asarray(t, np.float64), cost
    if best is None:
        return None
    # t and -t have the same epipolar lines
    front, behind = (np.count_nonzero(is_in_front(pair.lines, R, sign * best)) for sign in (1.0, -1.0))
    return best if front >= behind else -best


class OPTIONS:
    """Which pairs stay; docs/algorithms/relative-poses.md."""

    min_in_front: float = 0.75
    """Least share of the inliers of a pair in front of both cameras. Chosen by hand."""
    agreement_deg: float = 5.0
    """Largest angle between the rotation of a pair and those of its photos. Chosen by hand."""
    guessed_deg: float = 15.0
    """The same if a camera is a guess. Chosen by hand."""
    spreads: float = 4.0
    """The limit as a multiple of the median angle; the larger limit holds. Chosen by hand."""
    saturation_inliers: float = 100.0
    """Number of inliers above which the weight of a pair hardly grows. Chosen by hand."""
    flat_weight: float = 0.1
    """Weight factor of pairs on a plane, which two poses explain. Chosen on kitchen25."""
    weak_factor: float = 2.0
    """A pair with fewer inliers than this multiple of the minimum needs a loop of other pairs. Chosen by hand."""


NO_POSES: Mapping[PairId, RelativePose] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class PoseGraphOptions:
    """Options for estimating and rejecting pairs."""

    max_error_px: float
    """Largest Sampson distance of an inlier."""
    min_inliers: int
    """A pair with fewer is dropped."""
    seed: int
    look_alikes: bool = True
    """Whether pairs of look-alikes are left out."""


def build_pose_graph(
    evidence: Evidence, options: PoseGraphOptions, run_map: ParallelMap, known: Mapping[PairId, RelativePose] = NO_POSES
) -> PoseGraph:
    """Build the graph of relative poses without contradicting pairs; `known` poses are not estimated again."""
    matches, views = evidence.matches, evidence.views
    estimator = _PoseEstimator(evidence, options)
    fits = {pair: fit for pair, fit in views.fits.items() if pair not in known}
    estimates = dict(zip(fits, run_map(estimator.from_fit, list(fits.items()), "relative poses"), strict=True))
    poses, dropped = _split_plausible(estimates, options.min_inliers)
    poses |= known
    cameras = {photo: evidence.camera(photo) for photo in matches.images}
    look_alikes = find_look_alikes(matches, poses if options.look_alikes else {}, cameras)
    _drop_pairs([pair for join in look_alikes.joins for pair in join.pairs], LOOKS_ALIKE, poses, dropped)
    estimator.rotations, angles = average_pair_rotations(poses, {p for p, fit in views.fits.items() if fit.degeneracy})
    _drop_pairs(_contradicting_pairs(poses, angles), CONTRADICTS, poses, dropped)

    rest = [pair for pair in _pairs_without_pose(matches.matches, poses, known) if dropped.get(pair) != LOOKS_ALIKE]
    for pair, pose in zip(rest, run_map(estimator.from_rotations, rest, "poses by known rotations"), strict=True):
        if pose is not None and not look_alikes.is_look_alike(pair, matches.matches[pair][pose.inliers]):
            poses[pair] = pose
            dropped.pop(pair, None)
    poses = dict(sorted(poses.items()))
    _drop_pairs(_unconfirmed_pairs(poses, OPTIONS.weak_factor * options.min_inliers), UNCONFIRMED, poses, dropped)
    doubtful = (replace(join, pairs=tuple(p for p in join.pairs if p in poses)) for join in look_alikes.doubtful)
    return PoseGraph(poses, dropped, _groups(poses), look_alikes.joins, tuple(join for join in doubtful if join.pairs))


class _PoseEstimator:
    def __init__(self, evidence: Evidence, options: PoseGraphOptions) -> None:
        self.evidence, self.options = evidence, options
        self.rotations: Mapping[int, FloatArray] = {}

    def _pair(self, pair: PairId) -> Pair:
        cameras = [self.evidence.camera(photo) for photo in pair]
        return Pair(self.evidence.matches.points(pair), cameras, self.options.max_error_px)

    def from_fit(self, item: tuple[PairId, EpipolarGeometry]) -> RelativePose | str | None:
        try:
            return estimate_pose(self._pair(item[0]), item[1])
        except FAILURES as err:
            logger.info("pair %s has no pose", item[0], exc_info=err)
            return NOT_COMPUTABLE

    def from_rotations(self, pair: PairId) -> RelativePose | None:
        seed = int(np.random.SeedSequence([self.options.seed, *pair]).generate_state(1)[0])
        matched = self._pair(pair)
        R = self.rotations[pair[1]] @ self.rotations[pair[0]].T
        try:
            return guided_pose(matched, R, self.options.min_inliers, seed) if matched.trusted else None
        except FAILURES:  # the reason that it has no pose is already recorded
            return None


def _drop_pairs(
    pairs: Iterable[PairId], reason: str, poses: dict[PairId, RelativePose], dropped: dict[PairId, str]
) -> None:
    for pair in pairs:
        dropped[pair] = reason
        del poses[pair]


def with_model(graph: PoseGraph, photos: Collection[int], poses: Mapping[PairId, RelativePose]) -> PoseGraph:
    """Replace the relative poses between the photos of a model by the poses of the model."""
    others = {pair: pose for pair, pose in graph.poses.items() if not (pair[0] in photos and pair[1] in photos)}
    replaced = sorted(graph.poses.keys() - others.keys() - poses.keys())
    reasons = dict(graph.dropped) | dict.fromkeys(replaced, CONTRADICTS)
    merged = dict(sorted((others | dict(poses)).items()))
    dropped = {pair: reason for pair, reason in reasons.items() if pair not in merged}
    return replace(graph, poses=merged, dropped=dropped, groups=_groups(merged))


def _pairs_without_pose(
    pairs: Iterable[PairId], poses: Mapping[PairId, RelativePose], known: Collection[PairId]
) -> list[PairId]:
    known_photos = {photo for pair in known for photo in pair}
    pairs = [pair for pair in pairs if not known_photos.issuperset(pair)]
    group = {photo: number for number, photos in enumerate(_groups(poses)) for photo in photos}
    return [pair for pair in pairs if pair not in poses and group.get(pair[0], -1) == group.get(pair[1], -2)]


def _contradicting_pairs(poses: Mapping[PairId, RelativePose], angles: Mapping[PairId, float]) -> list[PairId]:
    """Return the pairs whose angles in degrees to the rotations of their photos exceed the limit."""
    typical = OPTIONS.spreads * float(np.median(list(angles.values()) or [0.0]))
    limits = {
        pair: max(typical, OPTIONS.guessed_deg if poses[pair].kind == "uncalibrated" else OPTIONS.agreement_deg)
        for pair in angles
    }
    return [pair for pair, angle in angles.items() if angle > limits[pair]]


def average_pair_rotations(
    poses: Mapping[PairId, RelativePose], flat: Collection[PairId] = ()
) -> tuple[dict[int, FloatArray], dict[PairId, float]]:
    """Average the rotations of pairs, of little weight if `flat`, to those of photos; return these and the angles."""
    weights = {
        pair: pose.inlier_count
        / (1.0 + pose.inlier_count / OPTIONS.saturation_inliers)
        * (OPTIONS.flat_weight if pair in flat else 1.0)
        for pair, pose in poses.items()
    }
    return average_rotations({pair: pose.R for pair, pose in poses.items()}, weights)


def _unconfirmed_pairs(poses: Mapping[PairId, RelativePose], firm: float) -> list[PairId]:
    """Return the pairs with fewer than `firm` inliers that no loop confirms: they may join look-alikes."""
    photos = sorted({photo for pair in poses for photo in pair})
    edges = np.searchsorted(photos, np.array(list(poses), np.int64).reshape(-1, 2))
    loops, agree = check_loops(edges, np.array([pose.R for pose in poses.values()]).reshape(-1, 3, 3))
    confirmed = set(loops[agree].ravel().tolist())
    return (
        [pair for k, (pair, pose) in enumerate(poses.items()) if pose.inlier_count < firm and k not in confirmed]
        if len(poses) > 1
        else []
    )


def _split_plausible(
    estimates: Mapping[PairId, RelativePose | str | None], min_inliers: int
) -> tuple[dict[PairId, RelativePose], dict[PairId, str]]:
    poses, dropped = {}, {}
    for pair, pose in estimates.items():
        if isinstance(pose, str):
            dropped[pair] = pose
        elif pose is None or pose.inlier_count < min_inliers:
            dropped[pair] = TOO_FEW
        elif pose.in_front < OPTIONS.min_in_front and pose.kind != "rotation":
            dropped[pair] = BEHIND
        else:
            poses[pair] = pose
    return poses, dropped


def _groups(poses: Mapping[PairId, RelativePose]) -> tuple[tuple[int, ...], ...]:
    groups = [tuple(sorted(group)) for group in connected_groups(poses)]
    group_of = {photo: group for group in groups for photo in group}
    inliers: Counter[tuple[int, ...]] = Counter()
    for pair, pose in poses.items():
        inliers[group_of[pair[0]]] += pose.inlier_count
    return tuple(sorted(groups, key=lambda group: (-len(group), -inliers[group], group)))
