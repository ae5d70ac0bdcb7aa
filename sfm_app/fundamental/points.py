"""Preparation of matched points: check them, drop duplicates, shuffle, and scale to numbers near 1.

Thesis 4.3.2 asks for normalized points, as Hartley (1997) does; the robust frame is ours.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.geometry.epipolar import to_unit_norm
from sfm_app.types.arrays import FloatArray

_LARGEST_PX = 1e15
"""Largest coordinate of a pixel: beyond it double precision resolves only an eighth of a pixel."""


def check_points(x1: ArrayLike, x2: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return matched points as contiguous (N, 2) float64 pixels, N >= 0; ValueError if they are malformed."""
    checked = [_check(x, name) for x, name in ((x1, "x1"), (x2, "x2"))]
    if len(checked[0]) != len(checked[1]):
        raise ValueError(f"x1 and x2 must pair up row by row, got {len(checked[0])} and {len(checked[1])} points")
    return checked[0], checked[1]


def _check(x: ArrayLike, name: str) -> FloatArray:
    points = np.asarray(x)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"{name} must have shape (N, 2), got {points.shape}")
    if points.dtype.kind not in "iuf":
        raise ValueError(f"{name} must hold real numbers, got {points.dtype}")
    points = np.ascontiguousarray(points, dtype=np.float64)
    if not np.isfinite(points).all():
        raise ValueError(f"{name} has {np.count_nonzero(~np.isfinite(points).all(axis=1))} points that are not finite")
    if len(points) and np.abs(points).max() > _LARGEST_PX:
        raise ValueError(f"{name} must lie within {_LARGEST_PX:.0e} px, got {np.abs(points).max():.1e}")
    return points


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """The distinct matches of a pair, as input of the estimators."""

    points: FloatArray
    """(M, 4) x1, y1, x2, y2 in random order; each view centered, both divided by `unit_px`.

    In Fortran order: kernels run along the matches, and contiguous columns let the compiler vectorize them.
    """
    rows: NDArray[np.intp]
    """(N,) for each match as given, its row in `points`."""
    unit_px: float
    """Pixels per unit of `points`; one scale for both views, which only scales Sampson distances."""
    center: FloatArray
    """(4,) pixels x1, y1, x2, y2 of the origin of `points`."""

    def to_pixels(self, F: FloatArray) -> FloatArray:
        """Return F of `points` as F of pixels, Frobenius norm 1."""
        return to_unit_norm(self._transform(self.center[2:]).T @ F @ self._transform(self.center[:2]))

    def _transform(self, center: FloatArray) -> FloatArray:
        return np.array([[1, 0, -center[0]], [0, 1, -center[1]], [0, 0, self.unit_px]]) / self.unit_px


def prepare(x1: FloatArray, x2: FloatArray, seed: int) -> Matches:
    """Drop repeated matches, shuffle and scale the rest.

    SIFT returns a keypoint once per orientation, so that one match may occur several times. Repeats would count as
    support and make samples degenerate. In random order the first points are a fair sample for an early exit.
    """
    stacked = np.hstack([x1, x2])
    # one key per match: a projection with incommensurable weights is equal for equal rows, and sorts faster than rows
    keys = stacked[:, 0] + stacked[:, 1] * np.sqrt(2) + stacked[:, 2] * np.sqrt(3) + stacked[:, 3] * np.sqrt(5)
    ranked = np.argsort(keys, kind="stable")
    is_new = np.diff(keys[ranked], prepend=-np.inf) > 0
    first = ranked[is_new]
    order = np.random.default_rng(seed % 2**64).permutation(len(first))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    rows = np.empty_like(ranked)
    rows[ranked] = place[np.cumsum(is_new) - 1]
    points = np.asfortranarray(stacked.take(first[order], axis=0))
    center, unit_px = _robust_frame(points)
    return Matches((points - center) / unit_px, rows, unit_px, center)


def _robust_frame(points: FloatArray) -> tuple[FloatArray, float]:
    """Return the origin (4,) and the unit in which most coordinates are of magnitude 1, in spite of gross outliers."""
    if not len(points):
        return np.zeros(4), 1.0
    middle, deviations = len(points) // 2, np.empty_like(points)
    center = np.array([np.partition(column, middle)[middle] for column in points.T])
    np.abs(points - center, out=deviations)
    # the 0.9 quantile of uniform deviations is 0.9 sqrt(3) = 1.56 times their root mean square
    rank = int(0.9 * (deviations.size - 1))
    unit_px = float(np.partition(deviations.ravel(order="K"), rank)[rank]) / 1.56
    return center, unit_px or float(np.sqrt((deviations**2).mean())) or 1.0
