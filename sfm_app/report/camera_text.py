"""Summaries of a run's cameras: lines of text, and plain values for --json."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from sfm_app.geometry.lenses.camera_models import calibration_from_model
from sfm_app.geometry.lenses.lens_curve import field_of_view_deg
from sfm_app.name_lists import list_names
from sfm_app.report.words import field_text, held_text, lens_text
from sfm_app.types import Calibration, CameraModel, Intrinsics
from sfm_app.types.calibration import EQUIRECTANGULAR, FISHEYE, GIVEN, KEPT

BEST_PAIRS = 3
PHOTOS_SHOWN = 4
"""Most key pairs and photos that the text names; --json has all."""

SOURCES = {"exif": "EXIF's claim", "guess": "a guess", "estimate": "an estimate"}
"""Where the values of an undetermined camera come from, by its method."""
GIVEN_TEXTS = {GIVEN: "as given, to be refined", KEPT: "as given, and kept"}
"""What becomes of a camera that the user gave, by its method."""


def intrinsics_summary(intrinsics: Intrinsics) -> dict[str, Any]:
    """Return the calibrations as plain values for --json."""
    names = intrinsics.photos
    cameras = {
        name: {"field_of_view_deg": [round(angle, 2) for angle in field_of_view_deg(camera)], **camera.to_dict()}
        for name, camera in intrinsics.cameras.items()
    }
    for camera in cameras.values():
        camera["key_pairs"] = [[names.get(key, str(key)) for key in pair] for pair in camera["key_pairs"]]
    return cameras


def intrinsics_lines(intrinsics: Intrinsics) -> list[str]:
    """Return the calibrations as lines of text."""
    many = len(intrinsics.cameras) > 1
    lines = []
    for name, camera in intrinsics.cameras.items():
        lines.append(f"camera      {f'{name}: ' if many else ''}{_camera_text(camera)}")
        mine = [photo for photo, of in intrinsics.camera_of.items() if of == name]
        if many and mine:
            lines.append(f"            took {list_names(mine, PHOTOS_SHOWN)}")
        if not camera.identifiable:
            source = SOURCES.get(camera.method, camera.method)
            lines.append(f"            these photos do not determine it ({camera.reason}): {source}")
        if camera.method in GIVEN_TEXTS:
            lines.append(f"            {GIVEN_TEXTS[camera.method]}")
        if camera.projection != EQUIRECTANGULAR:
            lines.append(f"            {field_text(camera)}")
        lines += [f"            {text}" for text in (lens_text(camera), held_text(camera)) if text]
        if camera.key_pairs:
            named = [[intrinsics.photos.get(key, str(key)) for key in pair] for pair in camera.key_pairs[:BEST_PAIRS]]
            best = ", ".join(f"{first} + {second}" for first, second in named)
            lines.append(f"            best pairs of photos to start from: {best}")
    return lines


def _camera_text(camera: Calibration) -> str:
    """Return K with its deviations; of panoramas, which have no K, what they are."""
    if camera.projection == EQUIRECTANGULAR:
        return f"{field_text(camera)}, {camera.width} x {camera.height} px"
    return k_text(camera.K, camera.spread)


def refined_text(camera: CameraModel) -> str:
    """Return K of a camera after bundle adjustment with its deviations, and what a wide lens sees."""
    known = calibration_from_model(camera.model, camera.params, (camera.width, camera.height))
    if known.projection == EQUIRECTANGULAR:
        return _camera_text(known)
    seen = f"; {field_text(known)}" if known.projection == FISHEYE else ""
    return f"{k_text(camera.K, camera.deviations)}{seen}"


def contradiction_lines(counts: Mapping[str, Any]) -> list[str]:
    """Return remarks about given cameras, and warnings about these and focals of EXIF that the photos contradict.

    Args:
        counts: figures of a stage in the manifest.
    """
    given, claims = counts.get("given_cameras", {}), counts.get("exif_focals", {})
    many = len(claims) > 1
    said = [f"{f'{name}: ' if many else ''}{one['text']}" for name, one in claims.items() if "text" in one]
    return [*counts.get("given_camera_notes", ()), *said] + [
        f"beware: the photos contradict the given camera {name}: {one['text']}"
        for name, camera in given.items()
        for one in camera["contradicted"]
    ]


def k_text(K: Any, spread: Mapping[str, float] = MappingProxyType({})) -> str:
    """Return focals and center in pixels, with standard deviations where they are known.

    Args:
        K: (3, 3) in pixels.
        spread: standard deviations in pixels, by "fx", "fy", "cx", "cy"; any may be missing.
    """
    values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    parts = (
        f"{name} {value:.1f}" + (f" +- {spread[name]:.1f}" if name in spread else "") for name, value in values.items()
    )
    return "  ".join(parts) + " px"
