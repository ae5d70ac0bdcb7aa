"""Orientation of the finished scene for viewers: upright, centered, and in meters where GPS gives the scale."""

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

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
from sfm_app.frame.coordinates import GPS_SYSTEM
from sfm_app.frame.georeference import Georeference, georeference, position_from_enu
from sfm_app.frame.up_cues import CUE_OPTIONS
from sfm_app.frame.up_direction import LINES, Scenery, UpEstimate, odds, up_direction, viewer_direction, viewer_frame
from sfm_app.frame.vanishing_points import Segments, concatenate_segments, line_segments, segment_planes, shrink
from sfm_app.geometry.poses import Similarity
from sfm_app.numerical import FAILURES, Json, error_reason
from sfm_app.runtime.context import RunContext
from sfm_app.types import GpsPosition, MapPlace, MatchGraph, Rejected
from sfm_app.types.arrays import ByteArray, FloatArray

logger = logging.getLogger("sfm_app")


@dataclass(frozen=True, slots=True, eq=False)
class PhotoCues:
    """Cues to the up direction from one photo."""

    lines: FloatArray
    """(N, 4) line segments in pixels of the photo."""
    picture: ByteArray | None
    """The photo, gray and small; None if OpenCV cannot read it."""


FutureCues = Mapping[int, "Future[PhotoCues]"]
"""By photo."""


def submit_cue_extraction(models: Sequence[Reconstruction], matches: MatchGraph, run: RunContext) -> FutureCues:
    """Start to extract cues from ten photos of every model in the background; no photo is in two models."""
    cues = {}
    for model in models:
        posed = posed_photo_ids(model)
        for k in np.unique(np.linspace(0, len(posed) - 1, 10).astype(int)):
            image = matches.images[posed[k]]
            cues[posed[k]] = run.executor.submit(extract_cues, run.workspace.photos / image.name, image.turn_deg)
    return cues


def orient_or_keep(
    model: Reconstruction, matches: MatchGraph, cues: FutureCues, turn_deg: int | None = None
) -> dict[str, Json]:
    """Orient the model; on a numerical failure leave it unchanged and return the reason."""
    try:
        return orient(model, matches, cues, turn_deg)
    except FAILURES as err:
        logger.info("the model cannot be oriented", exc_info=err)
        return {"failed": error_reason(err), "unit": "that of mapping", "gps": "not used: the up direction is unknown"}


