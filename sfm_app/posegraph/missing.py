"""Missing matches: the points that two photos would share if their relative pose were right.

The points of a photo have depths from other pairs. In the scale of the pair in question, they project into its other
photo, or outside. If the photos are close to each other, points that project inside must have matches there (Zach et
al. 2010, Heinly et al. 2014). One pair alone may miss many, since matching fails in places; all pairs of a photo that
claim the same join miss few together.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.lenses.bearings import bearings, depths_along, project
from sfm_app.geometry.lenses.ray_epipolar import FIRST, SECOND, depths
from sfm_app.posegraph.coverage import Visibility
from sfm_app.types import Calibration, MatchGraph, PairId, RelativePose

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Cameras = Mapping[int, Calibration]
Poses = Mapping[PairId, RelativePose]
Scales = dict[int, float]

MOST_DEG, MOST_SCALE = 20.0, 1.5
"""Largest change of viewing angle, and of scale, at which a point is matched again. 30 degrees and 2 give the same on
oats23 and books21. docs/algorithms.md, Look-alikes."""
BORDER = 0.05
"""Share of width and height: points that project this near the border may be outside. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
WIDE_RAD = 0.2
"""Depths from wider angles get no more weight. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
MIN_COMMON_POINTS = 8
"""Least number of points that two pairs of a photo must share to determine their relative scale. Chosen by hand; halved
and doubled by `benchmarks.sensitivity`."""
MIN_CELL_POINTS = 2
"""A cell of a photo with fewer expected points expects no match. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class PairDepths:
    """Depths of the keypoints of a photo, from one of its pairs."""

    rows: IndexArray
    """(N,) keypoints of the photo."""
    logs: FloatArray
    """(N,) logarithms of their depths; the pair's baseline is 1."""
    weights: FloatArray
    """(N,) weights, by the angles of their rays."""


class Depths:
    """Depths of keypoints in the scale of any pair of their photo.

    Args:
        matches: keypoints.
        cameras: by photo.
        poses: relative poses.
        sight: their inliers.
    """

    def __init__(self, matches: MatchGraph, cameras: Cameras, poses: Poses, sight: Visibility) -> None:
        self.matches, self.cameras, self.poses, self.sight = matches, cameras, poses, sight
        self.lines: dict[int, FloatArray] = {}
        self.known: dict[tuple[int, int], PairDepths] = {}

    def keypoint_bearings(self, photo: int) -> FloatArray:
        """Return the keypoints of a photo as (K, 9) bearing vectors."""
        if photo not in self.lines:
            self.lines[photo] = bearings(self.matches.keypoints[photo], self.cameras[photo])
        return self.lines[photo]

    def pair_depths(self, photo: int, other: int) -> PairDepths:
        """Return the depths of a photo's points from one pair.

        Args:
            photo: the photo, as named in `poses`.
            other: the other photo of the pair; the two have a pose, in either order.
        """
        if (photo, other) in self.known:
            return self.known[photo, other]
        pair = (min(photo, other), max(photo, other))
        pose, rows = self.poses[pair], self.sight.rows[pair]
        used = np.hstack([self.keypoint_bearings(one)[column] for one, column in zip(pair, rows.T, strict=True)])
        found, front = depths(used, pose.R, pose.t), np.ones(len(rows), np.bool_)
        for one in found:
            front &= one > 0
        h1, h2 = used[:, FIRST] @ pose.R.T, used[:, SECOND]
        lengths = np.linalg.norm(h1, axis=1) * np.linalg.norm(h2, axis=1)
        sines = np.linalg.norm(np.cross(h1, h2), axis=1) / lengths
        weights = np.minimum(sines, WIDE_RAD) ** 2 + 1e-6
        for end, names in enumerate((pair, pair[::-1])):
            self.known[names] = PairDepths(rows[front, end], np.log(found[end][front]), weights[front])
        return self.known[photo, other]

    def merge_depths(self, photo: int, trusted: Iterable[int], doubted: Iterable[int]) -> tuple[FloatArray, Scales]:
        """Return (K,) logarithms of depths from trusted pairs, NaN if there is none, and the log scale of each pair.

        Args:
            photo: whose keypoints.
            trusted: photos whose pairs with it determine the depths.
            doubted: photos whose pairs with it only get a scale.
        """
        total = np.zeros((2, len(self.matches.keypoints[photo])))
        scales: Scales = {}
        known = {other: self.pair_depths(photo, other) for other in trusted}
        waiting = sorted(known, key=lambda other: (-float(known[other].weights.sum()), other))
        while waiting:
            other = next((one for one in waiting if _count_common(known[one], total) >= MIN_COMMON_POINTS), waiting[0])
            if scales and _count_common(known[other], total) < MIN_COMMON_POINTS:
                break
            waiting.remove(other)
            end = known[other]
            scales[other] = _log_scale(end, total) if scales else 0.0
            np.add.at(total[0], end.rows, end.weights * (end.logs - scales[other]))
            np.add.at(total[1], end.rows, end.weights)
        for other in doubted:
            end = self.pair_depths(photo, other)
            if _count_common(end, total) >= MIN_COMMON_POINTS:
                scales[other] = _log_scale(end, total)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(total[1] > 0, total[0] / total[1], np.nan), scales

    def expected_points(self, photo: int, other: int, points: IndexArray, logs: FloatArray) -> IndexArray:
        """Return the points of a photo that the other one must show if their pair is right.

        Args:
            photo: whose points.
            other: photo that should show them.
            points: (N,) keypoints.
            logs: (N,) logarithms of their depths in the scale of the pair.
        """
        R, t = _directed_pose(self.poses, photo, other)
        rays_here = self.keypoint_bearings(photo)[points, FIRST]
        z = np.exp(logs)
        turned = rays_here @ R.T
        there = turned * z[:, None] + t
        image, here, camera = self.matches.images[other], self.cameras[photo], self.cameras[other]
        with np.errstate(invalid="ignore", divide="ignore"):
            x = project(there, camera)
            smaller = depths_along(there, camera) / z * here.K[0, 0] / camera.K[0, 0]
            cosines = (turned * there).sum(1) / np.linalg.norm(turned, axis=1) / np.linalg.norm(there, axis=1)
        expected = is_well_inside(x, image.width, image.height) & is_matched_again(smaller, cosines)
        return np.asarray(points[expected], np.int64)


