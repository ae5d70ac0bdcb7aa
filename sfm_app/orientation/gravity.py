"""Orientation of a reconstructed scene: which way is up, and which side faces the viewer."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.similarity import Similarity
from sfm_app.geometry.unit_vectors import axis_angle_deg, normalize, perpendicular_basis, perpendicular_component
from sfm_app.orientation.camera_roll import Roll, roll_hypotheses
from sfm_app.orientation.ground_plane import dominant_plane
from sfm_app.orientation.up_direction import RollSelection, Scenery, select_roll
from sfm_app.orientation.vanishing_points import (
    Segments,
    find_vanishing_direction,
    fit_orthogonal_frame,
    level_direction,
)

FloatArray = NDArray[np.float64]

LINES, ROLL, GROUND, GPS = "vanishing lines", "camera roll", "ground plane", "GPS"
WALL, CAMERAS = "wall", "cameras"

UNSURE_DEG = 5.0
"""Spread of the cameras' roll above which the ground plane is better evidence for up."""

FLOOR_DEG, WALL_DEG = (0.0, 20.0), (80.0, 90.0)
"""Ranges of the angle between up and the normals of floors, and of walls."""

SQUARE_WITHIN_DEG = 30.0
"""Largest angle by which a front is turned to face the viewer; a view of a corner is kept."""

MIDDLE_QUANTILES = (0.2, 0.8)
"""Quantiles of the points; the middle of the scene is halfway between them."""


@dataclass(frozen=True, slots=True, eq=False)
class UpEstimate:
    """The up direction of a scene, and its evidence."""

    up: FloatArray
    """(3,) unit vector in the world."""
    level: FloatArray | None
    """(3,) main horizontal direction of the lines, perpendicular to `up`; None if none was found."""
    method: str
    """Source of `up`: `LINES`, `ROLL`, `GROUND` or `GPS`."""
    deviation_deg: float
    """Standard deviation of `up` in degrees, estimated from its evidence."""
    selection: RollSelection
    """Which way up the photos are, and the odds of that."""

    @property
    def roll(self) -> Roll:
        """Up from the cameras alone, for the turn of the photos that was chosen."""
        return self.selection.roll

    @property
    def angle_to_roll_deg(self) -> float:
        """Angle between `up` and up from the cameras alone, in degrees."""
        return float(axis_angle_deg(self.up, self.roll.up))

    def with_up(self, up: FloatArray, deviation_deg: float) -> "UpEstimate":
        """Return a copy with up from GPS, whose sign is certain.

        Args:
            up: (3,) unit vector in the world.
            deviation_deg: its standard deviation, degrees.
        """
        sure = RollSelection(self.roll, self.selection.evidence, np.inf, np.inf)
        return replace(self, up=up, level=None, method=GPS, deviation_deg=deviation_deg, selection=sure)


def up_direction(
    rotations: FloatArray, centers: FloatArray, scenery: Scenery, segments: Segments, turn_deg: int | None = None
) -> UpEstimate:
    """Find up from vertical lines near the up direction of the cameras' roll, or else from the ground or the roll.

    Args:
        rotations: (N, 3, 3) cam_from_world of the photos, N >= 1.
        centers: (N, 3) camera centers.
        scenery: what the photos show; decides which way up they were taken.
        segments: lines in the photos; may be empty.
        turn_deg: clockwise turn that makes the photos upright: 0, 90, 180 or 270; None if unknown.
    """
    rolls = roll_hypotheses(rotations, centers)
    if turn_deg is None:
        standing = select_roll(rolls, rotations, centers, scenery)
    else:
        standing = RollSelection(rolls[turn_deg // 90], {}, np.inf, np.inf)
    roll = standing.roll
    lines = find_vanishing_direction(roll.up, segments)
    if lines is not None:
        level = level_direction(lines.direction, segments)
        if level is None:
            return UpEstimate(lines.direction, None, LINES, lines.deviation_deg, standing)
        frame, deviation_deg = fit_orthogonal_frame(lines.direction, level, segments)
        # verticals alone and all edges together have different errors: the gap between them is a measure of both
        gap_deg = float(axis_angle_deg(frame[0], lines.direction))
        return UpEstimate(frame[0], frame[1], LINES, float(np.hypot(deviation_deg, gap_deg)), standing)
    ground = dominant_plane(scenery.points, roll.up, FLOOR_DEG) if roll.spread_deg > UNSURE_DEG else None
    if ground is not None:
        return UpEstimate(ground.normal, None, GROUND, ground.deviation_deg, standing)
    return UpEstimate(roll.up, None, ROLL, roll.deviation_deg, standing)


def viewer_direction(upright: UpEstimate, rotations: FloatArray, points: FloatArray) -> tuple[FloatArray, str]:
    """Choose the horizontal direction (3,) that points to the viewer, and its source: `LINES`, `WALL` or `CAMERAS`.

    It points to the cameras; if lines or walls have a main direction near that, exactly along it.

    Args:
        upright: which way is up.
        rotations: (N, 3, 3) of cam_from_world.
        points: (P, 3) in the world.
    """
    up = upright.up
    towards = normalize(perpendicular_component(-rotations[:, 2].mean(axis=0), up))
    if not towards.any():
        towards = perpendicular_basis(up)[0]
    axis, found_by = upright.level, LINES
    if axis is None and (wall := dominant_plane(points, up, WALL_DEG)) is not None:
        axis, found_by = normalize(perpendicular_component(wall.normal, up)), WALL
    if axis is None:
        return towards, CAMERAS
    sides = np.stack([axis, np.cross(up, axis), -axis, np.cross(axis, up)])
    nearest = sides[int(np.argmax(sides @ towards))]
    square = nearest @ towards >= np.cos(np.radians(SQUARE_WITHIN_DEG))
    return (np.asarray(nearest), found_by) if square else (towards, CAMERAS)


def viewer_frame(up: FloatArray, towards: FloatArray, points: FloatArray, meters: float | None = None) -> Similarity:
    """Return the similarity into the frame of glTF viewers: y up, z to the viewer, the points around the origin.

    Args:
        up: (3,) unit vector in the world.
        towards: (3,) unit vector perpendicular to it, see `viewer_direction`.
        points: (P, 3) of the scene.
        meters: per unit of the world; if None, four of five points will lie within 1 of the middle.
    """
    R = np.stack([np.cross(up, towards), up, towards])
    # The median would follow the densest points, the bounding box the farthest few.
    turned = points @ R.T
    center = np.mean(np.quantile(turned, MIDDLE_QUANTILES, axis=0), axis=0)
    size = float(np.percentile(np.linalg.norm(turned - center, axis=1), 80))
    scale = 1.0 / max(size, 1e-12) if meters is None else meters
    return Similarity(scale, R, -scale * center)
