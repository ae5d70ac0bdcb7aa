"""Cues that tell top from bottom in a scene whose vertical is known.

Each cue is a number that is positive if `up` is up; all of them change sign with `up`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.poses import component_along, normalize, smallest_eigenvector
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.types.arrays import FloatArray

# The up direction, from how photographers hold cameras.
#
# Most hold them level: the x axes of the cameras are horizontal, and up is the direction most nearly perpendicular
# to all of them. Some turn the camera by 90 degrees, for one photo or for all, and the file does not always record
# it; some do not hold it level at all.

ROLLS_DEG, PITCH_DEG = (4.0, 12.0, 30.0), 20.0
"""Standard deviations of roll, for careful, careless and wild photographers, and of pitch, for all."""

MAX_COST, MAX_COST_DOWN = 4.5, 3.0
"""Largest cost of the roll or pitch of one photo: three standard deviations, so that outliers are outvoted; and that of
the pitch where it looks steeply down, as people do at things on floors and tables."""

TURN_COSTS = (0.0, 3.0, 6.0, 3.0)
"""Prior cost, -log odds, of all photos being turned by 0, 90, 180, 270 degrees: one folder in twenty lies on either
side, one in 400 is upside down (phones held the other way round, EXIF lost)."""

ODD_TURN_COST = 1.0
"""Prior cost, -log odds, of one photo being turned differently from the others."""

MAX_EFFECTIVE_PHOTOS = 8
"""Largest effective number of photos, since those of one walk are not independent."""

CLIMB_SHARE = 0.1
"""Half of all walks go up and down by less than this share of their way."""

STEPS = 20


@dataclass(frozen=True, slots=True, eq=False)
class Roll:
    """An up direction, from how the cameras were held."""

    up: FloatArray
    """(3,) unit vector in the world."""
    turn_deg: int
    """Clockwise turn that makes most photos upright: 0, 90, 180 or 270."""
    spread_deg: float
    """Robust standard deviation of the cameras' roll; large where nobody held them level."""
    deviation_deg: float
    """Standard deviation of `up` in its worst direction, from the assumed deviations of roll and pitch."""
    cost: float
    """-log likelihood of the poses, plus the prior cost of the turns."""


def roll_hypotheses(rotations: FloatArray, centers: FloatArray) -> tuple[Roll, ...]:
    """Estimate up for photos turned by 0, 90, 180, 270 degrees: the direction that makes them most nearly level.

    Roll alone does not distinguish portrait photos of a wall from landscape photos of the same wall lying on its side,
    so two weaker cues are added: people look about horizontally, and they walk rather than climb. The directions that
    the photos propose are refined by weighted least squares, and the best is chosen. Opposite turns have opposite
    directions, unless cameras look steeply down.

    Args:
        rotations: (N, 3, 3) cam_from_world, N >= 1; camera axes x right, y down, z forward.
        centers: (N, 3) camera centers.
    """
    return tuple(
        _best_hypothesis(turn, proposals, rotations, centers) for turn, proposals in enumerate(_proposals(rotations))
    )


def _best_hypothesis(turn: int, proposals: FloatArray, rotations: FloatArray, centers: FloatArray) -> Roll:
    best, least = (proposals[0], ROLLS_DEG[0]), np.inf
    for proposal, roll_deg in product(proposals, ROLLS_DEG):
        for up in (proposal, _refine_up(proposal, rotations, roll_deg)):
            cost = _cost(up, turn, rotations, roll_deg) + _climb_cost(up, centers)
            if cost < least - 1e-9:
                best, least = (up, roll_deg), cost
    return Roll(best[0], 90 * turn, *_uncertainty(best[0], rotations, best[1]), least)


def _up_axes(rotations: FloatArray) -> FloatArray:
    """Return (4, N, 3) up in the world by each photo, if a clockwise turn by 0, 90, 180, 270 degrees rights it."""
    x, y = rotations[:, 0], rotations[:, 1]
    return np.stack([-y, -x, y, x])


