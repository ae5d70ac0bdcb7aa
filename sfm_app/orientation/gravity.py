"""How a reconstructed scene stands: which way is up, and which side faces the viewer."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.similarity import Similarity
from sfm_app.geometry.unit_vectors import across, axis_angle_deg, basis_across, unit
from sfm_app.orientation.camera_roll import Roll, ups_from_roll
from sfm_app.orientation.ground_plane import dominant_plane
from sfm_app.orientation.up_direction import Scenery, Standing, stand
from sfm_app.orientation.vanishing_points import Segments, level_direction, square_frame, vanishing_near

FloatArray = NDArray[np.float64]

LINES, ROLL, GROUND, GPS = "vanishing lines", "camera roll", "ground plane", "GPS"
WALL, CAMERAS = "wall", "cameras"

UNSURE_DEG = 5.0
"""Cameras whose roll deviates by more say less about up than the plane that they stand on."""

FLOOR_DEG, WALL_DEG = (0.0, 20.0), (80.0, 90.0)
"""How far from up the normals of floors and of walls are."""

SQUARE_WITHIN_DEG = 30.0
"""The front is turned to the viewer when it is this near; a view across a corner stays one."""

MIDDLE = (0.2, 0.8)
"""Quantiles of the points between which the middle of the scene is half way."""


@dataclass(frozen=True, slots=True, eq=False)
class Upright:
    """Which way is up, and why."""

    up: FloatArray
    """(3,) unit vector in the world."""
    level: FloatArray | None
    """(3,) main horizontal direction of the lines, at right angles to `up`; None where there is none."""
    found_by: str
    """`LINES`, `ROLL`, `GROUND` or `GPS`."""
    deviation_deg: float
    """Standard deviation of `up`, in degrees, as its evidence has it."""
    standing: Standing
    """Which way up the photos are, and how sure that is."""

    @property
    def roll(self) -> Roll:
        """What the cameras alone say about up, once it is known which way up the photos are."""
        return self.standing.roll

    @property
    def off_roll_deg(self) -> float:
        """Angle between `up` and what the cameras alone say, in degrees."""
        return float(axis_angle_deg(self.up, self.roll.up))

    def turned_to(self, up: FloatArray, deviation_deg: float) -> "Upright":
        """Return the same, with up as GPS has it: heights know their sign.

        Args:
            up: (3,) unit vector in the world.
            deviation_deg: its standard deviation, degrees.
        """
        sure = Standing(self.roll, self.standing.evidence, np.inf, np.inf)
        return replace(self, up=up, level=None, found_by=GPS, deviation_deg=deviation_deg, standing=sure)


def up_direction(
    rotations: FloatArray, centers: FloatArray, scenery: Scenery, segments: Segments, turn_deg: int | None = None
) -> Upright:
    """Find up from the vertical lines of the scene near where the cameras' roll has it; else from roll or the ground.

    Args:
        rotations: (N, 3, 3) cam_from_world of the photos, N >= 1.
        centers: (N, 3) camera centers.
        scenery: what the photos show; tells the ways up apart in which they may have been taken.
        segments: lines in the photos; may be empty.
        turn_deg: by how much the photos have to be turned clockwise to stand upright: 0, 90, 180 or 270; None where
            nobody knows.
    """
    rolls = ups_from_roll(rotations, centers)
    if turn_deg is None:
        standing = stand(rolls, rotations, centers, scenery)
    else:
        standing = Standing(rolls[turn_deg // 90], {}, np.inf, np.inf)
    roll = standing.roll
    lines = vanishing_near(roll.up, segments)
    if lines is not None:
        level = level_direction(lines.direction, segments)
        if level is None:
            return Upright(lines.direction, None, LINES, lines.deviation_deg, standing)
        frame, deviation_deg = square_frame(lines.direction, level, segments)
        # verticals alone and all edges together err in their own ways: the gap between them says by how much
        gap_deg = float(axis_angle_deg(frame[0], lines.direction))
        return Upright(frame[0], frame[1], LINES, float(np.hypot(deviation_deg, gap_deg)), standing)
    ground = dominant_plane(scenery.points, roll.up, FLOOR_DEG) if roll.spread_deg > UNSURE_DEG else None
    if ground is not None:
        return Upright(ground.normal, None, GROUND, ground.deviation_deg, standing)
    return Upright(roll.up, None, ROLL, roll.deviation_deg, standing)


def facing(upright: Upright, rotations: FloatArray, points: FloatArray) -> tuple[FloatArray, str]:
    """Return horizontal direction (3,) that should point to the viewer, and what says so: `LINES`, `WALL` or `CAMERAS`.

    Towards the cameras; where lines or walls have a main direction near that, exactly along it.

    Args:
        upright: which way is up.
        rotations: (N, 3, 3) of cam_from_world.
        points: (P, 3) in the world.
    """
    up = upright.up
    towards = unit(across(-rotations[:, 2].mean(axis=0), up))
    if not towards.any():
        towards = basis_across(up)[0]
    axis, found_by = upright.level, LINES
    if axis is None and (wall := dominant_plane(points, up, WALL_DEG)) is not None:
        axis, found_by = unit(across(wall.normal, up)), WALL
    if axis is None:
        return towards, CAMERAS
    sides = np.stack([axis, np.cross(up, axis), -axis, np.cross(axis, up)])
    nearest = sides[int(np.argmax(sides @ towards))]
    square = nearest @ towards >= np.cos(np.radians(SQUARE_WITHIN_DEG))
    return (np.asarray(nearest), found_by) if square else (towards, CAMERAS)


def viewer_frame(up: FloatArray, towards: FloatArray, points: FloatArray, meters: float | None = None) -> Similarity:
    """Return the similarity into the frame of glTF viewers: y up, z to the viewer, the points about 0.

    Args:
        up: (3,) unit vector in the world.
        towards: (3,) unit vector at right angles to it, see `facing`.
        points: (P, 3) of the scene.
        meters: per unit of the world; where None, four of five points come to lie within 1 of the middle.
    """
    R = np.stack([np.cross(up, towards), up, towards])
    # The median would follow the points to where most of them happen to be, the whole box the farthest few.
    turned = points @ R.T
    center = np.mean(np.quantile(turned, MIDDLE, axis=0), axis=0)
    size = float(np.percentile(np.linalg.norm(turned - center, axis=1), 80))
    scale = 1.0 / max(size, 1e-12) if meters is None else meters
    return Similarity(scale, R, -scale * center)