def is_well_inside(x: FloatArray, width: int, height: int) -> NDArray[np.bool_]:
    """Return (N,) whether pixels lie in a photo, and not at its border.

    Args:
        x: (N, 2) pixels; NaN where a point cannot be seen.
        width, height: of the photo.
    """
    size = np.array([width, height], np.float64)
    return np.asarray(((x > BORDER * size) & (x < (1.0 - BORDER) * size)).all(axis=1))


def is_matched_again(smaller: FloatArray, cosines: FloatArray) -> NDArray[np.bool_]:
    """Return (N,) whether points look so much alike in two photos that matching finds them.

    Args:
        smaller: (N,) their size in the first photo over that in the second.
        cosines: (N,) of the angles between their two viewing rays.
    """
    alike = (smaller < MOST_SCALE) & (smaller > 1.0 / MOST_SCALE) & (cosines > np.cos(np.radians(MOST_DEG)))
    return np.asarray(alike, np.bool_)


def count_missing_cells(photo: int, joined: Iterable[int], trusted: Iterable[int], places: Depths) -> tuple[int, int]:
    """Count the cells of a photo that other photos should show if pairs are right, and those of them without a match.

    Args:
        photo: whose cells.
        joined: photos of the pairs in question with it.
        trusted: photos whose pairs with it are trusted.
        places: depths and poses.
    """
    sight, others = places.sight, sorted(joined)
    logs, scales = places.merge_depths(photo, sorted(trusted), others)
    points = np.flatnonzero(~np.isnan(logs))
    wanted, hit = np.zeros(len(logs), np.bool_), np.zeros(len(logs), np.bool_)
    for other in others:
        pair = (min(photo, other), max(photo, other))
        hit[sight.rows[pair][:, pair.index(photo)]] = True
        if other in scales:
            wanted[places.expected_points(photo, other, points, logs[points] + scales[other])] = True
    cells, counts = np.unique(sight.cells[photo][wanted], return_counts=True)
    cells = cells[counts >= MIN_CELL_POINTS]
    return len(cells), int(np.count_nonzero(~np.isin(cells, sight.cells[photo][hit])))


def _directed_pose(poses: Mapping[PairId, RelativePose], photo: int, other: int) -> tuple[FloatArray, FloatArray]:
    if photo < other:
        return poses[photo, other].R, poses[photo, other].t
    pose = poses[other, photo]
    return pose.R.T, -pose.R.T @ pose.t


def _count_common(end: PairDepths, total: FloatArray) -> int:
    return int(np.count_nonzero(total[1, end.rows] > 0))


def _log_scale(end: PairDepths, total: FloatArray) -> float:
    both = total[1, end.rows] > 0
    rows = end.rows[both]
    return float(np.median(end.logs[both] - total[0, rows] / total[1, rows]))
