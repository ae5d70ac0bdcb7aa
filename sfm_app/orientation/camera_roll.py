"""The up direction, from how photographers hold cameras.

Most hold them level: the x axes of the cameras are horizontal, and up is the direction most nearly perpendicular to all
of them. Some turn the camera by 90 degrees, for one photo or for all, and the file does not always record it; some do
not hold it level at all.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.unit_vectors import normalize, smallest_eigenvector
from sfm_app.numerical import MAD_TO_SIGMA

FloatArray = NDArray[np.float64]

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
