"""Pairs of photos that a mapping can start from, best first."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sfm_app.geometry.epipolar import cross_matrix
from sfm_app.geometry.lenses.bearings import bearings, plane_points
from sfm_app.geometry.two_view_init import GOOD_ANGLE_DEG, TwoViewSeed, ray_seed, two_view_seed
from sfm_app.types import Calibration, Intrinsics, MatchGraph, PairId, PoseGraph, RelativePose
from sfm_app.types.calibration import PERSPECTIVE

DISSENT_WEIGHT = 0.1
"""Weight of a seed whose pair contradicts the camera matrix that other pairs agree on."""
PLANAR_WEIGHT = 0.5
"""Weight of a seed whose points lie on a plane, or whose camera moved along its axis: its pose is less certain."""
FORWARD = 0.95
"""Share of the translation along the camera's axis above which the motion counts as forward."""
GRID = 8
"""Number of cells across and down a photo, for its coverage: spread points make a better start than a cluster."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidate:
    """A pair of photos that mapping may start from."""

    pair: PairId
    pose: RelativePose
    score: float


def rank_seeds(
    matches: MatchGraph, graph: PoseGraph, intrinsics: Intrinsics, photos: Sequence[int], min_angle_deg: float
) -> list[Candidate]:
    """Return candidates for the first pair, best first: many well-spread points, wide angles, consistent with K.

    Args:
        matches: keypoints and raw matches.
        graph: relative poses.
        intrinsics: cameras from pairs.
        photos: ids of the group; both photos of a candidate belong to it.
        min_angle_deg: smallest median triangulation angle, degrees.
    """
    members, found = set(photos), []
    for pair, pose in graph.poses.items():
        if members.issuperset(pair) and pose.kind != "rotation" and pose.angle_deg >= min_angle_deg:
            cameras = [intrinsics.camera(matches.images[photo]) for photo in pair]
            worth = coverage(matches, pair, pose) * agreement(pair, cameras)
            worth *= PLANAR_WEIGHT if pose.kind == "planar" or abs(pose.t[2]) > FORWARD else 1.0
            score = pose.inlier_count * min(pose.angle_deg / GOOD_ANGLE_DEG, 1.0) * pose.in_front**4 * worth
            found.append(Candidate(pair, pose, score))
    return sorted(found, key=lambda candidate: (-candidate.score, candidate.pair))


def triangulate_seed(matches: MatchGraph, candidate: Candidate, intrinsics: Intrinsics) -> TwoViewSeed:
    """Return the pose and triangulated points of a candidate.

    Args:
        matches: keypoints and raw matches.
        candidate: pair and pose.
        intrinsics: cameras from pairs.
    """
    pose, cameras = candidate.pose, [intrinsics.camera(matches.images[photo]) for photo in candidate.pair]
    points = matches.points(candidate.pair)
    if any(camera.projection != PERSPECTIVE for camera in cameras):
        lines = np.hstack([bearings(x[pose.inliers], camera) for x, camera in zip(points, cameras, strict=True)])
        return ray_seed(pose.R, pose.t, lines)
    x1, x2 = (plane_points(x[pose.inliers], camera) for x, camera in zip(points, cameras, strict=True))
    return two_view_seed(cross_matrix(pose.t) @ pose.R, x1, x2)


def agreement(pair: PairId, cameras: Sequence[Calibration]) -> float:
    """Return the weight of a pair: 1 unless it contradicts the camera that other pairs agree on.

    Args:
        pair: ids of two photos.
        cameras: cameras of the two photos.
    """
    first, second = cameras
    unknown = first is not second or not first.key_pairs
    return 1.0 if unknown or pair in first.key_pairs else DISSENT_WEIGHT


def coverage(matches: MatchGraph, pair: PairId, pose: RelativePose) -> float:
    """Return the share of cells with an inlier, of those that the inliers could fill; geometric mean of both photos.

    Args:
        matches: keypoints and raw matches.
        pair: ids of two photos.
        pose: relative pose of the pair, with its inliers.
    """
    shares = []
    for photo, x in zip(pair, matches.points(pair), strict=True):
        image = matches.images[photo]
        cells = (x[pose.inliers] / [image.width, image.height] * GRID).astype(np.int64).clip(0, GRID - 1)
        filled = len(np.unique(cells[:, 0] * GRID + cells[:, 1]))
        shares.append(filled / min(GRID * GRID, max(pose.inlier_count, 1)))
    return float(np.sqrt(shares[0] * shares[1]))
