"""How a camera moves at the moment of each photo, from the poses of the photos before and after it. Ours.

Polynomials are fitted to the poses of some consecutive photos, and differentiated (Savitzky and Golay 1964, with uneven
steps). Which degree over how many photos, cross-validation decides: where photos follow each other faster than a hand
shakes, the path goes through all poses; where they do not, through their middle.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sfm_app.numerical import MAD_TO_SIGMA

FloatArray = NDArray[np.float64]

FITS = ((5, 3), (3, 1), (7, 3), (9, 3), (5, 1), (7, 1), (9, 1))
"""Photos in a window and degree of the polynomial. Even degrees give the slopes of the odd ones below them. Chosen by
hand."""
MIN_PHOTOS = 9
"""Photos below which a path has no velocities: the longest window."""
VELOCITY = 6
"""Numbers of a velocity: a rotation vector, and the motion of a point at rest. By definition."""


@dataclass(frozen=True, slots=True, eq=False)
class PathVelocities:
    """Velocities at the moments of some photos, per unit of time, from each of FITS."""

    values: FloatArray
    """(F, I, 6) rotation vector of the camera's turn in its own axes, applied to R from the left; then the velocity of
    a point at rest in these axes, due to the motion of the camera's center."""
    errors: FloatArray
    """(F, I, 6) of the poses if they are left out, in radians and units of length."""

    def select_most_predictive(self) -> NDArray[np.int64]:
        """Return the fits (2,) of turns and of moves that predict left-out poses best."""
        length = np.linalg.norm(self.errors.reshape(*self.errors.shape[:2], 2, 3), axis=3)
        return np.asarray(np.argmin(np.median(length, axis=1), axis=0), np.int64)

    def select(self, fits: NDArray[np.int64]) -> FloatArray:
        """Return velocities (I, 6), turns and moves each from their fit (2,)."""
        return np.concatenate([self.values[fits[0], :, :3], self.values[fits[1], :, 3:]], axis=1)

    def deviations(self) -> FloatArray:
        """Return (I, 6) rough standard deviations of the velocities: the difference of the two shortest fits."""
        off = (self.values[0] - self.values[1]).reshape(-1, 2, 3)
        usual = MAD_TO_SIGMA * np.median(np.abs(off), axis=(0, 2))
        return np.asarray(np.repeat(np.maximum(np.sqrt(np.mean(off**2, axis=2)), usual), 3, axis=1), np.float64)


def path_velocities(R: FloatArray, t: FloatArray, times: FloatArray) -> PathVelocities:
    """Return velocities of photos.

    Args:
        R, t: (I, 3, 3) and (I, 3) camera from world, I >= 9.
        times: (I,) of the photos, distinct.
    """
    order = np.argsort(times)
    back = np.argsort(order)
    fits = [_fit_windows(R[order], t[order], times[order], *fit) for fit in FITS]
    values, errors = (np.array(part)[:, back] for part in zip(*fits, strict=True))
    return PathVelocities(values, errors)


def _fit_windows(
    R: FloatArray, t: FloatArray, times: FloatArray, count: int, degree: int
) -> tuple[FloatArray, FloatArray]:
    """Return velocities (I, 6) of photos sorted by time, and the errors (I, 6) of their poses if they are left out."""
    places = np.arange(len(times))
    first = np.clip(places - count // 2, 0, len(times) - count)
    window = first[:, None] + np.arange(count)
    turned = np.einsum("iwjk,ilk->iwjl", R[window], R)
    turns = Rotation.from_matrix(turned.reshape(-1, 3, 3)).as_rotvec().reshape(-1, count, 3)
    centers = -np.einsum("nji,nj->ni", R, t)
    moves = -np.einsum("ijk,iwk->iwj", R, centers[window] - centers[:, None])
    value, slope = local_fit_weights(times[window] - times[:, None], degree)
    poses = np.concatenate([turns, moves], axis=2)  # 0 at the photo itself
    own = value[places, places - first]
    error = np.einsum("iw,iwj->ij", value, poses) / np.maximum(1.0 - own, np.finfo(float).eps)[:, None]
    return np.einsum("iw,iwj->ij", slope, poses), error


def local_fit_weights(offsets: FloatArray, degree: int) -> tuple[FloatArray, FloatArray]:
    """Return weights (I, k) that give the value at 0 and the derivative there of a polynomial fit.

    Args:
        offsets: (I, k) distinct times of the values that are fitted.
        degree: of the polynomial, below k.
    """
    unit = np.abs(offsets).max(axis=1)
    powers = (offsets / unit[:, None])[:, :, None] ** np.arange(degree + 1)
    solution = np.linalg.pinv(powers)
    return np.asarray(solution[:, 0]), np.asarray(solution[:, 1] / unit[:, None])