def _proposals(rotations: FloatArray) -> list[FloatArray]:
    """Return candidates for up per turn of the set: the mean over its photos, and the directions of some of them."""
    axes = _up_axes(rotations)
    chosen = np.unique(np.linspace(0, len(rotations) - 1, 12).astype(int))
    return [
        np.concatenate([mean[None], ups[chosen]])
        if np.linalg.norm(mean := normalize(ups.mean(axis=0)))
        else ups[chosen]
        for ups in axes
    ]


def _tilts(up: FloatArray, rotations: FloatArray) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Return, per photo, its turn (0 to 3) and the sines of roll and pitch relative to `up`."""
    turns = np.argmax(_up_axes(rotations) @ up, axis=0)
    level = np.where((turns % 2 == 0)[:, None], rotations[:, 0], rotations[:, 1])
    return turns, level @ up, rotations[:, 2] @ up


def _cost(up: FloatArray, turn: int, rotations: FloatArray, roll_deg: float) -> float:
    """Return the -log likelihood of the poses if the set as a whole is turned by `turn` quarters."""
    turns, roll, pitch = _tilts(up, rotations)
    sideways = np.minimum(_angle_cost(roll, roll_deg), MAX_COST)
    along_view = np.minimum(_angle_cost(pitch, PITCH_DEG), np.where(pitch < 0, MAX_COST_DOWN, MAX_COST))
    per_photo = sideways + along_view + ODD_TURN_COST * (turns != turn) + np.log(roll_deg)
    return float(min(len(rotations), MAX_EFFECTIVE_PHOTOS) * per_photo.mean() + TURN_COSTS[turn])


def _climb_cost(up: FloatArray, centers: FloatArray) -> float:
    """Return the -log likelihood of the share of height in the cameras' spread: Cauchy, since a few people climb."""
    spread = centers - centers.mean(axis=0)
    total = float((spread**2).sum())
    return float(np.log1p(((spread @ up) ** 2).sum() / (total * CLIMB_SHARE**2))) if total > 0 else 0.0


def _refine_up(up: FloatArray, rotations: FloatArray, roll_deg: float) -> FloatArray:
    """Refine `up` by least squares of roll and pitch with Welsch weights for each photo."""
    for _ in range(STEPS):
        before = up
        up = smallest_eigenvector(_normal_matrix(up, rotations, roll_deg), up)
        if float(np.abs(up - before).max()) < 1e-12:
            break
    return up


def _normal_matrix(up: FloatArray, rotations: FloatArray, roll_deg: float) -> FloatArray:
    """Return the information matrix (3, 3) of up: the sum of a a' / variance over the axes a that should be level."""
    turns, roll, pitch = _tilts(up, rotations)
    level = np.where((turns % 2 == 0)[:, None], rotations[:, 0], rotations[:, 1])
    matrix = np.zeros((3, 3))
    for axes, sine, deg in ((level, roll, roll_deg), (rotations[:, 2], pitch, PITCH_DEG)):
        weights = np.exp(-_angle_cost(sine, deg) / MAX_COST) / np.radians(deg) ** 2
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


LEAST_POINTS = 10
"""Points that a photo must see for its depths to count."""

DEPTH_SPREAD_FLOOR = 0.05
"""Spread of log depth below which it shows the shape of a distant thing rather than the ground in front of it."""

NEIGHBORS, WIDE_NEIGHBORS = 12, 60
"""Neighbors that a surface patch is fitted to, and those whose mean its normal and brightness are compared with."""

MAX_VARIANCE_RATIO = 0.2
"""Largest ratio of the two smaller variances of the points of a surface patch."""

PICTURE_PX = 256
"""Longer side of the small photos: wide enough for ledges and window sills, too small for texture."""

BLUR_PX = 2.0
"""Blur before slopes are taken."""

BLACK, BROAD_PX, BORDER_PX = 20, 15, 6
"""Gray level and width of an unlit background, whose border is not a ledge, and the width of that border."""

