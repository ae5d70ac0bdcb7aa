"""Orientation of a scene: the up direction, and the side that faces the viewer.

The roll of the cameras gives one vertical for photos that are upright or upside down, and one for photos on their
side. Odds decide between the two, and which end is up: the prior odds of people turning all their photos, times the
evidence of the scene and the photos.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm_app.frame import up_cues
from sfm_app.frame.vanishing_points import Segments, find_vanishing_direction, fit_orthogonal_frame, level_direction
from sfm_app.geometry import poses
from sfm_app.types.arrays import ByteArray, FloatArray, IndexArray

LINES, ROLL, GROUND, GPS, FLIGHT = "vanishing lines", "camera roll", "ground plane", "GPS", "flight"
WALL, CAMERAS = "wall", "cameras"


class OPTIONS:
    """Constants of the up direction and of the frame of viewers."""

    samples: int = 1000
    max_points: int = 4000
    """Largest number of points that score a plane."""
    inlier_distance: float = 0.01
    """Largest distance of inliers from a plane, as a share of the scene's size."""
    min_share: float = 0.15
    max_nats: float = 3.0
    """Largest evidence of one cue: each of them is wrong in one place of twenty (a vault, a stage, snow)."""
    ledge_nats: float = 10.0
    """Nats for an axis per unit of `slope_asymmetry`. The other cues are as large sideways: along a wall, depth,
    normals and light change from side to side."""
    max_ledge_nats: float = 4.0
    highest_nats: float = 14.0
    """Odds above a million to one are not distinguished."""
    unsure_deg: float = 5.0
    """Spread of the cameras' roll above which the ground plane is better evidence for up."""
    floor_deg: tuple[float, float] = (0.0, 20.0)
    """Range of the angle between up and the normals of floors."""
    wall_deg: tuple[float, float] = (80.0, 90.0)
    """Range of the angle between up and the normals of walls."""
    square_deg: float = 30.0
    """Largest angle by which a front is turned to face the viewer; a view of a corner is kept."""
    flight_photos: int = 6
    """Least number of photos of a flight. Chosen by hand: two lines of three."""
    flight_deg: float = 15.0
    """Largest angle of most optical axes of a flight to their median, and of this to the normal of the cameras' plane.
    Chosen by hand: gimbals and wind err by a few degrees. Of 13 sets that people took, 6 have such axes, and their
    normals are 56 degrees off or more."""
    flight_most: float = 0.6
    """Share of these axes. Chosen by hand: a round of oblique photos is common."""
    flight_share: float = 0.15
    """Least deviation of the cameras across the flight, as a share of their height. Chosen by hand: two lines with 70 %
    overlap have 0.16; people at a wall vary their height by 0.1 of their distance."""
    flight_depth: float = 0.3
    """Largest deviation of the cameras along the view, as a share of that across the flight. Chosen by hand."""
    flight_nats: float = 3.0
    """Log odds that such photos show the ground and no wall. Chosen by hand: one of twenty flights scans a wall."""
    one_way_nats: float = 2.0
    """The same where no line turns the photos around, as at a wall. Chosen by hand: 7 to 1, which a warning states."""
    one_way: float = 0.9
    """Least length of the mean of their right sides. Chosen by hand: lines there and back have 0 to a third."""
    quantiles: tuple[float, float] = (0.2, 0.8)
    """Quantiles of the points with the middle of the scene halfway between them."""


