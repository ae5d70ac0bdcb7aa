"""Directions in which many straight lines of a scene run: vertical edges, the horizontals of a facade.

A line segment in a photo and the camera center span a plane; the direction of the line in the world lies in it. So a
segment is the plane's unit normal, and segments of all photos of a scene with known poses vote together.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sfm_app.geometry.unit_vectors import along, axis_angle_deg, basis_across, least_direction, unit

FloatArray = NDArray[np.float64]

SEARCH_DEG, STEP_DEG, WIDTHS_DEG = 28.0, 2.0, (2.0, 1.0, 0.5)
"""Radius and step of the search, and how near a segment is to a direction that it supports: coarse, then finer."""

PRIOR_DEG = 25.0
"""Standard deviation of the true direction from where the search starts."""

STANDS_OUT, LEVEL_STANDS_OUT = 2.0, 1.4
"""Support that a direction needs, over that of nine in ten of those far from it; a horizontal one, with its partner."""

LEAST_SHARE, LEAST_SEGMENTS = 0.05, 12
"""Share of all lengths and number of segments that it needs."""

APART_DEG = 8.0
"""Directions nearer than this are one."""

LEAST_SINE = 0.05
"""Of the angle between a segment and its vanishing point; nearer ones say little, and must not count without end."""


@dataclass(frozen=True, slots=True, eq=False)
class Segments:
    """Line segments of several photos, in the world."""

    normals: FloatArray
    """(N, 3) unit normals of the planes through camera center and segment."""
    middles: FloatArray
    """(N, 3) unit directions from the camera center to the segments' middles."""
    lengths: FloatArray
    """(N,) in pixels: what they count."""
    photos: NDArray[np.int64]
    """(N,) number of the photo each lies in."""

    def __len__(self) -> int:
        return len(self.normals)

    def take(self, chosen: NDArray[np.bool_]) -> "Segments":
        """Return some of them."""
        return Segments(self.normals[chosen], self.middles[chosen], self.lengths[chosen], self.photos[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Vanishing:
    """A direction in which lines run."""

    direction: FloatArray
    """(3,) unit vector."""
    deviation_deg: float
    """Its standard deviation, from leaving out one photo at a time; inf with a single photo."""
    share: float
    """Length of the segments that run along it, as a share of all."""
    contrast: float
    """Its support over that of nine in ten directions far from it."""


def segment_planes(first: FloatArray, second: FloatArray, photo: int, scale_px: float) -> Segments:
    """Return segments of one photo from the rays (N, 3), in the world, to their two ends.

    Args:
        first: (N, 3) directions from the camera center to one end of each.
        second: (N, 3) to the other end.
        photo: the photo's number.
        scale_px: focal length in pixels, to turn angles into lengths.
    """
    a, b = unit(first), unit(second)
    cross = np.cross(a, b)
    lengths = scale_px * np.linalg.norm(cross, axis=1)
    return Segments(unit(cross), unit(a + b), lengths, np.full(len(a), photo, np.int64))


def joined(parts: list[Segments]) -> Segments:
    """Return all segments of several photos."""
    if not parts:
        return Segments(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
    return Segments(
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.middles for part in parts]),
        np.concatenate([part.lengths for part in parts]),
        np.concatenate([part.photos for part in parts]),
    )


def _misses_deg(direction: FloatArray, segments: Segments) -> FloatArray:
    """Return (N,) angle in the photo between each segment and the line from its middle to the vanishing point.

    [0, 90].
    """
    sine = np.abs(along(segments.normals, direction))
    away = np.linalg.norm(np.cross(segments.middles, direction), axis=1)
    return np.asarray(np.degrees(np.arcsin(np.clip(sine / np.maximum(away, 1e-9), 0.0, 1.0))), np.float64)


def vanishing_near(start: FloatArray, segments: Segments) -> Vanishing | None:
    """Return the direction within `SEARCH_DEG` of `start` that most segments run along; None where none stands out.

    An exhaustive search on a grid, then Welsch's weights around the best of it, ever narrower.

    Args:
        start: (3,) unit vector.
        segments: of all photos.
    """
    if len(segments) < LEAST_SEGMENTS or not segments.lengths.sum() > 0.0:
        return None
    grid = cap(start, SEARCH_DEG, STEP_DEG)
    support = np.array([_support(direction, segments, WIDTHS_DEG[0]) for direction in grid])
    prior = np.exp(-0.5 * (axis_angle_deg(grid, start) / PRIOR_DEG) ** 2)
    best = grid[int(np.argmax(support * prior))]
    return _judged(refined(best, segments), grid, support, segments)


def level_direction(up: FloatArray, segments: Segments) -> FloatArray | None:
    """Return the horizontal direction (3,) that most segments run along, with those at right angles to it.

    None where none stands out. Segments on the horizon fit all horizontal directions, and vertical ones are no
    witnesses: both stay out.

    Args:
        up: (3,) unit vector in the world.
        segments: of all photos.
    """
    on_horizon = np.abs(along(segments.normals, up)) > np.cos(np.radians(APART_DEG))
    level = segments.take(~on_horizon & (_misses_deg(up, segments) > APART_DEG / 2))
    if len(level) < LEAST_SEGMENTS:
        return None
    e1, e2 = basis_across(up)
    angles = np.radians(np.arange(0.0, 180.0))
    ring = np.cos(angles)[:, None] * e1 + np.sin(angles)[:, None] * e2
    single = np.array([_support(direction, level, WIDTHS_DEG[0]) for direction in ring])
    both = single + np.roll(single, 90)
    best = int(np.argmax(both))
    best -= 90 if single[best] < single[best - 90] else 0
    away = (np.arange(180) - best + 45) % 90 - 45
    rival = float(np.percentile(both[np.abs(away) > APART_DEG], 90))
    stands_out = both[best] > LEVEL_STANDS_OUT * rival and both[best] > LEAST_SHARE * segments.lengths.sum()
    return np.asarray(ring[best]) if stands_out else None


def square_frame(up: FloatArray, level: FloatArray, segments: Segments) -> tuple[FloatArray, float]:
    """Return three directions at right angles near up, level and up x level that the segments run along most exactly.

    Horizontal edges say as much about up as vertical ones, and columns taper where cornices do not. Gauss-Newton on
    the rotation with Welsch's weights: a rotation by w moves the miss n'd of a segment along d by n'(w x d).

    Args:
        up: (3,) unit vector near the first direction.
        level: (3,) unit vector near the second, at right angles to `up`.
        segments: of all photos.

    Returns:
        (3, 3), its rows the directions, and the standard deviation of the first in degrees, see `Vanishing`.
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
    misses = np.array([_misses_deg(axis, segments) for axis in frame])
    axes = frame[np.argmin(misses, axis=0)]
    away = np.maximum(np.linalg.norm(np.cross(segments.middles, axes), axis=1), LEAST_SINE)
    weights = segments.lengths * np.exp(-0.5 * (misses.min(axis=0) / width_deg) ** 2) / away**2
    J, r = np.cross(axes, segments.normals), -(segments.normals * axes).sum(axis=1)
    return (
        _per_photo(segments, weights[:, None, None] * J[:, :, None] * J[:, None]),
        _per_photo(segments, (weights * r)[:, None] * J),
    )


def refined(direction: FloatArray, segments: Segments) -> FloatArray:
    """Return the nearby direction that makes the weighted squares of the misses least.

    Args:
        direction: (3,) unit vector to start from.
        segments: of all photos.
    """
    for width_deg in WIDTHS_DEG:
        for _ in range(10):
            before = direction
            direction = least_direction(_matrices(direction, segments, width_deg).sum(axis=0), direction)
            if float(np.abs(direction - before).max()) < 1e-10:
                break
    return direction


def cap(axis: FloatArray, radius_deg: float, step_deg: float) -> FloatArray:
    """Return (N, 3) unit vectors evenly spread around an axis.

    Args:
        axis: (3,) unit vector.
        radius_deg: largest angle from it, degrees.
        step_deg: angle between neighbors, about, degrees.
    """
    e1, e2 = basis_across(axis)
    found = [axis[None]]
    for polar in np.radians(np.arange(step_deg, radius_deg + 1e-9, step_deg)):
        around = np.linspace(0.0, 2 * np.pi, max(6, round(2 * np.pi * np.sin(polar) / np.radians(step_deg))), False)
        ring = np.cos(around)[:, None] * e1 + np.sin(around)[:, None] * e2
        found.append(np.cos(polar) * axis + np.sin(polar) * ring)
    return np.concatenate(found)


def _support(direction: FloatArray, segments: Segments, width_deg: float) -> float:
    weights = np.exp(-0.5 * (_misses_deg(direction, segments) / width_deg) ** 2)
    return float((segments.lengths * weights).sum())


def _matrices(direction: FloatArray, segments: Segments, width_deg: float) -> FloatArray:
    """Return (P, 3, 3) per photo the sum of n n' of its segments, weighted for least squares of the misses."""
    away = np.maximum(np.linalg.norm(np.cross(segments.middles, direction), axis=1), LEAST_SINE)
    weights = segments.lengths * np.exp(-0.5 * (_misses_deg(direction, segments) / width_deg) ** 2) / away**2
    n = segments.normals
    return _per_photo(segments, weights[:, None, None] * n[:, :, None] * n[:, None])


def _per_photo(segments: Segments, values: FloatArray) -> FloatArray:
    """Return sums of values (N, ...) over the segments of each photo."""
    sums = np.zeros((int(segments.photos.max(initial=-1)) + 1, *values.shape[1:]))
    np.add.at(sums, segments.photos, values)
    return sums


def _judged(found: FloatArray, tried: FloatArray, support: FloatArray, segments: Segments) -> Vanishing | None:
    """Return the direction with what speaks for it, if it stands out from those that were tried far from it."""
    running = _misses_deg(found, segments) < WIDTHS_DEG[0]
    share = float(segments.lengths[running].sum() / segments.lengths.sum())
    away = axis_angle_deg(tried, found) > APART_DEG
    if away.all():  # refined out of where it was sought
        return None
    contrast = float(support[~away].max()) / max(float(np.percentile(support[away], 90)), 1e-12)
    enough = np.count_nonzero(running) >= LEAST_SEGMENTS and share >= LEAST_SHARE and contrast >= STANDS_OUT
    return Vanishing(found, _direction_deviation_deg(found, segments), share, contrast) if enough else None


def _direction_deviation_deg(found: FloatArray, segments: Segments) -> float:
    matrices = _matrices(found, segments, WIDTHS_DEG[-1])
    total = matrices.sum(axis=0)
    without = [least_direction(total - matrix, found) for matrix in matrices if matrix.any()]
    return _jackknife(axis_angle_deg(np.reshape(without, (-1, 3)), found))


def _jackknife(moves: FloatArray) -> float:
    """Return standard deviation from how far the answer moves without each photo: those of one photo err together."""
    n = len(moves)
    return float(np.sqrt((n - 1) / n * (moves**2).sum())) if n > 1 else float("inf")
