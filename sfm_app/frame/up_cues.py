"""Cues that tell top from bottom in a scene whose vertical is known.

Each cue is a number that is positive if `up` is up; all of them change sign with `up`.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.poses import component_along, normalize, smallest_eigenvector
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.types.arrays import BoolArray, ByteArray, Float32Array, FloatArray, IndexArray

# The up direction from how photographers hold cameras.
# Most hold them level: the x axes of the cameras are horizontal, and up is the direction most nearly perpendicular
# to all of them. Some turn the camera by 90 degrees, for one photo or for all, and the file does not always record
# it; some do not hold it level at all.


@dataclass(frozen=True, slots=True)
class RollOptions:
    """Constants of the estimate from roll; costs are -log odds."""

    rolls_deg: tuple[float, ...] = (4.0, 12.0, 30.0)
    """Standard deviations of roll of careful, careless and wild photographers."""
    pitch_deg: float = 20.0
    """Standard deviation of pitch of all photographers."""
    max_cost: float = 4.5
    """Largest cost of the roll or pitch of one photo: three standard deviations, so that outliers are outvoted."""
    max_cost_down: float = 3.0
    """The same for the pitch of a photo that looks steeply down, as on floors and tables."""
    turn_costs: tuple[float, ...] = (0.0, 3.0, 6.0, 3.0)
    """Prior cost of all photos being turned by 0, 90, 180, 270 degrees: one folder in twenty lies on either side, one
    in 400 is upside down (phones held the other way round, EXIF lost)."""
    odd_turn_cost: float = 1.0
    """Prior cost of one photo being turned differently from the others."""
    max_photos: int = 8
    """Largest effective number of photos, since those of one walk are not independent."""
    climb_share: float = 0.1
    """Half of all walks climb by less than this share of their length."""


ROLL_OPTIONS = RollOptions()


@dataclass(frozen=True, slots=True, eq=False)
class Roll:
    """An up direction, from how the cameras were held."""

    up: FloatArray
    """(3,) unit vector in the world."""
    turn_deg: int
    """Clockwise turn that makes most photos upright: 0, 90, 180 or 270."""
    spread_deg: float
    """Robust standard deviation of the cameras' roll; large if nobody held them level."""
    deviation_deg: float
    """Standard deviation of `up` in its worst direction, from the assumed deviations of roll and pitch."""
    cost: float
    """-log likelihood of the poses, plus the prior cost of the turns."""


def roll_hypotheses(rotations: FloatArray, centers: FloatArray) -> tuple[Roll, ...]:
    """Estimate up for photos turned by 0, 90, 180, 270 degrees: the direction that makes them most nearly level.

    Roll alone does not distinguish portrait photos of a wall from landscape photos of the same wall lying on its side,
    so two weaker cues are added: people look nearly horizontally, and they walk rather than climb. Proposals of photos
    are refined by weighted least squares, and the cheapest is chosen. Opposite turns have opposite directions, unless
    cameras look steeply down. Rotations (N, 3, 3) are cam_from_world, centers (N, 3) in the world, N >= 1.
    """
    rolls = []
    for turn, proposals in enumerate(_proposals(rotations)):
        best, least = (proposals[0], ROLL_OPTIONS.rolls_deg[0]), np.inf
        for proposal, roll_deg in product(proposals, ROLL_OPTIONS.rolls_deg):
            for up in (proposal, _refine_up(proposal, rotations, roll_deg)):
                cost = _cost(up, turn, rotations, roll_deg) + _climb_cost(up, centers)
                if cost < least - 1e-9:
                    best, least = (up, roll_deg), cost
        rolls.append(Roll(best[0], 90 * turn, *_uncertainty(best[0], rotations, best[1]), least))
    return tuple(rolls)


def _up_axes(rotations: FloatArray) -> FloatArray:
    """Return up in the world (4, N, 3) by each photo, if a clockwise turn by 0, 90, 180, 270 degrees rights it."""
    x, y = rotations[:, 0], rotations[:, 1]
    return np.stack([-y, -x, y, x])