MIN_RMS = 1e-6
"""Root mean square of differences of normals or log brightness below which they are only rounding."""

MAX_SKY_SLOPE, BLUR_SKY_PX, LEAST_SKY = 1.5, 1.0, 40
"""Of sky: largest slope in gray levels per pixel, the blur before slopes are taken, and the least gray level."""


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """Surface patches around points."""

    normals: FloatArray
    """(N, 3) unit vectors on the side of the cameras."""
    normal_differences: FloatArray
    """(N, 3) normals minus the mean normal of their neighborhood."""
    brightness_differences: FloatArray
    """(N,) log brightness minus its mean over the neighborhood."""


def small_picture(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a gray photo, shrunk to `PICTURE_PX`."""
    shrink = min(1.0, PICTURE_PX / max(gray.shape))
    size = (max(1, round(gray.shape[1] * shrink)), max(1, round(gray.shape[0] * shrink)))
    return np.asarray(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), np.uint8)


def fit_surfaces(
    points: FloatArray, brightness: FloatArray, seen: Sequence[NDArray[np.int64]], centers: FloatArray
) -> Surfaces:
    """Fit a plane to the neighbors of each point, and keep those that are flat.

    Args:
        points: (P, 3).
        brightness: (P,) 0 to 255.
        centers: (N, 3) camera centers of the photos.
    """
    from scipy.spatial import cKDTree

    if len(points) < NEIGHBORS:
        return Surfaces(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    around = np.asarray(cKDTree(points).query(points, k=min(WIDE_NEIGHBORS, len(points)))[1])
    near = points[around[:, :NEIGHBORS]]
    near = near - near.mean(axis=1, keepdims=True)
    variances, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    towards = np.zeros_like(points)
    for chosen, center in zip(seen, centers, strict=True):
        towards[chosen] += normalize(center - points[chosen])
    normals = axes[:, :, 0]
    normals = normals * np.where((normals * towards).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    gray = np.log(10.0 + brightness)
    bends, shades = normals - normals[around].mean(axis=1), gray - gray[around].mean(axis=1)
    flat = (variances[:, 0] < MAX_VARIANCE_RATIO * variances[:, 1]) & towards.any(axis=1)
    return Surfaces(normals[flat], bends[flat], shades[flat])


def depth_height_correlation(
    up: FloatArray,
    rotations: FloatArray,
    centers: FloatArray,
    points: FloatArray,
    seen: Sequence[NDArray[np.int64]],
) -> float:
    """Return the correlation of log depth with height in the photo, averaged over the photos, in [-1, 1].

    The ground gets nearer towards the lower border; facades seen from the street lean away.

    Args:
        up: (3,) unit vector in the world.
        rotations: (N, 3, 3) of cam_from_world.
        centers: (N, 3) of the cameras.
        points: (P, 3) in the world.
    """
    found = []
    for R, center, chosen in zip(rotations, centers, seen, strict=True):
        local = np.einsum("ij,nj->ni", R, points[chosen] - center)
        local = local[local[:, 2] > 0]
        if len(local) < LEAST_POINTS:
            continue
        depth = np.log(local[:, 2])
        depth = np.clip(depth, *np.percentile(depth, (2, 98)))
        height = component_along(local[:, :2] / local[:, 2:], (R @ up)[:2])
        depth, height = depth - depth.mean(), height - height.mean()
        spread = (depth.std() + DEPTH_SPREAD_FLOOR) * height.std()
        found.append(float((depth * height).mean() / spread) if spread > 0 else 0.0)
    return float(np.mean(found)) if found else 0.0


def mean_upward_normal(up: FloatArray, surfaces: Surfaces) -> float:
    """Return the mean upward component of the normals, in [-1, 1].

    Floors, steps and sills are seen from above.

    Args:
        up: (3,) unit vector in the world.
    """
    return float(component_along(surfaces.normals, up).mean()) if len(surfaces.normals) else 0.0


def brightness_normal_correlation(up: FloatArray, surfaces: Surfaces) -> float:
    """Return the correlation of brightness and upward component of the normal, both relative to their neighborhood.

    Light comes from above. In [-1, 1].

    Args:
        up: (3,) unit vector in the world.
    """
    if not len(surfaces.normals):
        return 0.0
    rise, shade = component_along(surfaces.normal_differences, up), surfaces.brightness_differences
    spreads = [float(np.sqrt((values**2).mean())) for values in (rise, shade)]
    return float((rise * shade).mean() / (spreads[0] * spreads[1])) if min(spreads) > MIN_RMS else 0.0


def slope_asymmetry(up: FloatArray, rotations: FloatArray, pictures: Sequence[NDArray[np.uint8] | None]) -> float:
    """Return the share of rising minus that of falling brightness slopes along `up`, by power, in [-1, 1].

    The mean over the photos. Shadow under ledges, eaves and things on the ground has a sharp border to the lit top
    above it, and skylines are brighter above; transitions back to light are gradual. Perpendicular to `up` it is 0
    within 0.06.

    Args:
        up: (3,) unit vector in the world.
        rotations: (N, 3, 3) of cam_from_world.
        pictures: per photo (H, W) gray, in the orientation of the sensor; None if there is none.
    """
    found = []
    for R, picture in zip(rotations, pictures, strict=True):
        if picture is None or min(picture.shape) < 3:
            continue
        gray = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), BLUR_PX)
        slope = _slope(np.sqrt(gray), R @ up)[~_black_background(gray)[1:-1, 1:-1]]
        power = (slope**2).sum()
        found.append(float((slope * np.abs(slope)).sum() / power) if power > 0 else 0.0)
    return float(np.mean(found)) if found else 0.0


def sky_asymmetry(up: FloatArray, rotations: FloatArray, pictures: Sequence[NDArray[np.uint8] | None]) -> float:
    """Return the share of even, bright pixels near the upper border minus that near the lower, in [-1, 1].

    The mean over the photos.

    Args:
        up: (3,) unit vector in the world.
        rotations: (N, 3, 3) of cam_from_world.
        pictures: per photo (H, W) gray, in the orientation of the sensor; None if there is none.
    """
    found = []
    for R, picture in zip(rotations, pictures, strict=True):
        if picture is None or min(picture.shape) < 3:
            continue
        gray = cv2.GaussianBlur(picture.astype(np.float32), (0, 0), BLUR_SKY_PX)
        steep = np.hypot(_slope(gray, np.array([1.0, 0.0])), _slope(gray, np.array([0.0, 1.0])))
        gray = gray[1:-1, 1:-1]
        even = (steep < MAX_SKY_SLOPE) & (gray > max(float(np.median(gray)), LEAST_SKY))
        y, x = np.mgrid[: gray.shape[0], : gray.shape[1]] - 0.5 * (np.array(gray.shape)[:, None, None] - 1)
        axis = R @ up
        height = x * axis[0] + y * axis[1]
        border = 0.5 * np.abs(height).max()
        above, below = even[height > border], even[height < -border]
        found.append(float(above.mean() - below.mean()) if above.size and below.size else 0.0)
    return float(np.mean(found)) if found else 0.0


def _black_background(gray: NDArray[np.float32]) -> NDArray[np.bool_]:
    broad, border = (np.ones((width, width), np.uint8) for width in (BROAD_PX, 2 * BORDER_PX + 1))
    black = cv2.morphologyEx((gray < BLACK).astype(np.uint8), cv2.MORPH_OPEN, broad)
    return np.asarray(cv2.dilate(black, border) > 0)


def _slope(gray: NDArray[np.float32], axis: FloatArray) -> NDArray[np.float32]:
    """Return the (H - 2, W - 2) derivative along an axis (x, y, ...) in the picture, in gray levels per pixel."""
    down, right = gray[2:, 1:-1] - gray[:-2, 1:-1], gray[1:-1, 2:] - gray[1:-1, :-2]
    return np.asarray(0.5 * (axis[0] * right + axis[1] * down), np.float32)