def dominant_plane(
    points: FloatArray, axis: FloatArray, between_deg: tuple[float, float]
) -> tuple[FloatArray, float] | None:
    """Find the plane with most points whose normal is at a given angle to an axis; None without enough inliers.

    RANSAC with a fixed seed, then least squares on the inliers. `axis` is a unit vector (3,), angles are in [0, 90].
    The unit normal (3,) is on its side, with a standard deviation in degrees from the scatter of the points.
    """
    rng = np.random.default_rng(0)
    cloud = points[rng.permutation(len(points))[: OPTIONS.max_points]]
    if len(cloud) < 10:
        return None
    center = np.median(cloud, axis=0)
    reach = OPTIONS.inlier_distance * float(np.percentile(np.linalg.norm(cloud - center, axis=1), 80))
    best, most = None, OPTIONS.min_share * len(cloud)
    for triple in rng.integers(0, len(cloud), (OPTIONS.samples, 3)):
        a, b, c = cloud[triple]
        normal = poses.normalize(np.cross(b - a, c - a))
        if not normal.any() or not between_deg[0] <= poses.axis_angle_deg(normal, axis) <= between_deg[1]:
            continue
        near = np.abs(poses.component_along(cloud - a, normal)) < reach
        if np.count_nonzero(near) > most:
            best, most = near, float(np.count_nonzero(near))
    return None if best is None else _fit_plane(cloud[best], axis)


def _fit_plane(points: FloatArray, axis: FloatArray) -> tuple[FloatArray, float]:
    spread = points - points.mean(axis=0)
    scatter = np.einsum("ni,nj->ij", spread, spread)
    small, middle, _ = np.linalg.eigvalsh(scatter)
    # rounding may leave the least eigenvalue of coplanar points below zero
    deviation = np.degrees(np.arctan2(np.sqrt(max(small, 0.0) / len(points)), np.sqrt(max(middle, 1e-30))))
    return poses.smallest_eigenvector(scatter, axis), float(deviation)


@dataclass(frozen=True, slots=True)
class Cue:
    """Distribution of a cue over upright scenes."""

    mean: float
    deviation: float
    """Standard deviation between scenes."""
    noise: float = 0.0
    """Its variance within a scene, times the number of points."""

    def nats(self, value: float, points: int) -> float:
        """Return the log odds of up against down; the cue is normal under both, with opposite means."""
        variance = self.deviation**2 + self.noise / max(points, 1)
        return float(np.clip(2.0 * self.mean * value / variance, -OPTIONS.max_nats, OPTIONS.max_nats))


CUES: Mapping[str, Cue] = {
    "low is near": Cue(0.20, 0.15),
    "tops are seen": Cue(0.15, 0.15, noise=4.0),
    "tops are bright": Cue(0.09, 0.08, noise=5.0),
    "ledges are lit": Cue(0.18, 0.17),
    "sky is above": Cue(0.20, 0.27),
}
"""Estimated on eighteen photo sets; figures from the others decide each set the same way. The noise exceeds 1 because
neighboring points share it."""


@dataclass(frozen=True, slots=True, eq=False)
class Scenery:
    """Points of a scene, and its photos as small pictures."""

    points: FloatArray
    """(P, 3)"""
    brightness: FloatArray
    """(P,) 0 to 255."""
    visible: tuple[IndexArray, ...]
    """Per photo, the indices of its visible points."""
    pictures: tuple[ByteArray | None, ...]
    """Per photo its small gray picture, or None."""


@dataclass(frozen=True, slots=True, eq=False)
class UpEstimate:
    """The up direction of a scene, and its evidence."""

    up: FloatArray
    """(3,) unit vector in the world."""
    level: FloatArray | None
    """(3,) main horizontal direction of the lines, perpendicular to `up`; None without one."""
    method: str
    """Source of `up`: `LINES`, `ROLL`, `GROUND`, `GPS` or `FLIGHT`."""
    deviation_deg: float
    """Standard deviation of `up`, from its evidence."""
    roll: up_cues.Roll
    """Up from the cameras alone, for the chosen turn of the photos."""
    evidence: Mapping[str, float]
    """Log odds of up against down by cue, in nats; negative for a contradicting cue."""
    sign_log_odds: float
    """Log odds of up against its opposite, including how cameras are held."""
    axis_log_odds: float
    """Log odds of the vertical against the other one."""

    @property
    def angle_to_roll_deg(self) -> float:
        """Angle between `up` and up from the cameras alone, in degrees."""
        return float(poses.axis_angle_deg(self.up, self.roll.up))

    def with_up(self, up: FloatArray, deviation_deg: float) -> "UpEstimate":
        """Return a copy with up from GPS, a unit vector (3,) in the world whose sign is certain."""
        sure = replace(self, sign_log_odds=np.inf, axis_log_odds=np.inf)
        return replace(sure, up=up, level=None, method=GPS, deviation_deg=deviation_deg)