def _proposals(rotations: FloatArray) -> list[FloatArray]:
    """Return candidates for up per turn of the set: the mean over its photos, and up of twelve of them."""
    axes = _up_axes(rotations)
    chosen = np.unique(np.linspace(0, len(rotations) - 1, 12).astype(int))
    return [
        np.concatenate([mean[None], ups[chosen]])
        if np.linalg.norm(mean := normalize(ups.mean(axis=0)))
        else ups[chosen]
        for ups in axes
    ]


def _tilts(up: FloatArray, rotations: FloatArray) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Return per photo its turn (0 to 3) and the sines of its roll and pitch relative to `up`."""
    turns = np.argmax(_up_axes(rotations) @ up, axis=0)
    level = np.where((turns % 2 == 0)[:, None], rotations[:, 0], rotations[:, 1])
    return turns, level @ up, rotations[:, 2] @ up


def _cost(up: FloatArray, turn: int, rotations: FloatArray, roll_deg: float) -> float:
    """Return the -log likelihood of the poses if the set as a whole is turned by `turn` quarters."""
    turns, roll, pitch = _tilts(up, rotations)
    sideways = np.minimum(_angle_cost(roll, roll_deg), ROLL_OPTIONS.max_cost)
    along_view = np.minimum(
        _angle_cost(pitch, ROLL_OPTIONS.pitch_deg),
        np.where(pitch < 0, ROLL_OPTIONS.max_cost_down, ROLL_OPTIONS.max_cost),
    )
    per_photo = sideways + along_view + ROLL_OPTIONS.odd_turn_cost * (turns != turn) + np.log(roll_deg)
    return float(min(len(rotations), ROLL_OPTIONS.max_photos) * per_photo.mean() + ROLL_OPTIONS.turn_costs[turn])


def _climb_cost(up: FloatArray, centers: FloatArray) -> float:
    """Return the -log likelihood of the share of height in the cameras' spread: Cauchy, since some people climb."""
    spread = centers - centers.mean(axis=0)
    total = float((spread**2).sum())
    return float(np.log1p(((spread @ up) ** 2).sum() / (total * ROLL_OPTIONS.climb_share**2))) if total > 0 else 0.0


def _refine_up(up: FloatArray, rotations: FloatArray, roll_deg: float) -> FloatArray:
    """Refine `up` by least squares of roll and pitch with Welsch weights for each photo."""
    for _ in range(20):
        before = up
        up = smallest_eigenvector(_normal_matrix(up, rotations, roll_deg), up)
        if float(np.abs(up - before).max()) < 1e-12:
            break
    return up


def _normal_matrix(up: FloatArray, rotations: FloatArray, roll_deg: float) -> FloatArray:
    """Return the information matrix (3, 3) of up: the sum of a a' / variance over the level axes a."""
    turns, roll, pitch = _tilts(up, rotations)
    level = np.where((turns % 2 == 0)[:, None], rotations[:, 0], rotations[:, 1])
    matrix = np.zeros((3, 3))
    for axes, sine, deg in ((level, roll, roll_deg), (rotations[:, 2], pitch, ROLL_OPTIONS.pitch_deg)):
        weights = np.exp(-_angle_cost(sine, deg) / ROLL_OPTIONS.max_cost) / np.radians(deg) ** 2
        matrix += np.einsum("n,ni,nj->ij", weights, axes, axes)
    return matrix


def _uncertainty(up: FloatArray, rotations: FloatArray, roll_deg: float) -> tuple[float, float]:
    """Return the robust spread of the roll and the standard deviation of `up`, in degrees."""
    _, roll, _ = _tilts(up, rotations)
    spread = float(MAD_TO_SIGMA * np.median(np.degrees(np.abs(np.arcsin(np.clip(roll, -1.0, 1.0))))))
    information = np.linalg.eigvalsh(_normal_matrix(up, rotations, roll_deg))[1]  # of the less certain tilt
    return spread, float(np.degrees(1.0 / np.sqrt(max(information, 1e-12))))


def _angle_cost(sine: FloatArray, deg: float) -> FloatArray:
    return np.asarray(0.5 * (np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))) / deg) ** 2)