def orient(
    model: Reconstruction, matches: MatchGraph, cues: FutureCues, turn_deg: int | None = None
) -> dict[str, Json]:
    """Move the colored model into the frame of glTF viewers: y up, seen from +z, centered, of size 1 or in meters.

    Return the orientation and its evidence for the manifest. `turn_deg` is the clockwise turn that makes the photos
    upright, None if unknown. A NumericalError says that the model has no finite points.
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
    shown = {photo: cues[photo].result() for photo in poses if photo in cues}
    upright = up_direction(R, centers, _scenery(model, shown), _world_segments(model, shown), turn_deg)
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
    entry = {
        "up": upright.method,
        "up_deviation_deg": round(upright.deviation_deg, 3) if np.isfinite(upright.deviation_deg) else None,
        "off_camera_roll_deg": round(upright.angle_to_roll_deg, 2),
        "camera_roll_spread_deg": round(upright.roll.spread_deg, 2),
        "photos_turned_deg": upright.roll.turn_deg,
        "up_sign_odds": odds(upright.sign_log_odds),
        "up_axis_odds": odds(upright.axis_log_odds),
        "up_evidence_nats": {name: round(nats, 1) for name, nats in upright.evidence.items()},
        "front": front,
    } | _georeference_entry(viewer, gps)
    logger.info("orientation: %s", entry)
    return entry


def _georeference(
    centers: FloatArray, positions: Sequence[GpsPosition | None], upright: UpEstimate
) -> Georeference | Rejected:
    try:
        gps = georeference(centers, positions, upright.up, up_is_sure=upright.method == LINES)
    except FAILURES as err:
        logger.info("the GPS positions cannot be used", exc_info=err)
        return Rejected(f"the computation failed: {error_reason(err)}")
    if not isinstance(gps, Georeference) or is_sound(gps.enu_from_world):
        return gps
    return Rejected("the positions give no scale")


def is_sound(similarity: Similarity) -> bool:
    """Return whether a similarity is finite and invertible."""
    return bool(np.isfinite(similarity.R).all() and np.isfinite(similarity.t).all() and 0.0 < similarity.scale < np.inf)


def turn_camera(R: FloatArray, turn_deg: int) -> FloatArray:
    """Return the rotation (3, 3) cam_from_world after a clockwise turn of the photo by a multiple of 90 degrees."""
    cosine, sine = round(np.cos(np.radians(turn_deg))), round(np.sin(np.radians(turn_deg)))
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ R


def _world_segments(model: Reconstruction, cues: Mapping[int, PhotoCues]) -> Segments:
    parts = []
    with translate_errors("computing viewing rays of line segments"):
        for photo, cue in cues.items():
            first, second = (viewing_rays(model, photo, cue.lines[:, ends]) for ends in (slice(0, 2), slice(2, 4)))
            parts.append(segment_planes(first, second, photo, focal_px(model, photo)))
        return concatenate_segments(parts)


def _scenery(model: Reconstruction, cues: Mapping[int, PhotoCues]) -> Scenery:
    """Return points of a model and its small photos; more than 8000 points do not improve the up direction."""
    with translate_errors("reading the points"):
        visible = seen_points(model, 8000)
    pictures = tuple(cues[photo].picture if photo in cues else None for photo in posed_photo_ids(model))
    return Scenery(visible.points, visible.colors.mean(axis=1), visible.seen, pictures)


def extract_cues(path: Path, turn_deg: int = 0) -> PhotoCues:
    """Return the line segments and a small copy of a photo that is upright after a clockwise turn by `turn_deg`."""
    try:
        data = np.fromfile(path, np.uint8)  # OpenCV opens names beyond ASCII on some systems only
    except OSError:
        data = np.zeros(0, np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    if picture is None:
        return PhotoCues(np.zeros((0, 4)), None)
    gray = np.asarray(picture, np.uint8)
    return PhotoCues(line_segments(gray), np.rot90(shrink(gray, CUE_OPTIONS.picture_px), -turn_deg // 90))


def gps_deviation(orientation: Mapping[str, Json]) -> float | None:
    """Return the relative standard deviation of the meter by GPS, from the manifest's entry; None if it is unknown."""
    entry = orientation.get("georeference")
    percent = entry.get("scale_deviation_percent") if isinstance(entry, Mapping) else None
    return float(percent) / 100.0 if isinstance(percent, int | float) else None


def gps_place(orientation: Mapping[str, Json]) -> MapPlace | None:
    """Return the place of the model by GPS, from the manifest's entry; None if it is unknown.

    Without altitudes, heights count from the median of the cameras.
    """
    entry = orientation.get("georeference")
    if not isinstance(entry, Mapping):
        return None
    keys = ("longitude_deg", "latitude_deg", "altitude_m", "heading_deg")
    x, y, z, heading_deg = (float(str(entry[key] or 0.0)) for key in keys)
    return MapPlace(GPS_SYSTEM, (x, y, z), heading_deg)


def _georeference_entry(viewer: Similarity, gps: Georeference | Rejected) -> dict[str, Json]:
    if isinstance(gps, Rejected):
        return {"unit": "about the size of the scene", "gps": f"not used: {gps.reason}"}
    enu_from_model = gps.enu_from_world.compose(viewer.inverse())
    origin = position_from_enu(enu_from_model.t, gps.origin)
    east, north, _ = -enu_from_model.R[:, 2]
    return {
        "unit": "meter",
        "gps": f"{gps.inliers} of {gps.positions} positions agree",
        "georeference": {
            "latitude_deg": round(origin.latitude_deg, 10),
            "longitude_deg": round(origin.longitude_deg, 10),
            "altitude_m": None if origin.altitude_m is None else round(origin.altitude_m, 4),
            "heading_deg": round(float(np.degrees(np.arctan2(east, north))) % 360.0, 7),
            "scale_deviation_percent": round(100 * gps.scale_deviation, 2),
            "residual_m": round(gps.rms_m, 2),
        },
    }