def select_roll(
    rolls: Sequence[up_cues.Roll], rotations: FloatArray, centers: FloatArray, scenery: Scenery
) -> UpEstimate:
    """Choose the vertical by roll and ledges, then its upper end by all cues; the rolls are in order of their turns."""
    surfaces = up_cues.fit_surfaces(scenery.points, scenery.brightness, scenery.visible, centers)
    ledges = [up_cues.slope_asymmetry(roll.up, rotations, scenery.pictures) for roll in rolls[:2]]
    upright, lying = (
        float(np.logaddexp(-roll.cost, -opposite.cost)) for roll, opposite in zip(rolls[:2], rolls[2:], strict=True)
    )
    by_ledges, limit = OPTIONS.ledge_nats * (abs(ledges[0]) - abs(ledges[1])), OPTIONS.max_ledge_nats
    gap = upright - lying + float(np.clip(by_ledges, -limit, limit))
    chosen = 0 if gap >= 0 else 1
    up, down = rolls[chosen], rolls[chosen + 2]
    values = {
        "low is near": up_cues.depth_height_correlation(up.up, rotations, centers, scenery.points, scenery.visible),
        "tops are seen": up_cues.mean_upward_normal(up.up, surfaces),
        "tops are bright": up_cues.brightness_normal_correlation(up.up, surfaces),
        "ledges are lit": ledges[chosen],
        "sky is above": up_cues.sky_asymmetry(up.up, rotations, scenery.pictures),
    }
    evidence = {name: CUES[name].nats(value, len(surfaces.normals)) for name, value in values.items()}
    for_up = down.cost - up.cost + sum(evidence.values())
    if for_up < 0:
        up, evidence = down, {name: -nats for name, nats in evidence.items()}
    return UpEstimate(up.up, None, ROLL, up.deviation_deg, up, evidence, abs(for_up), abs(gap))


def odds(nats: float) -> float:
    """Return log odds as odds to one, with two digits."""
    return float(f"{np.exp(min(nats, OPTIONS.highest_nats)):.2g}")