@dataclass(frozen=True, slots=True)
class CueOptions:
    """Constants of the cues."""

    min_points: int = 10
    """Least number of visible points of a photo whose depths count."""
    depth_spread: float = 0.05
    """Spread of log depth below which it shows the shape of a distant object rather than the ground before it."""
    neighbors: int = 12
    """Neighbors that a surface patch is fitted to."""
    wide_neighbors: int = 60
    """Neighbors whose mean its normal and brightness are compared with."""
    max_variance_ratio: float = 0.2
    """Largest ratio of the two smaller variances of the points of a surface patch."""
    picture_px: int = 256
    """Longer side of the small pictures: wide enough for ledges and window sills, too small for texture."""
    blur_px: float = 2.0
    black: int = 20
    """Gray level of an unlit background, whose border is no ledge."""
    black_px: int = 15
    """Least width of that background."""
    border_px: int = 6
    min_rms: float = 1e-6
    """RMS of differences of normals or log brightness below which they are rounding."""
    max_sky_slope: float = 1.5
    """Largest slope of sky, in gray levels per pixel."""
    sky_blur_px: float = 1.0
    min_sky: int = 40
    """Least gray level of sky."""


CUE_OPTIONS = CueOptions()


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """Surface patches around points."""

    normals: FloatArray
    """(N, 3) unit vectors on the side of the cameras."""
    normal_differences: FloatArray
    """(N, 3) normals minus the mean normal of their neighborhood."""
    brightness_differences: FloatArray
    """(N,) log brightness minus its mean over the neighborhood."""


