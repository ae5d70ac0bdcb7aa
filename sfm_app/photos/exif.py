"""Read EXIF: hints about a photo that are never trusted."""

from collections.abc import Mapping
from typing import Any

from PIL import Image

from sfm_app.types import GpsPosition

MAKE, MODEL, ORIENTATION, EXIF_IFD, GPS_IFD = 0x010F, 0x0110, 0x0112, 0x8769, 0x8825
FOCAL_MM, FOCAL_35MM, ZOOM = 0x920A, 0xA405, 0xA404
GPS_LATITUDE_REF, GPS_LATITUDE, GPS_LONGITUDE_REF, GPS_LONGITUDE, GPS_ALTITUDE_REF, GPS_ALTITUDE = range(1, 7)

TAKEN_WIDTH, TAKEN_HEIGHT, SENSOR_RESOLUTION, SENSOR_UNIT = 0xA002, 0xA003, 0xA20E, 0xA210

FULL_FRAME_WIDTH_MM = 36.0
INCH = 2
SENSOR_UNITS_MM = {INCH: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""Lengths of EXIF's units of the resolution of a sensor; the inch where nothing is said. By definition."""
LOWEST_M, HIGHEST_M = -1000.0, 20_000.0
"""Range of plausible altitudes."""


def orientation(exif: Image.Exif) -> int:
    """Return the EXIF orientation, 1 to 8; 1 (upright) if it is missing or invalid."""
    value = exif.get(ORIENTATION, 1)
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def turn_deg(exif: Image.Exif) -> int:
    """Return the clockwise rotation from sensor to upright, in degrees; 0 also for mirrored pictures."""
    return {3: 180, 6: 90, 8: 270}.get(orientation(exif), 0)


def camera_name(exif: Image.Exif) -> str:
    """Return make, model, focal length and digital zoom in one text; empty if EXIF has none of them."""
    details = exif.get_ifd(EXIF_IFD)
    said = [exif.get(MAKE), exif.get(MODEL), details.get(FOCAL_MM), _zoom(details.get(ZOOM))]
    return " ".join(text for text in (printable_text(value) for value in said) if text)


def focal_px(exif: Image.Exif, longer_side: int) -> float | None:
    """Return the focal length in pixels that EXIF claims; None if it says nothing plausible.

    It follows from the 35 mm equivalent; without that, from the focal length in millimeters and the resolution of the
    sensor.

    Args:
        exif: of the photo.
        longer_side: of the photo, pixels.
    """
    details = exif.get_ifd(EXIF_IFD)
    for claim in (_equivalent_focal, _sensor_focal):
        try:
            focal = longer_side * claim(details)
        except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
            continue
        if 0.1 * longer_side < focal < 50 * longer_side:
            return focal
    return None


def _equivalent_focal(details: Mapping[int, Any]) -> float:
    """Return the focal length of the 35 mm equivalent in longer sides."""
    return float(details.get(FOCAL_35MM, 0.0)) / FULL_FRAME_WIDTH_MM


def _sensor_focal(details: Mapping[int, Any]) -> float:
    """Return the focal length in longer sides of the photo that the camera took, before it was scaled."""
    unit_mm = SENSOR_UNITS_MM[int(details.get(SENSOR_UNIT, INCH))]
    taken = max(float(details[TAKEN_WIDTH]), float(details[TAKEN_HEIGHT]))
    return float(details[FOCAL_MM]) * float(details[SENSOR_RESOLUTION]) / unit_mm / taken


def gps_position(exif: Image.Exif) -> GpsPosition | None:
    """Return the GPS position; None if it is missing or implausible.

    Cameras without a fix write zeros: latitude and longitude 0 is open sea and counts as missing.
    """
    entries: Mapping[int, Any] = exif.get_ifd(GPS_IFD)
    latitude = _degrees(entries.get(GPS_LATITUDE), entries.get(GPS_LATITUDE_REF), "NS", 90.0)
    longitude = _degrees(entries.get(GPS_LONGITUDE), entries.get(GPS_LONGITUDE_REF), "EW", 180.0)
    if latitude is None or longitude is None or latitude == longitude == 0.0:
        return None
    return GpsPosition(latitude, longitude, _altitude_m(entries.get(GPS_ALTITUDE), entries.get(GPS_ALTITUDE_REF)))


def printable_text(value: object) -> str:
    """Return a value as text without control characters; empty for None."""
    text = "" if value is None else str(value)
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())


def _zoom(value: Any) -> str | None:
    """Return the digital zoom, which crops like another camera; None for 0 and 1, which mean no zoom."""
    try:
        return None if float(value) in (0.0, 1.0) else f"x{float(value):g}"
    except (TypeError, ValueError, ZeroDivisionError):
        return None


def _degrees(parts: Any, reference: Any, sides: str, largest: float) -> float | None:
    """Return signed degrees from EXIF's degrees, minutes, seconds and hemisphere letter."""
    try:
        degrees, minutes, seconds = (float(part) for part in parts)
        side = sides.index(str(reference).strip("\0 ").upper()[:1] or "?")
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    if not (degrees >= 0 and 0 <= minutes <= 60 and 0 <= seconds <= 60):
        return None
    value = degrees + minutes / 60 + seconds / 3600
    return (-value if side else value) if value <= largest else None


def _altitude_m(altitude: Any, reference: Any) -> float | None:
    try:
        value = float(altitude)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    below = reference in (1, b"\x01")
    value = -value if below else value
    return value if LOWEST_M <= value <= HIGHEST_M else None
