"""Which way is up, from how photographers hold cameras.

They hold them level: the x axes of the cameras are horizontal, and up is the direction most nearly at right angles to
all of them. Some turn the camera by 90 degrees, for one photo or for all, and the file does not always say so; some do
not hold it level at all.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.unit_vectors import least_direction, unit
from sfm_app.numerical import MAD_TO_SIGMA

FloatArray = NDArray[np.float64]

ROLLS_DEG, PITCH_DEG = (4.0, 12.0, 30.0), 20.0
"""Standard deviations, sideways of careful, careless and wild photographers, and along the view of all."""

MOST, MOST_DOWN = 4.5, 3.0
"""What one photo at most counts against a direction: three standard deviations, so that wild photos are outvoted; and
less where it looks steeply down, as people do at what lies on floors and tables."""

TURNED = (0.0, 3.0, 6.0, 3.0)
"""Evidence, as -log of odds, that it takes to believe that all photos are turned by 0, 90, 180, 270 degrees: one folder
in twenty lies on either side, one in 400 is upside down (telephones held the other way round, their EXIF lost)."""

ODD_ONE = 1.0
"""The same for one photo that is turned otherwise than the others."""

VOICES = 8
"""Photos of one walk are no independent witnesses: more than so many count as so many."""

CLIMB = 0.1
"""Half of all walks go up and down by less than this share of their way."""

STEPS = 20


@dataclass(frozen=True, slots=True, eq=False)
class Roll:
    """What the cameras say about up."""

    up: FloatArray
    """(3,) unit vector in the world."""
    turn_deg: int
    """By how much most photos have to be turned clockwise to stand upright: 0, 90, 180 or 270."""
    spread_deg: float
    """Robust standard deviation of the cameras' roll; large where nobody held them level."""
    deviation_deg: float
    """Standard deviation of `up` in its worst direction, as the spread of roll and pitch has it."""
    cost: float
    """-log likelihood of the poses, and of people turning their photos so."""


def ups_from_roll(rotations: FloatArray, centers: FloatArray) -> tuple[Roll, ...]:
    """Return, for photos turned by 0, 90, 180, 270 degrees, the direction for which they are held most nearly level.

    Roll alone does not tell portrait photos of a wall from landscape photos of the same wall lying on its side, so
    two weaker signs join in: people look about horizontally, and they walk rather than climb. Of the directions that
    the photos propose the best is refined by weighted least squares. Opposite turns have opposite directions, unless
    cameras look steeply down.

    Args:
        rotations: (N, 3, 3) cam_from_world, N >= 1; camera axes x right, y down, z forward.
        centers: (N, 3) camera centers.
    """
    return tuple(_best(turn, proposals, rotations, centers) for turn, proposals in enumerate(_proposals(rotations)))


def _best(turn: int, proposals: FloatArray, rotations: FloatArray, centers: FloatArray) -> Roll:
    best, least = (proposals[0], ROLLS_DEG[0]), np.inf
    for proposal, roll_deg in product(proposals, ROLLS_DEG):
        for up in (proposal, _refined(proposal, rotations, roll_deg)):
            cost = _cost(up, turn, rotations, roll_deg) + _climbing(up, centers)
            if cost < least - 1e-9:
                best, least = (up, roll_deg), cost
    return Roll(best[0], 90 * turn, *_uncertainty(best[0], rotations, best[1]), least)


def _up_axes(rotations: FloatArray) -> FloatArray:
    """Return (4, N, 3) what is up in each photo if it is upright once turned by 0, 90, 180, 270 degrees clockwise."""
    x, y = rotations[:, 0], rotations[:, 1]
    return np.stack([-y, -x, y, x])


def _proposals(rotations: FloatArray) -> list[FloatArray]:
    """Return, per turn of the set, the mean of its photos' up directions, and some of them alone."""
    axes = _up_axes(rotations)
    chosen = np.unique(np.linspace(0, len(rotations) - 1, 12).astype(int))
    return [
        np.concatenate([mean[None], ups[chosen]]) if np.linalg.norm(mean := unit(ups.mean(axis=0))) else ups[chosen]
        for ups in axes
    ]


def _tilts(up: FloatArray, rotations: FloatArray) -> tuple[NDArray[np.intp], FloatArray, FloatArray]:
    """Return, per photo, its turn (0 to 3) and the sines of roll and pitch against `up`."""
    turns = np.argmax(_up_axes(rotations) @ up, axis=0)
    level = np.where((turns % 2 == 0)[:, None], rotations[:, 0], rotations[:, 1])
    return turns, level @ up, rotations[:, 2] @ up


def _cost(up: FloatArray, turn: int, rotations: FloatArray, roll_deg: float) -> float:
    """Return -log likelihood of the poses if the set as a whole is turned by `turn` quarters."""
    turns, roll, pitch = _tilts(up, rotations)
    sideways = np.minimum(_squares(roll, roll_deg), MOST)
    along_view = np.minimum(_squares(pitch, PITCH_DEG), np.where(pitch < 0, MOST_DOWN, MOST))
    per_photo = sideways + along_view + ODD_ONE * (turns != turn) + np.log(roll_deg)
    return float(min(len(rotations), VOICES) * per_photo.mean() + TURNED[turn])


def _climbing(up: FloatArray, centers: FloatArray) -> float:
    """Return -log likelihood of how much of the cameras' spread is height: Cauchy, since a few do climb."""
    spread = centers - centers.mean(axis=0)
    total = float((spread**2).sum())
    return float(np.log1p(((spread @ up) ** 2).sum() / (total * CLIMB**2))) if total > 0 else 0.0


def _refined(up: FloatArray, rotations: FloatArray, roll_deg: float) -> FloatArray:
    """Return least squares of roll and pitch with Welsch's weights on each photo, from `up` on."""
    for _ in range(STEPS):
        before = up
        up = least_direction(_normal_matrix(up, rotations, roll_deg), up)
        if float(np.abs(up - before).max()) < 1e-12:
            break
    return up


def _normal_matrix(up: FloatArray, rotations: FloatArray, roll_deg: float) -> FloatArray:
    """Return (3, 3) information about up: sum of the axes' a a' that should be level, over their variances."""
    turns, roll, pitch = _tilts(up, rotations)
    level = np.where((turns % 2 == 0)[:, None], rotations[:, 0], rotations[:, 1])
    matrix = np.zeros((3, 3))
    for axes, sine, deg in ((level, roll, roll_deg), (rotations[:, 2], pitch, PITCH_DEG)):
        weights = np.exp(-_squares(sine, deg) / MOST) / np.radians(deg) ** 2
        matrix += np.einsum("n,ni,nj->ij", weights, axes, axes)
    return matrix


def _uncertainty(up: FloatArray, rotations: FloatArray, roll_deg: float) -> tuple[float, float]:
    """Return robust spread of the roll in degrees, and the standard deviation of `up`."""
    _, roll, _ = _tilts(up, rotations)
    spread = float(MAD_TO_SIGMA * np.median(np.degrees(np.abs(np.arcsin(np.clip(roll, -1.0, 1.0))))))
    information = np.linalg.eigvalsh(_normal_matrix(up, rotations, roll_deg))[1]  # of the less certain of two tilts
    return spread, float(np.degrees(1.0 / np.sqrt(max(information, 1e-12))))


def _squares(sine: FloatArray, deg: float) -> FloatArray:
    return np.asarray(0.5 * (np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))) / deg) ** 2)