def up_direction(
    rotations: FloatArray, centers: FloatArray, scenery: Scenery, segments: Segments, turn_deg: int | None = None
) -> UpEstimate:
    """Find up from a flight, vertical lines near that of the cameras' roll, or else from the ground or the roll."""
    rolls = up_cues.roll_hypotheses(rotations, centers)
    if turn_deg is None:
        upright = select_roll(rolls, rotations, centers, scenery)
        flight = flight_direction(rotations, centers, scenery.points)
        if flight is not None:  # lines on the ground would pass for verticals
            up, deviation_deg, nats = flight
            sure = replace(upright, evidence={}, sign_log_odds=np.inf, axis_log_odds=nats)
            return replace(sure, up=up, method=FLIGHT, deviation_deg=deviation_deg)
    else:
        roll = rolls[turn_deg // 90]
        upright = UpEstimate(roll.up, None, ROLL, roll.deviation_deg, roll, {}, np.inf, np.inf)
    roll = upright.roll
    lines = find_vanishing_direction(roll.up, segments)
    if lines is not None:
        vertical, deviation_deg = lines
        level = level_direction(vertical, segments)
        if level is None:
            return replace(upright, up=vertical, method=LINES, deviation_deg=deviation_deg)
        frame, deviation_deg = fit_orthogonal_frame(vertical, level, segments)
        # verticals alone and all edges together have different errors; their angle measures both
        gap_deg = float(poses.axis_angle_deg(frame[0], vertical))
        deviation_deg = float(np.hypot(deviation_deg, gap_deg))
        return replace(upright, up=frame[0], level=frame[1], method=LINES, deviation_deg=deviation_deg)
    if roll.spread_deg > OPTIONS.unsure_deg:
        ground = dominant_plane(scenery.points, roll.up, OPTIONS.floor_deg)
        if ground is not None:
            return replace(upright, up=ground[0], method=GROUND, deviation_deg=ground[1])
    return upright


def flight_direction(
    rotations: FloatArray, centers: FloatArray, points: FloatArray
) -> tuple[FloatArray, float, float] | None:
    """Return up (3,), its deviation in degrees, and the log odds against a wall; None for photos of no flight.

    Most axes of a flight are parallel, and its centers lie in a plane across these. People who photograph a wall stand
    on one line. Up is the normal of that plane, since drones keep their height.
    """
    if len(centers) < OPTIONS.flight_photos:
        return None
    axis = poses.normalize(np.median(rotations[:, 2], axis=0))
    angles = np.degrees(np.arccos(np.clip(rotations[:, 2] @ axis, -1.0, 1.0)))
    spread = centers - centers.mean(axis=0)
    scatter = np.einsum("ni,nj->ij", spread, spread) / len(centers)
    small, across, _ = np.sqrt(np.maximum(np.linalg.eigvalsh(scatter), 0.0))
    height = float(np.median((points - centers.mean(axis=0)) @ axis))
    normal = poses.smallest_eigenvector(scatter, -axis)
    parallel = np.quantile(angles, OPTIONS.flight_most) <= OPTIONS.flight_deg >= poses.axis_angle_deg(normal, axis)
    flat = small <= OPTIONS.flight_depth * across
    if not (parallel and flat and height > 0.0 and across >= OPTIONS.flight_share * height):
        return None
    sides = rotations[angles <= OPTIONS.flight_deg, 0]
    is_one_way = np.linalg.norm(sides.mean(axis=0)) >= OPTIONS.one_way
    deviation_deg = float(np.degrees(np.arctan2(small / np.sqrt(len(centers)), across)))
    return normal, deviation_deg, OPTIONS.one_way_nats if is_one_way else OPTIONS.flight_nats


def viewer_direction(upright: UpEstimate, rotations: FloatArray, points: FloatArray) -> tuple[FloatArray, str]:
    """Choose the horizontal direction (3,) to the cameras, or of lines or walls near it, and name its source."""
    up = upright.up
    towards = poses.normalize(poses.perpendicular_component(-rotations[:, 2].mean(axis=0), up))
    if not towards.any():
        towards = poses.perpendicular_basis(up)[0]
    axis, source = upright.level, LINES
    if axis is None and (wall := dominant_plane(points, up, OPTIONS.wall_deg)) is not None:
        axis, source = poses.normalize(poses.perpendicular_component(wall[0], up)), WALL
    if axis is None:
        return towards, CAMERAS
    sides = np.stack([axis, np.cross(up, axis), -axis, np.cross(axis, up)])
    nearest = sides[int(np.argmax(sides @ towards))]
    square = nearest @ towards >= np.cos(np.radians(OPTIONS.square_deg))
    return (np.asarray(nearest), source) if square else (towards, CAMERAS)


def viewer_frame(
    up: FloatArray, towards: FloatArray, points: FloatArray, meters: float | None = None
) -> poses.Similarity:
    """Return the similarity into the frame of glTF viewers: y up, z to the viewer, the points around the origin.

    `up` and `towards` are perpendicular unit vectors (3,), `meters` those of a unit of the world; if None, four of five
    points come within 1 of the middle.
    """
    R = np.stack([np.cross(up, towards), up, towards])
    # the median would follow the densest points, the bounding box the farthest few
    rotated = points @ R.T
    center = np.mean(np.quantile(rotated, OPTIONS.quantiles, axis=0), axis=0)
    size = float(np.percentile(np.linalg.norm(rotated - center, axis=1), 80))
    scale = 1.0 / max(size, 1e-12) if meters is None else meters
    return poses.Similarity(scale, R, -scale * center)