def fit_surfaces(
    points: FloatArray, brightness: FloatArray, visible: Sequence[IndexArray], centers: FloatArray
) -> Surfaces:
    """Fit a plane to the neighbors of each of P points (P, 3) in the world, and keep flat patches.

    The brightness (P,) is 0 to 255; `visible` has the rows of the points that each photo sees, `centers` (N, 3).
    """
    from scipy.spatial import cKDTree

    if len(points) < CUE_OPTIONS.neighbors:
        return Surfaces(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    neighbors = np.asarray(cKDTree(points).query(points, k=min(CUE_OPTIONS.wide_neighbors, len(points)))[1])
    near = points[neighbors[:, : CUE_OPTIONS.neighbors]]
    near = near - near.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    towards = np.zeros_like(points)
    for rows, center in zip(visible, centers, strict=True):
        towards[rows] += normalize(center - points[rows])
    normals = axes[:, :, 0]
    normals = normals * np.where((normals * towards).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    gray = np.log(10.0 + brightness)
    bends, shades = normals - normals[neighbors].mean(axis=1), gray - gray[neighbors].mean(axis=1)
    flat = (variances[:, 0] < CUE_OPTIONS.max_variance_ratio * variances[:, 1]) & towards.any(axis=1)
    return Surfaces(normals[flat], bends[flat], shades[flat])


def depth_height_correlation(
    up: FloatArray, rotations: FloatArray, centers: FloatArray, points: FloatArray, visible: Sequence[IndexArray]
) -> float:
    """Return the mean correlation of log depth with height in the photo, in [-1, 1].

    The ground gets nearer towards the lower border; facades seen from the street lean away. `up` (3,), centers (N, 3)
    and points (P, 3) are in the world, rotations (N, 3, 3) cam_from_world; `visible` as in `fit_surfaces`.
    """
    correlations = []
    for R, center, rows in zip(rotations, centers, visible, strict=True):
        local = np.einsum("ij,nj->ni", R, points[rows] - center)
        local = local[local[:, 2] > 0]
        if len(local) < CUE_OPTIONS.min_points:
            continue
        depth = np.log(local[:, 2])
        depth = np.clip(depth, *np.percentile(depth, (2, 98)))
        height = component_along(local[:, :2] / local[:, 2:], (R @ up)[:2])
        depth, height = depth - depth.mean(), height - height.mean()
        spread = (depth.std() + CUE_OPTIONS.depth_spread) * height.std()
        correlations.append(float((depth * height).mean() / spread) if spread > 0 else 0.0)
    return _mean(correlations)


def mean_upward_normal(up: FloatArray, surfaces: Surfaces) -> float:
    """Return the mean component of the normals along `up` (3,), in [-1, 1]: floors and sills are seen from above."""
    return float(component_along(surfaces.normals, up).mean()) if len(surfaces.normals) else 0.0


def brightness_normal_correlation(up: FloatArray, surfaces: Surfaces) -> float:
    """Return the correlation of brightness with the normal's component along `up`, both relative to their vicinity."""
    if not len(surfaces.normals):
        return 0.0
    rise, shade = component_along(surfaces.normal_differences, up), surfaces.brightness_differences
    spreads = [float(np.sqrt((values**2).mean())) for values in (rise, shade)]
    return float((rise * shade).mean() / (spreads[0] * spreads[1])) if min(spreads) > CUE_OPTIONS.min_rms else 0.0


def slope_asymmetry(up: FloatArray, rotations: FloatArray, pictures: Sequence[ByteArray | None]) -> float:
    """Return the mean share of rising minus falling brightness slopes along `up`, by power, in [-1, 1].

    Shadow under ledges, eaves and objects has a sharp border to the lit top above it, and skylines are brighter above;
    transitions back to light are gradual. Perpendicular to `up` it is 0 within 0.06.
    `rotations` (N, 3, 3) are cam_from_world; the pictures (H, W) are gray, in the orientation of the sensor.
    """
    shares = []
    for R, gray in _blurred(rotations, pictures, CUE_OPTIONS.blur_px):
        slope = _slope(np.sqrt(gray), R @ up)[~_black_background(gray)[1:-1, 1:-1]]
        power = (slope**2).sum()
        shares.append(float((slope * np.abs(slope)).sum() / power) if power > 0 else 0.0)
    return _mean(shares)


def sky_asymmetry(up: FloatArray, rotations: FloatArray, pictures: Sequence[ByteArray | None]) -> float:
    """Return the mean share of even, bright pixels near the upper border minus the lower, in [-1, 1].

    Arguments as in `slope_asymmetry`.
    """
    differences = []
    for R, blurred in _blurred(rotations, pictures, CUE_OPTIONS.sky_blur_px):
        steep = np.hypot(_slope(blurred, np.array([1.0, 0.0])), _slope(blurred, np.array([0.0, 1.0])))
        gray = blurred[1:-1, 1:-1]
        even = (steep < CUE_OPTIONS.max_sky_slope) & (gray > max(float(np.median(gray)), CUE_OPTIONS.min_sky))
        y, x = np.mgrid[: gray.shape[0], : gray.shape[1]] - 0.5 * (np.array(gray.shape)[:, None, None] - 1)
        axis = R @ up
        height = x * axis[0] + y * axis[1]
        border = 0.5 * np.abs(height).max()
        above, below = even[height > border], even[height < -border]
        differences.append(float(above.mean() - below.mean()) if above.size and below.size else 0.0)
    return _mean(differences)


def _blurred(
    rotations: FloatArray, pictures: Sequence[ByteArray | None], blur_px: float
) -> Iterator[tuple[FloatArray, Float32Array]]:
    """Yield the rotation and the blurred gray levels of each photo that has a picture."""
    for R, picture in zip(rotations, pictures, strict=True):
        if picture is not None and min(picture.shape) >= 3:
            yield R, np.asarray(cv2.GaussianBlur(picture.astype(np.float32), (0, 0), blur_px), np.float32)


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else 0.0


def _black_background(gray: Float32Array) -> BoolArray:
    widths = CUE_OPTIONS.black_px, 2 * CUE_OPTIONS.border_px + 1
    broad, border = (np.ones((width, width), np.uint8) for width in widths)
    black = cv2.morphologyEx((gray < CUE_OPTIONS.black).astype(np.uint8), cv2.MORPH_OPEN, broad)
    return np.asarray(cv2.dilate(black, border) > 0)


def _slope(gray: Float32Array, axis: FloatArray) -> Float32Array:
    """Return the derivative (H - 2, W - 2) along an axis (x, y, ...) of the picture, in gray levels per pixel."""
    down, right = gray[2:, 1:-1] - gray[:-2, 1:-1], gray[1:-1, 2:] - gray[1:-1, :-2]
    return np.asarray(0.5 * (axis[0] * right + axis[1] * down), np.float32)
