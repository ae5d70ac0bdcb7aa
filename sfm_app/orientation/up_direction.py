"""Which way up a scene stands, where how the cameras were held leaves it open.

How cameras are held gives one vertical for photos that are upright or upside down, and one for photos on their side.
Which of the two is taken, and which of its ends is up, is a matter of odds: how rarely people turn all their photos,
times what the scene and the photos show.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.orientation.camera_roll import Roll
from sfm_app.orientation.up_cues import (
    ledges_are_lit,
    low_is_near,
    sky_is_above,
    surfaces_of,
    tops_are_bright,
    tops_are_seen,
)

FloatArray = NDArray[np.float64]

MOST = 3.0
"""Nats that one cue says at most: each of them is wrong in one place of twenty (a vault, a stage, snow)."""

LEDGES, LEDGES_MOST = 10.0, 4.0
"""Nats for an axis per unit of `ledges_are_lit`, and at most. The other cues are as large sideways: along a wall depth,
normals and light change from side to side."""

HIGHEST_NATS = 14.0
"""Odds above a million to one are not told apart."""


@dataclass(frozen=True, slots=True)
class Cue:
    """How a cue turns out in scenes that stand upright."""

    mean: float
    deviation: float
    """Standard deviation between scenes."""
    noise: float = 0.0
    """Its variance within a scene, times the number of points."""

    def nats(self, value: float, points: int) -> float:
        """Return log odds of up against down: both are normal, with opposite means.

        Args:
            value: of the cue; above 0 speaks for up.
            points: pieces of surface that it comes from.
        """
        variance = self.deviation**2 + self.noise / max(points, 1)
        return float(np.clip(2.0 * self.mean * value / variance, -MOST, MOST))


CUES: Mapping[str, Cue] = {
    "low is near": Cue(0.20, 0.15),
    "tops are seen": Cue(0.15, 0.15, noise=4.0),
    "tops are bright": Cue(0.09, 0.08, noise=5.0),
    "ledges are lit": Cue(0.18, 0.17),
    "sky is above": Cue(0.20, 0.27),
}
"""From eight photo sets, three rendered ones and seven of corners only; each set alone would be decided alike by the
figures of the others. Neighboring points share noise, hence more than 1."""


@dataclass(frozen=True, slots=True, eq=False)
class Scenery:
    """What a scene and its photos show."""

    points: FloatArray
    """(P, 3)"""
    brightness: FloatArray
    """(P,) 0 to 255."""
    seen: tuple[NDArray[np.int64], ...]
    """Per photo the points that it sees."""
    pictures: tuple[NDArray[np.uint8] | None, ...]
    """Per photo its `small_picture`; None where it was not looked at."""


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """Which way up a scene stands, and how sure that is."""

    roll: Roll
    """How the cameras were held, then."""
    evidence: Mapping[str, float]
    """By cue, nats (log odds) for up against down; below 0 where it says that up is down."""
    not_upside_down: float
    """Log odds against the opposite of up, how cameras are held included."""
    not_on_its_side: float
    """Log odds against the other vertical."""


def stand(rolls: Sequence[Roll], rotations: FloatArray, centers: FloatArray, scenery: Scenery) -> Standing:
    """Return first the vertical, from how the cameras are held and the ledges; then which end of it is up.

    Args:
        rolls: what the cameras say if most photos are turned by 0, 90, 180, 270 degrees; opposites share a vertical.
        rotations: (N, 3, 3) cam_from_world of the photos.
        centers: (N, 3) camera centers.
        scenery: what they show.
    """
    surfaces = surfaces_of(scenery.points, scenery.brightness, scenery.seen, centers)
    ledges = [ledges_are_lit(roll.up, rotations, scenery.pictures) for roll in rolls[:2]]
    upright, lying = (
        float(np.logaddexp(-roll.cost, -opposite.cost)) for roll, opposite in zip(rolls[:2], rolls[2:], strict=True)
    )
    gap = upright - lying + float(np.clip(LEDGES * (abs(ledges[0]) - abs(ledges[1])), -LEDGES_MOST, LEDGES_MOST))
    chosen = 0 if gap >= 0 else 1
    up, down = rolls[chosen], rolls[chosen + 2]
    values = {
        "low is near": low_is_near(up.up, rotations, centers, scenery.points, scenery.seen),
        "tops are seen": tops_are_seen(up.up, surfaces),
        "tops are bright": tops_are_bright(up.up, surfaces),
        "ledges are lit": ledges[chosen],
        "sky is above": sky_is_above(up.up, rotations, scenery.pictures),
    }
    evidence = {name: CUES[name].nats(value, len(surfaces.normals)) for name, value in values.items()}
    for_up = down.cost - up.cost + sum(evidence.values())
    if for_up < 0:
        up, evidence = down, {name: -nats for name, nats in evidence.items()}
    return Standing(up, evidence, abs(for_up), abs(gap))


def odds(nats: float) -> float:
    """Return log odds as odds to one, with two digits."""
    return float(f"{np.exp(min(nats, HIGHEST_NATS)):.2g}")
