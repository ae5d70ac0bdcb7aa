"""Vanishing directions, in which many straight lines of a scene run: vertical edges, the horizontals of a facade.

A line segment in a photo and the camera center span a plane that contains the direction of the line in the world. So
the unit normal of the plane represents a segment, and the segments of all posed photos vote together.
"""

from typing import NamedTuple

import cv2
import numpy as np

from sfm_app.geometry.poses import axis_angle_deg, component_along, normalize, perpendicular_basis, smallest_eigenvector
from sfm_app.types.arrays import ByteArray, FloatArray, IndexArray


class OPTIONS:
    """Constants of line segments and vanishing directions."""

    longer_side_px: int = 1000
    """Size to which photos are reduced, which makes edges longer and noise smaller."""
    min_length: float = 0.025
    """Least length of a segment, as a share of the photo's longer side."""
    max_segments: int = 400
    search_deg: float = 28.0
    """Radius of the search for a direction."""
    step_deg: float = 2.0
    widths_deg: tuple[float, ...] = (2.0, 1.0, 0.5)
    """Widths within which segments support a direction, from coarse to fine."""
    prior_deg: float = 25.0
    """Standard deviation of the true direction from the start of the search."""
    min_contrast: float = 2.0
    """Least ratio of a direction's support to the 90th percentile of those far from it."""
    min_level_contrast: float = 1.4
    """The same for a horizontal direction together with its perpendicular."""
    min_share: float = 0.05
    """Least share of the total length of a direction's segments."""
    min_segments: int = 12
    separation_deg: float = 8.0
    """Directions closer than this are the same."""
    min_sine: float = 0.05
    """Least sine of the angle between a segment and its vanishing point; bounds the weight of closer segments."""


def line_segments(gray: ByteArray) -> FloatArray:
    """Find line segments (N, 4) x1, y1, x2, y2 in a gray photo, longest first, by LSD (von Gioi et al. 2010)."""
    small = shrink(gray, OPTIONS.longer_side_px)
    size = small.shape[::-1]
    detected = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(small)[0]
    if detected is None:
        return np.zeros((0, 4))
    # OpenCV puts the center of the top-left pixel at 0
    segments = np.asarray(detected, np.float64).reshape(-1, 4) + 0.5
    lengths = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    order = np.argsort(-lengths, kind="stable")[: OPTIONS.max_segments]
    order = order[lengths[order] >= OPTIONS.min_length * max(size)]
    return np.asarray(segments[order] * np.tile([gray.shape[1] / size[0], gray.shape[0] / size[1]], 2), np.float64)


def shrink(gray: ByteArray, longer_side_px: int) -> ByteArray:
    """Return a gray photo (H, W) whose longer side is at most this long."""
    scale = min(1.0, longer_side_px / max(gray.shape))
    size = (max(1, round(gray.shape[1] * scale)), max(1, round(gray.shape[0] * scale)))
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)


class Segments(NamedTuple):
    """Line segments of several photos, in the world."""

    normals: FloatArray
    """(N, 3) unit normals of the planes through camera center and segment."""
    middles: FloatArray
    """(N, 3) unit directions from the camera center to the segments' middles."""
    lengths: FloatArray
    """(N,) weights, the lengths in pixels."""
    photos: IndexArray
    """(N,) number of each segment's photo."""


def segment_planes(first: FloatArray, second: FloatArray, photo: int, scale_px: float) -> Segments:
    """Build the segments of one photo with a focal length from the rays (N, 3), in the world, to their two ends."""
    a, b = normalize(first), normalize(second)
    cross = np.cross(a, b)
    lengths = scale_px * np.linalg.norm(cross, axis=1)
    return Segments(normalize(cross), normalize(a + b), lengths, np.full(len(a), photo, np.int64))


