"""Which way up a scene is, where the roll of the cameras does not decide it.

The roll gives one vertical for photos that are upright or upside down, and one for photos on their side. Which of the
two is right, and which of its ends is up, is decided by odds: the prior odds of people turning all their photos, times
the evidence of the scene and the photos.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.orientation.camera_roll import Roll
from sfm_app.orientation.up_cues import (
    brightness_normal_correlation,
    depth_height_correlation,
    fit_surfaces,
    mean_upward_normal,
    sky_asymmetry,
    slope_asymmetry,
)

FloatArray = NDArray[np.float64]

MAX_NATS = 3.0
"""Largest evidence of one cue, in nats: each of them is wrong in one place of twenty (a vault, a stage, snow)."""

LEDGE_NATS, MAX_LEDGE_NATS = 10.0, 4.0
"""Nats for an axis per unit of `slope_asymmetry`, and their maximum. The other cues are as large sideways: along a
wall, depth, normals and light change from side to side."""

HIGHEST_NATS = 14.0
"""Odds above a million to one are not distinguished."""


@dataclass(frozen=True, slots=True)
class Cue:
    """Distribution of a cue over upright scenes."""

    mean: float
    deviation: float
    """Standard deviation between scenes."""
    noise: float = 0.0
    """Its variance within a scene, times the number of points."""

    def nats(self, value: float, points: int) -> float:
        """Return the log odds of up against down; the cue is normal under both, with opposite means.

        Args:
            value: of the cue; positive is evidence for up.
            points: number of surface patches that it comes from.
        """
        variance = self.deviation**2 + self.noise / max(points, 1)
        return float(np.clip(2.0 * self.mean * value / variance, -MAX_NATS, MAX_NATS))


CUES: Mapping[str, Cue] = {
    "low is near": Cue(0.20, 0.15),
    "tops are seen": Cue(0.15, 0.15, noise=4.0),
    "tops are bright": Cue(0.09, 0.08, noise=5.0),
    "ledges are lit": Cue(0.18, 0.17),
    "sky is above": Cue(0.20, 0.27),
}
"""Estimated on eight photo sets, three rendered ones and seven of corners only; figures from the others decide each
set the same way. The noise exceeds 1 because neighboring points share it."""


@dataclass(frozen=True, slots=True, eq=False)
class Scenery:
    """What a scene and its photos show."""

    points: FloatArray
    """(P, 3)"""
    brightness: FloatArray
    """(P,) 0 to 255."""
    seen: tuple[NDArray[np.int64], ...]
    """Per photo, the indices of the points that it sees."""
    pictures: tuple[NDArray[np.uint8] | None, ...]
    """Per photo its `small_picture`; None if it was not read."""


@dataclass(frozen=True, slots=True, eq=False)
class RollSelection:
    """Which way up a scene is, and the odds of that."""

    roll: Roll
    """The estimate from roll that was chosen."""
    evidence: Mapping[str, float]
    """By cue, log odds of up against down, in nats; negative if the cue contradicts."""
    sign_log_odds: float
    """Log odds of up against its opposite, including how cameras are held."""
    axis_log_odds: float
    """Log odds of the vertical against the other one."""


def select_roll(rolls: Sequence[Roll], rotations: FloatArray, centers: FloatArray, scenery: Scenery) -> RollSelection:
    """Choose first the vertical, from how the cameras are held and the ledges; then which end of it is up.

    Args:
        rolls: estimates for photos turned by 0, 90, 180, 270 degrees, see `ups_from_roll`; opposites share a vertical.
        rotations: (N, 3, 3) cam_from_world of the photos.
        centers: (N, 3) camera centers.
        scenery: what the photos show.
    """
    surfaces = fit_surfaces(scenery.points, scenery.brightness, scenery.seen, centers)
    ledges = [slope_asymmetry(roll.up, rotations, scenery.pictures) for roll in rolls[:2]]
    upright, lying = (
        float(np.logaddexp(-roll.cost, -opposite.cost)) for roll, opposite in zip(rolls[:2], rolls[2:], strict=True)
    )
    gap = (
        upright
        - lying
        + float(np.clip(LEDGE_NATS * (abs(ledges[0]) - abs(ledges[1])), -MAX_LEDGE_NATS, MAX_LEDGE_NATS))
    )
    chosen = 0 if gap >= 0 else 1
    up, down = rolls[chosen], rolls[chosen + 2]
    values = {
        "low is near": depth_height_correlation(up.up, rotations, centers, scenery.points, scenery.seen),
        "tops are seen": mean_upward_normal(up.up, surfaces),
        "tops are bright": brightness_normal_correlation(up.up, surfaces),
        "ledges are lit": ledges[chosen],
        "sky is above": sky_asymmetry(up.up, rotations, scenery.pictures),
    }
    evidence = {name: CUES[name].nats(value, len(surfaces.normals)) for name, value in values.items()}
    for_up = down.cost - up.cost + sum(evidence.values())
    if for_up < 0:
        up, evidence = down, {name: -nats for name, nats in evidence.items()}
    return RollSelection(up, evidence, abs(for_up), abs(gap))


def odds(nats: float) -> float:
    """Return log odds as odds to one, with two digits."""
    return float(f"{np.exp(min(nats, HIGHEST_NATS)):.2g}")
