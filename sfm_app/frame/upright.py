"""Orientation of the finished scene for viewers: upright, centered, and in meters where GPS gives the scale."""

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import Reconstruction, translate_errors
from sfm_app.colmap.model import (
    finite_mask,
    focal_px,
    move,
    posed_photo_ids,
    poses_and_points,
    seen_points,
    viewing_rays,
)
from sfm_app.errors import NumericalError
from sfm_app.frame.georeference import Georeference, NoGeoreference, georeference, position_from_enu
from sfm_app.frame.up_cues import small_picture
from sfm_app.frame.up_direction import LINES, Scenery, UpEstimate, odds, up_direction, viewer_direction, viewer_frame
from sfm_app.frame.vanishing_points import Segments, concatenate_segments, line_segments, segment_planes
from sfm_app.geometry.poses import Similarity
from sfm_app.numerical import FAILURES, Json, error_reason
from sfm_app.runtime.context import RunContext
from sfm_app.types import GpsPosition, MatchGraph
from sfm_app.types.arrays import FloatArray

logger = logging.getLogger("sfm_app")


SAMPLED_PHOTOS = 10
"""Number of photos per model that are searched for cues, spread over the set."""

SCENERY_POINTS = 8000
"""Number of points used to find the up direction; more of them do not improve it."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoCues:
    """Cues to the up direction from one photo."""

    lines: FloatArray
    """(N, 4) line segments in pixels of the photo."""
    picture: NDArray[np.uint8] | None
    """The photo itself, gray and small; None if it could not be read."""


FutureCues = Mapping[int, "Future[PhotoCues]"]
"""Futures of the cues, by photo."""


def submit_cue_extraction(models: Sequence[Reconstruction], matches: MatchGraph, run: RunContext) -> FutureCues:
    """Start to extract cues from some photos of every model, in the background."""
    looks = {}
    for model in models:
        posed = posed_photo_ids(model)
        for k in np.unique(np.linspace(0, len(posed) - 1, SAMPLED_PHOTOS).astype(int)):
            image = matches.images[posed[k]]
            looks[posed[k]] = run.executor.submit(extract_cues, run.workspace.photos / image.name, image.turn_deg)
    return looks


def orient_or_keep(
    model: Reconstruction, matches: MatchGraph, looks: FutureCues, turn_deg: int | None = None
) -> dict[str, Json]:
    """Turn the model upright; where that fails numerically, leave it unchanged and return the reason."""
    try:
        return orient(model, matches, looks, turn_deg)
    except FAILURES as err:
        logger.info("the model could not be turned upright", exc_info=err)
        return {
            "failed": error_reason(err),
            "unit": "that of mapping",
            "gps": "not used: it is not known which way is up",
        }


def orient(
    model: Reconstruction, matches: MatchGraph, looks: FutureCues, turn_deg: int | None = None
) -> dict[str, Json]:
    """Move the model into the frame of glTF viewers: y up, seen from +z, centered, of size about 1 or in meters.

    Args:
        turn_deg: angle by which the photos have to be turned clockwise to stand upright; None if unknown.

    Returns:
        The orientation and its evidence, for the manifest.

    Raises:
        NumericalError: the model has no finite points.
    """
    with translate_errors("reading the model"):
        poses, points = poses_and_points(model)
    points = points[finite_mask(points)]
    if not len(points):
        raise NumericalError("it has no points")
    matrices = np.array(list(poses.values()))
    centers = -np.einsum("nij,ni->nj", matrices[:, :, :3], matrices[:, :, 3])
    turns = [matches.images[photo].turn_deg for photo in poses]
    R = np.array([turn_camera(rotation, turn) for rotation, turn in zip(matrices[:, :, :3], turns, strict=True)])
    found = {photo: looks[photo].result() for photo in poses if photo in looks}
    upright = up_direction(R, centers, _scenery(model, found), _world_segments(model, found), turn_deg)
    positions = [matches.images[key].gps for key in poses]
    gps = _georeference(centers, positions, upright)
    meters = None
    if isinstance(gps, Georeference):
        meters = gps.enu_from_world.scale
        if gps.up_deviation_deg is not None:
            upright = upright.with_up(gps.enu_from_world.R[2], gps.up_deviation_deg)
    towards, front = viewer_direction(upright, R, points)
    viewer = viewer_frame(upright.up, towards, points, meters)
    if not is_sound(viewer):
        raise NumericalError("the frame of the viewer is not finite")
    with translate_errors("turning the model upright"):
        move(model, viewer)
    entry = _orientation_entry(upright, front) | _georeference_entry(viewer, gps)
    logger.info("orientation: %s", entry)
    return entry


def _georeference(
    centers: FloatArray, positions: Sequence[GpsPosition | None], upright: UpEstimate
) -> Georeference | NoGeoreference:
    try:
        found = georeference(centers, positions, upright.up, up_is_sure=upright.method == LINES)
    except FAILURES as err:
        logger.info("the GPS positions could not be used", exc_info=err)
        return NoGeoreference(f"the computation failed: {error_reason(err)}")
    if not isinstance(found, Georeference) or is_sound(found.enu_from_world):
        return found
    return NoGeoreference("the positions give no scale")


def is_sound(similarity: Similarity) -> bool:
    """Return whether a similarity is finite and invertible."""
    return bool(np.isfinite(similarity.R).all() and np.isfinite(similarity.t).all() and 0.0 < similarity.scale < np.inf)


def turn_camera(R: FloatArray, turn_deg: int) -> FloatArray:
    """Return the rotation (3, 3) cam_from_world of a photo that is turned clockwise.

    Args:
        R: (3, 3) rotation cam_from_world of the photo before.
        turn_deg: multiple of 90 degrees.
    """
    cosine, sine = round(np.cos(np.radians(turn_deg))), round(np.sin(np.radians(turn_deg)))
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ R


def _world_segments(model: Reconstruction, looks: Mapping[int, PhotoCues]) -> Segments:
    """Return the line segments of the photos of a model, in the world frame."""
    with translate_errors("computing viewing rays of line segments"):
        return concatenate_segments([_to_world(model, photo, look.lines) for photo, look in looks.items()])


def _scenery(model: Reconstruction, looks: Mapping[int, PhotoCues]) -> Scenery:
    """Return points of a model and its small photos, as evidence for the up direction."""
    with translate_errors("reading the points"):
        shown = seen_points(model, SCENERY_POINTS)
    pictures = tuple(looks[photo].picture if photo in looks else None for photo in posed_photo_ids(model))
    return Scenery(shown.points, shown.colors.mean(axis=1), shown.seen, pictures)


def extract_cues(path: Path, turn_deg: int = 0) -> PhotoCues:
    """Return the line segments of a photo, and a small upright copy of it; empty if OpenCV cannot read the photo."""
    try:
        data = np.fromfile(path, np.uint8)  # OpenCV does not open names beyond ASCII on every system
    except OSError:
        data = np.zeros(0, np.uint8)
    read = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    if read is None:
        return PhotoCues(np.zeros((0, 4)), None)
    gray = np.asarray(read, np.uint8)
    return PhotoCues(line_segments(gray), np.rot90(small_picture(gray), -turn_deg // 90))


def _to_world(model: Reconstruction, image_id: int, lines: FloatArray) -> Segments:
    first, second = (viewing_rays(model, image_id, lines[:, ends]) for ends in (slice(0, 2), slice(2, 4)))
    return segment_planes(first, second, image_id, focal_px(model, image_id))


def _orientation_entry(upright: UpEstimate, front: str) -> dict[str, Json]:
    """Return the up and front directions and their evidence, for the manifest."""
    standing = upright.selection
    return {
        "up": upright.method,
        "up_deviation_deg": round(upright.deviation_deg, 3) if np.isfinite(upright.deviation_deg) else None,
        "off_camera_roll_deg": round(upright.angle_to_roll_deg, 2),
        "camera_roll_spread_deg": round(upright.roll.spread_deg, 2),
        "photos_turned_deg": upright.roll.turn_deg,
        "up_sign_odds": odds(standing.sign_log_odds),
        "up_axis_odds": odds(standing.axis_log_odds),
        "up_evidence_nats": {name: round(nats, 1) for name, nats in standing.evidence.items()},
        "front": front,
    }


def gps_deviation(orientation: Mapping[str, Json]) -> float | None:
    """Return the relative standard deviation of the meter by GPS; None where the unit is arbitrary."""
    found = orientation.get("georeference")
    percent = found.get("scale_deviation_percent") if isinstance(found, Mapping) else None
    return float(percent) / 100.0 if isinstance(percent, int | float) else None


def _georeference_entry(viewer: Similarity, gps: Georeference | NoGeoreference) -> dict[str, Json]:
    """Return the unit and georeference of the model that `viewer` has moved, for the manifest."""
    if isinstance(gps, NoGeoreference):
        return {"unit": "about the size of the scene", "gps": f"not used: {gps.reason}"}
    enu_from_model = gps.enu_from_world.compose(viewer.inverse())
    origin = position_from_enu(enu_from_model.t, gps.origin)
    east, north, _ = -enu_from_model.R[:, 2]
    return {
        "unit": "meter",
        "gps": f"{gps.photos} of {gps.of} positions agree",
        "georeference": {
            "latitude_deg": round(origin.latitude_deg, 8),
            "longitude_deg": round(origin.longitude_deg, 8),
            "altitude_m": None if origin.altitude_m is None else round(origin.altitude_m, 2),
            "heading_deg": round(float(np.degrees(np.arctan2(east, north))) % 360.0, 3),
            "scale_deviation_percent": round(100 * gps.scale_deviation, 2),
            "residual_m": round(gps.rms_m, 2),
        },
    }