def concatenate_segments(parts: list[Segments]) -> Segments:
    """Join the segments of several photos."""
    nothing = Segments(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
    return Segments(*map(np.concatenate, zip(nothing, *parts, strict=True)))


def _residuals_deg(direction: FloatArray, segments: Segments) -> FloatArray:
    """Return the angles (N,) in [0, 90] between each segment and the line from its middle to the vanishing point."""
    sine = np.abs(component_along(segments.normals, direction))
    away = np.linalg.norm(np.cross(segments.middles, direction), axis=1)
    return np.asarray(np.degrees(np.arcsin(np.clip(sine / np.maximum(away, 1e-9), 0.0, 1.0))), np.float64)


def find_vanishing_direction(start: FloatArray, segments: Segments) -> tuple[FloatArray, float] | None:
    """Find the direction (3,) of most segments near a unit vector (3,), from a grid refined with Welsch weights.

    Its standard deviation, in degrees, is by the jackknife over photos, and inf with a single photo.
    """
    if len(segments.normals) < OPTIONS.min_segments or not segments.lengths.sum() > 0.0:
        return None
    grid = spherical_cap(start, OPTIONS.search_deg, OPTIONS.step_deg)
    support = np.array([_support(direction, segments, OPTIONS.widths_deg[0]) for direction in grid])
    prior = np.exp(-0.5 * (axis_angle_deg(grid, start) / OPTIONS.prior_deg) ** 2)
    best = grid[int(np.argmax(support * prior))]
    return _verify_direction(refine_direction(best, segments), grid, support, segments)


def level_direction(up: FloatArray, segments: Segments) -> FloatArray | None:
    """Find the horizontal direction (3,) with most parallel or perpendicular segments; None if none stands out.

    Segments on the horizon fit all horizontal directions, and vertical ones fit none: both are excluded. `up` is a unit
    vector (3,) in the world.
    """
    on_horizon = np.abs(component_along(segments.normals, up)) > np.cos(np.radians(OPTIONS.separation_deg))
    chosen = ~on_horizon & (_residuals_deg(up, segments) > OPTIONS.separation_deg / 2)
    level = Segments(*(column[chosen] for column in segments))
    if len(level.normals) < OPTIONS.min_segments:
        return None
    e1, e2 = perpendicular_basis(up)
    angles = np.radians(np.arange(0.0, 180.0))
    ring = np.cos(angles)[:, None] * e1 + np.sin(angles)[:, None] * e2
    single = np.array([_support(direction, level, OPTIONS.widths_deg[0]) for direction in ring])
    both = single + np.roll(single, 90)
    best = int(np.argmax(both))
    best -= 90 if single[best] < single[best - 90] else 0
    away = (np.arange(180) - best + 45) % 90 - 45
    rival = float(np.percentile(both[np.abs(away) > OPTIONS.separation_deg], 90))
    stands_out = (
        both[best] > OPTIONS.min_level_contrast * rival and both[best] > OPTIONS.min_share * segments.lengths.sum()
    )
    return np.asarray(ring[best]) if stands_out else None


def fit_orthogonal_frame(up: FloatArray, level: FloatArray, segments: Segments) -> tuple[FloatArray, float]:
    """Fit three perpendicular directions, near up, level and up x level, to the segments along them.

    Return them as rows (3, 3), and the standard deviation of the first in degrees. Horizontal edges determine up as
    well as vertical ones, and columns taper where cornices do not. Gauss-Newton on the rotation with Welsch weights: a
    rotation by w changes the residual n'd of a segment along d by n'(w x d). `up` and `level` are perpendicular unit
    vectors (3,).
    """
    from scipy.spatial.transform import Rotation

    frame = np.stack([up, level, np.cross(up, level)])
    for width_deg in OPTIONS.widths_deg:
        for _ in range(10):
            matrices, right = _rotation_equations(frame, segments, width_deg)
            rotation = np.linalg.lstsq(matrices.sum(axis=0), right.sum(axis=0), rcond=None)[0]
            frame = Rotation.from_rotvec(rotation).apply(frame)
            if float(np.abs(rotation).max()) < 1e-10:
                break
    matrices, right = _rotation_equations(frame, segments, OPTIONS.widths_deg[-1])
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
    residuals = np.array([_residuals_deg(axis, segments) for axis in frame])
    axes = frame[np.argmin(residuals, axis=0)]
    away = np.maximum(np.linalg.norm(np.cross(segments.middles, axes), axis=1), OPTIONS.min_sine)
    weights = segments.lengths * np.exp(-0.5 * (residuals.min(axis=0) / width_deg) ** 2) / away**2
    J, r = np.cross(axes, segments.normals), -(segments.normals * axes).sum(axis=1)
    return (
        _sum_per_photo(segments, weights[:, None, None] * J[:, :, None] * J[:, None]),
        _sum_per_photo(segments, (weights * r)[:, None] * J),
    )


def refine_direction(direction: FloatArray, segments: Segments) -> FloatArray:
    """Refine a direction (3,) by least squares of its weighted residuals."""
    for width_deg in OPTIONS.widths_deg:
        for _ in range(10):
            before = direction
            direction = smallest_eigenvector(_scatter_matrices(direction, segments, width_deg).sum(axis=0), direction)
            if float(np.abs(direction - before).max()) < 1e-10:
                break
    return direction


def spherical_cap(axis: FloatArray, radius_deg: float, step_deg: float) -> FloatArray:
    """Return unit vectors (N, 3) over a spherical cap around an axis (3,), with about `step_deg` between neighbors."""
    e1, e2 = perpendicular_basis(axis)
    rings = [axis[None]]
    for polar in np.radians(np.arange(step_deg, radius_deg + 1e-9, step_deg)):
        azimuth = np.linspace(0.0, 2 * np.pi, max(6, round(2 * np.pi * np.sin(polar) / np.radians(step_deg))), False)
        ring = np.cos(azimuth)[:, None] * e1 + np.sin(azimuth)[:, None] * e2
        rings.append(np.cos(polar) * axis + np.sin(polar) * ring)
    return np.concatenate(rings)


def _support(direction: FloatArray, segments: Segments, width_deg: float) -> float:
    weights = np.exp(-0.5 * (_residuals_deg(direction, segments) / width_deg) ** 2)
    return float((segments.lengths * weights).sum())


def _scatter_matrices(direction: FloatArray, segments: Segments, width_deg: float) -> FloatArray:
    """Return per photo (P, 3, 3) the sum of n n' over its segments, weighted for least squares of the residuals."""
    away = np.maximum(np.linalg.norm(np.cross(segments.middles, direction), axis=1), OPTIONS.min_sine)
    weights = segments.lengths * np.exp(-0.5 * (_residuals_deg(direction, segments) / width_deg) ** 2) / away**2
    n = segments.normals
    return _sum_per_photo(segments, weights[:, None, None] * n[:, :, None] * n[:, None])


def _sum_per_photo(segments: Segments, values: FloatArray) -> FloatArray:
    sums = np.zeros((int(segments.photos.max(initial=-1)) + 1, *values.shape[1:]))
    np.add.at(sums, segments.photos, values)
    return sums


def _verify_direction(
    direction: FloatArray, grid: FloatArray, support: FloatArray, segments: Segments
) -> tuple[FloatArray, float] | None:
    """Return the direction with its deviation if it stands out from the directions of the grid far from it."""
    along = _residuals_deg(direction, segments) < OPTIONS.widths_deg[0]
    share = float(segments.lengths[along].sum() / segments.lengths.sum())
    far = axis_angle_deg(grid, direction) > OPTIONS.separation_deg
    if far.all():  # refined out of the region of the search
        return None
    contrast = float(support[~far].max()) / max(float(np.percentile(support[far], 90)), 1e-12)
    if not (
        np.count_nonzero(along) >= OPTIONS.min_segments
        and share >= OPTIONS.min_share
        and contrast >= OPTIONS.min_contrast
    ):
        return None
    matrices = _scatter_matrices(direction, segments, OPTIONS.widths_deg[-1])
    total = matrices.sum(axis=0)
    without = [smallest_eigenvector(total - matrix, direction) for matrix in matrices if matrix.any()]
    return direction, _jackknife(axis_angle_deg(np.reshape(without, (-1, 3)), direction))


def _jackknife(moves: FloatArray) -> float:
    """Return the jackknife standard deviation over photos: the segments of one photo err together."""
    n = len(moves)
    return float(np.sqrt((n - 1) / n * (moves**2).sum())) if n > 1 else float("inf")
