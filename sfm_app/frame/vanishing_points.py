"""Directions in which many straight lines of a scene run: vertical edges, the horizontals of a facade.

A line segment in a photo and the camera center span a plane; the direction of the line in the world lies in it. So a
segment is represented by the unit normal of the plane, and the segments of all photos with known poses vote together.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sfm_app.geometry.poses import axis_angle_deg, component_along, normalize, perpendicular_basis, smallest_eigenvector
from sfm_app.types.arrays import FloatArray

# Straight line segments in photos.

LONGER_SIDE_PX = 1000
"""Photos are shrunk to this size, which makes edges longer and noise smaller."""

SHORTEST, MOST_SEGMENTS = 0.025, 400
"""Shortest segment as a share of the photo's longer side, and how many of the longest are kept."""


def line_segments(gray: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Find line segments in a gray photo (H, W): (N, 4) x1, y1, x2, y2 in its pixels, longest first.

    Uses LSD (von Gioi, Jakubowicz, Morel and Randall 2010).
    """
    longer = max(gray.shape)
    shrink = min(1.0, LONGER_SIDE_PX / longer)
    size = (max(1, round(gray.shape[1] * shrink)), max(1, round(gray.shape[0] * shrink)))
    small = cv2.resize(gray, size, interpolation=cv2.INTER_AREA) if shrink < 1.0 else gray
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(small)[0]
    if found is None:
        return np.zeros((0, 4))
    # OpenCV puts the center of the top-left pixel at 0
    segments = np.asarray(found, np.float64).reshape(-1, 4) + 0.5
    lengths = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    order = np.argsort(-lengths, kind="stable")[:MOST_SEGMENTS]
    order = order[lengths[order] >= SHORTEST * max(size)]
    return np.asarray(segments[order] * np.tile([gray.shape[1] / size[0], gray.shape[0] / size[1]], 2), np.float64)


SEARCH_DEG, STEP_DEG, WIDTHS_DEG = 28.0, 2.0, (2.0, 1.0, 0.5)
"""Radius and step of the search, and the widths within which segments support a direction, from coarse to fine."""

PRIOR_DEG = 25.0
"""Standard deviation of the true direction from where the search starts."""

MIN_CONTRAST, MIN_LEVEL_CONTRAST = 2.0, 1.4
"""Least ratio of the support of a direction to the 90th percentile of those far from it; the second is for a horizontal
direction together with its perpendicular."""

LEAST_SHARE, LEAST_SEGMENTS = 0.05, 12
"""Least share of the total length, and least number of segments, that a direction needs."""

SEPARATION_DEG = 8.0
"""Directions closer than this are the same."""

LEAST_SINE = 0.05
"""Least sine of the angle between a segment and its vanishing point: bounds the weight of closer segments."""


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Line segments of several photos, in the world."""

    normals: FloatArray
    """(N, 3) unit normals of the planes through camera center and segment."""
    middles: FloatArray
    """(N, 3) unit directions from the camera center to the segments' middles."""
    lengths: FloatArray
    """(N,) in pixels: their weights."""
    photos: NDArray[np.int64]
    """(N,) number of the photo of each segment."""

    def __len__(self) -> int:
        return len(self.normals)

    def take(self, chosen: NDArray[np.bool_]) -> "Segments":
        """Return the chosen segments."""
        return Segments(self.normals[chosen], self.middles[chosen], self.lengths[chosen], self.photos[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class VanishingDirection:
    """A direction that many lines share."""

    direction: FloatArray
    """(3,) unit vector."""
    deviation_deg: float
    """Its standard deviation, from leaving out one photo at a time; inf with a single photo."""
    share: float
    """Length of the segments that run along it, as a share of all."""
    contrast: float
    """Its support over the 90th percentile of those far from it."""


def segment_planes(first: FloatArray, second: FloatArray, photo: int, scale_px: float) -> Segments:
    """Build the segments of one photo from the rays (N, 3), in the world, to their two ends.

    Args:
        first: (N, 3) directions from the camera center to one end of each.
        second: (N, 3) to the other end.
        scale_px: focal length in pixels, to turn angles into lengths.
    """
    a, b = normalize(first), normalize(second)
    cross = np.cross(a, b)
    lengths = scale_px * np.linalg.norm(cross, axis=1)
    return Segments(normalize(cross), normalize(a + b), lengths, np.full(len(a), photo, np.int64))


def concatenate_segments(parts: list[Segments]) -> Segments:
    """Join the segments of several photos."""
    if not parts:
        return Segments(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
    return Segments(
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.middles for part in parts]),
        np.concatenate([part.lengths for part in parts]),
        np.concatenate([part.photos for part in parts]),
    )


def _residuals_deg(direction: FloatArray, segments: Segments) -> FloatArray:
    """Return (N,) angles in [0, 90] between each segment and the line from its middle to the vanishing point."""
    sine = np.abs(component_along(segments.normals, direction))
    away = np.linalg.norm(np.cross(segments.middles, direction), axis=1)
    return np.asarray(np.degrees(np.arcsin(np.clip(sine / np.maximum(away, 1e-9), 0.0, 1.0))), np.float64)


def find_vanishing_direction(start: FloatArray, segments: Segments) -> VanishingDirection | None:
    """Find the direction within `SEARCH_DEG` of `start` that most segments run along; None if none stands out.

    The best direction of a grid is refined with Welsch weights of decreasing width.

    Args:
        start: (3,) unit vector.
    """
    if len(segments) < LEAST_SEGMENTS or not segments.lengths.sum() > 0.0:
        return None
    grid = spherical_cap(start, SEARCH_DEG, STEP_DEG)
    support = np.array([_support(direction, segments, WIDTHS_DEG[0]) for direction in grid])
    prior = np.exp(-0.5 * (axis_angle_deg(grid, start) / PRIOR_DEG) ** 2)
    best = grid[int(np.argmax(support * prior))]
    return _verify_direction(refine_direction(best, segments), grid, support, segments)


def level_direction(up: FloatArray, segments: Segments) -> FloatArray | None:
    """Find the horizontal direction (3,) that most segments are parallel or perpendicular to; None if none stands out.

    Segments on the horizon fit all horizontal directions, and vertical ones fit none: both are left out.

    Args:
        up: (3,) unit vector in the world.
    """
    on_horizon = np.abs(component_along(segments.normals, up)) > np.cos(np.radians(SEPARATION_DEG))
    level = segments.take(~on_horizon & (_residuals_deg(up, segments) > SEPARATION_DEG / 2))
    if len(level) < LEAST_SEGMENTS:
        return None
    e1, e2 = perpendicular_basis(up)
    angles = np.radians(np.arange(0.0, 180.0))
    ring = np.cos(angles)[:, None] * e1 + np.sin(angles)[:, None] * e2
    single = np.array([_support(direction, level, WIDTHS_DEG[0]) for direction in ring])
    both = single + np.roll(single, 90)
    best = int(np.argmax(both))
    best -= 90 if single[best] < single[best - 90] else 0
    away = (np.arange(180) - best + 45) % 90 - 45
    rival = float(np.percentile(both[np.abs(away) > SEPARATION_DEG], 90))
    stands_out = both[best] > MIN_LEVEL_CONTRAST * rival and both[best] > LEAST_SHARE * segments.lengths.sum()
    return np.asarray(ring[best]) if stands_out else None


def fit_orthogonal_frame(up: FloatArray, level: FloatArray, segments: Segments) -> tuple[FloatArray, float]:
    """Fit three perpendicular directions, near up, level and up x level, to the segments along them.

    Horizontal edges determine up as well as vertical ones, and columns taper where cornices do not. Gauss-Newton on
    the rotation with Welsch weights: a rotation by w changes the residual n'd of a segment along d by n'(w x d).

    Args:
        up: (3,) unit vector near the first direction.
        level: (3,) unit vector near the second, perpendicular to `up`.

    Returns:
        (3, 3) with the directions as rows, and the standard deviation of the first in degrees, see
        `VanishingDirection`.
    """
    frame = np.stack([up, level, np.cross(up, level)])
    for width_deg in WIDTHS_DEG:
        for _ in range(10):
            matrices, right = _rotation_equations(frame, segments, width_deg)
            turn = np.linalg.lstsq(matrices.sum(axis=0), right.sum(axis=0), rcond=None)[0]
            frame = Rotation.from_rotvec(turn).apply(frame)
            if float(np.abs(turn).max()) < 1e-10:
                break
    matrices, right = _rotation_equations(frame, segments, WIDTHS_DEG[-1])
    total = matrices.sum(axis=0)
    without = [
        np.linalg.lstsq(total - matrix, right.sum(axis=0) - part, rcond=None)[0]
        for matrix, part in zip(matrices, right, strict=True)
        if matrix.any()
    ]
    moves_deg = np.degrees(np.linalg.norm(np.cross(np.reshape(without, (-1, 3)), frame[0]), axis=1))
    return frame, _jackknife(moves_deg)


def _rotation_equations(frame: FloatArray, segments: Segments, width_deg: float) -> tuple[FloatArray, FloatArray]:
    """Return the normal equations of the rotation vector, per photo (P, 3, 3) and (P, 3)."""
    misses = np.array([_residuals_deg(axis, segments) for axis in frame])
    axes = frame[np.argmin(misses, axis=0)]
    away = np.maximum(np.linalg.norm(np.cross(segments.middles, axes), axis=1), LEAST_SINE)
    weights = segments.lengths * np.exp(-0.5 * (misses.min(axis=0) / width_deg) ** 2) / away**2
    J, r = np.cross(axes, segments.normals), -(segments.normals * axes).sum(axis=1)
    return (
        _sum_per_photo(segments, weights[:, None, None] * J[:, :, None] * J[:, None]),
        _sum_per_photo(segments, (weights * r)[:, None] * J),
    )


def refine_direction(direction: FloatArray, segments: Segments) -> FloatArray:
    """Refine a direction by least squares of its weighted residuals.

    Args:
        direction: (3,) unit vector to start from.
    """
    for width_deg in WIDTHS_DEG:
        for _ in range(10):
            before = direction
            direction = smallest_eigenvector(_scatter_matrices(direction, segments, width_deg).sum(axis=0), direction)
            if float(np.abs(direction - before).max()) < 1e-10:
                break
    return direction


def spherical_cap(axis: FloatArray, radius_deg: float, step_deg: float) -> FloatArray:
    """Return (N, 3) unit vectors spread evenly over a spherical cap around an axis.

    Args:
        axis: (3,) unit vector.
        radius_deg: largest angle from it, degrees.
        step_deg: approximate angle between neighbors, degrees.
    """
    e1, e2 = perpendicular_basis(axis)
    found = [axis[None]]
    for polar in np.radians(np.arange(step_deg, radius_deg + 1e-9, step_deg)):
        around = np.linspace(0.0, 2 * np.pi, max(6, round(2 * np.pi * np.sin(polar) / np.radians(step_deg))), False)
        ring = np.cos(around)[:, None] * e1 + np.sin(around)[:, None] * e2
        found.append(np.cos(polar) * axis + np.sin(polar) * ring)
    return np.concatenate(found)


def _support(direction: FloatArray, segments: Segments, width_deg: float) -> float:
    weights = np.exp(-0.5 * (_residuals_deg(direction, segments) / width_deg) ** 2)
    return float((segments.lengths * weights).sum())


def _scatter_matrices(direction: FloatArray, segments: Segments, width_deg: float) -> FloatArray:
    """Return (P, 3, 3), per photo the sum of n n' over its segments, weighted for least squares of the residuals."""
    away = np.maximum(np.linalg.norm(np.cross(segments.middles, direction), axis=1), LEAST_SINE)
    weights = segments.lengths * np.exp(-0.5 * (_residuals_deg(direction, segments) / width_deg) ** 2) / away**2
    n = segments.normals
    return _sum_per_photo(segments, weights[:, None, None] * n[:, :, None] * n[:, None])


def _sum_per_photo(segments: Segments, values: FloatArray) -> FloatArray:
    """Sum values (N, ...) over the segments of each photo."""
    sums = np.zeros((int(segments.photos.max(initial=-1)) + 1, *values.shape[1:]))
    np.add.at(sums, segments.photos, values)
    return sums


def _verify_direction(
    found: FloatArray, tried: FloatArray, support: FloatArray, segments: Segments
) -> VanishingDirection | None:
    """Return the direction with its evidence, if it stands out from the tried ones far from it."""
    running = _residuals_deg(found, segments) < WIDTHS_DEG[0]
    share = float(segments.lengths[running].sum() / segments.lengths.sum())
    away = axis_angle_deg(tried, found) > SEPARATION_DEG
    if away.all():  # refined out of the region of the search
        return None
    contrast = float(support[~away].max()) / max(float(np.percentile(support[away], 90)), 1e-12)
    enough = np.count_nonzero(running) >= LEAST_SEGMENTS and share >= LEAST_SHARE and contrast >= MIN_CONTRAST
    return VanishingDirection(found, _direction_deviation_deg(found, segments), share, contrast) if enough else None


def _direction_deviation_deg(found: FloatArray, segments: Segments) -> float:
    matrices = _scatter_matrices(found, segments, WIDTHS_DEG[-1])
    total = matrices.sum(axis=0)
    without = [smallest_eigenvector(total - matrix, found) for matrix in matrices if matrix.any()]
    return _jackknife(axis_angle_deg(np.reshape(without, (-1, 3)), found))


def _jackknife(moves: FloatArray) -> float:
    """Return the jackknife standard deviation, leaving out photos: the segments of one photo err together."""
    n = len(moves)
    return float(np.sqrt((n - 1) / n * (moves**2).sum())) if n > 1 else float("inf")
