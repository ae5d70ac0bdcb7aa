"""A walk through a town of equal blocks: streets in a grid, and a camera that looks at their facades, with loops."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

BLOCK_M, STREET_M = 40.0, 12.0
"""Side of a block of houses, and width of the streets between blocks."""
PITCH_M = BLOCK_M + STREET_M
WALKED_TWICE = 1.6
"""Length of the walk over that of all streets of the town: it crosses itself and passes streets again."""
GLANCE_DEG, GLANCE_M = 45.0, 18.0
"""The camera sways this far to both sides, from side to side and back on this length of the walk."""
TURN_M = 5.0
"""Before and behind a corner the camera turns over this length."""
EYE_M = 1.6


@dataclass(frozen=True, slots=True, eq=False)
class TownWalk:
    """Where photos are taken, and which way they look."""

    blocks: int
    """Blocks of the town along each side."""
    centers: FloatArray
    """(N, 3) in meters; y is up, streets run along x and z at multiples of PITCH_M."""
    yaw: FloatArray
    """(N,) direction of view in radians, from z to x."""
    pitch: FloatArray
    """(N,) upwards, in radians."""

    @property
    def rotations(self) -> FloatArray:
        """(N, 3, 3) camera from world: x right, y down, z forward."""
        (sy, cy), (sp, cp) = ((np.sin(angle), np.cos(angle)) for angle in (self.yaw, self.pitch))
        forward = np.column_stack([sy * cp, sp, cy * cp])
        right = np.column_stack([-cy, np.zeros_like(cy), sy])
        return np.stack([right, np.cross(forward, right), forward], axis=1)


def walk_town(photos: int, step_m: float, seed: int) -> TownWalk:
    """Return a walk from crossing to crossing, along streets not seen before where there are any.

    The town is as large as the walk can cover.

    Args:
        photos: taken at even steps.
        step_m: length of a step.
        seed: of the way and of the sway of the camera.
    """
    rng = np.random.default_rng([seed, 721])
    length = photos * step_m
    blocks = max(2, round(math.sqrt(length / WALKED_TWICE / (2.0 * PITCH_M))))
    corners = _walk_corners(blocks, length + TURN_M, rng)
    along = step_m * np.arange(photos)
    before, place, behind = (_route_points(corners, along + shift) for shift in (-TURN_M, 0.0, TURN_M))
    place += rng.normal(scale=0.4, size=(photos, 2))
    sway = np.radians(GLANCE_DEG) * np.sin(2 * np.pi * along / GLANCE_M)
    yaw = np.arctan2(*(behind - before).T) + sway + np.radians(rng.normal(scale=5.0, size=photos))
    centers = np.column_stack([place[:, 0], EYE_M + rng.normal(scale=0.1, size=photos), place[:, 1]])
    return TownWalk(blocks, centers, yaw, np.radians(8.0 + rng.normal(scale=3.0, size=photos)))


def _walk_corners(blocks: int, length: float, rng: np.random.Generator) -> FloatArray:
    """Return (N, 2) the crossings that a walk of some length comes to."""
    at, stops, walked = (0, 0), [(0, 0)], set[frozenset[tuple[int, int]]]()
    while (len(stops) - 1) * PITCH_M < length:
        ways = [(at[0] + dx, at[1] + dz) for dx, dz in ((1, 0), (0, 1), (-1, 0), (0, -1))]
        ways = [way for way in ways if min(way) >= 0 and max(way) <= blocks and way != (stops[-2:] or [at])[0]]
        fresh = [way for way in ways if frozenset((at, way)) not in walked] or ways
        chosen = fresh[int(rng.integers(len(fresh)))]
        walked.add(frozenset((at, chosen)))
        stops.append(chosen)
        at = chosen
    return PITCH_M * np.array(stops, np.float64)


def _route_points(corners: FloatArray, along: NDArray[np.floating]) -> FloatArray:
    """Return (N, 2) points of a route at some lengths from its start; it goes on straight at its ends."""
    leg = np.clip(along // PITCH_M, 0, len(corners) - 2).astype(np.int64)
    start, end = corners[leg], corners[leg + 1]
    return np.asarray(start + (along / PITCH_M - leg)[:, None] * (end - start), np.float64)
