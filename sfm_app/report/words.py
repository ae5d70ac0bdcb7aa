"""A calibration in words that need no knowledge of cameras."""

from sfm_app.geometry.lenses.lens_curve import field_of_view_deg
from sfm_app.types import Calibration
from sfm_app.types.calibration import EQUIRECTANGULAR, FISHEYE, PERSPECTIVE

SOURCES = {"exif": "what the camera wrote into the files", "guess": "the usual guess", "estimate": "an estimate"}
HELD = {
    "center": "optical center near the middle of the photo",
    "aspect": "square pixels",
    "k1": "a lens that bends no lines",
}
"""The usual value, by the parameter that the photos do not determine."""
WIDE_DEG = 90.0
"""Field of view from which people call a lens a fisheye. Chosen by hand."""
SURE = 2.0
"""Distortion in deviations from which on its direction is said: 19 in 20. By convention."""


WARNING = "beware: "
"""How the texts of a run begin what one should look at."""


def field_text(camera: Calibration) -> str:
    """Return what the camera sees, through its lens."""
    if camera.projection == EQUIRECTANGULAR:
        return "panoramas of a whole turn"
    across, down = field_of_view_deg(camera)
    seen = f"sees {across:.0f} degrees from left to right, {down:.0f} from top to bottom"
    # through a narrow field both families are the same lens, in other numbers
    return f"a fisheye that {seen}" if camera.projection == FISHEYE and max(across, down) >= WIDE_DEG else seen


def verdict(camera: Calibration) -> str:
    """Return whether K is known; if not, why, and where the given values come from."""
    if camera.is_given:
        return "Given: this is what the user knows about the camera."
    if camera.identifiable:
        return "Known: the photos agree on this camera."
    source = SOURCES.get(camera.method, camera.method)
    return f"Not known: what follows is {source}, since these photos do not determine the camera: {camera.reason}."


def focal_text(camera: Calibration) -> str:
    """Return focal length and field of view."""
    if camera.projection == EQUIRECTANGULAR:
        return f"Panoramas of a whole turn, {camera.width} x {camera.height} px."
    seen = field_text(camera)
    focal = f"Focal length {camera.focal_px:.0f} px{_deviation(camera, 'fx')}"
    tall = camera.K[0, 0] / camera.K[1, 1]
    shape = (
        "" if "aspect" in camera.held or abs(tall - 1) < 5e-4 else f"; its pixels are {tall:.3f} times as high as wide"
    )
    return f"{focal}: {'the camera ' if camera.projection == PERSPECTIVE else ''}{seen}{shape}."


def center_text(camera: Calibration) -> str:
    """Return the position of the optical center relative to the middle of the photo; empty for panoramas."""
    if camera.projection == EQUIRECTANGULAR:
        return ""
    right, below = camera.K[0, 2] - camera.width / 2, camera.K[1, 2] - camera.height / 2
    if max(abs(right), abs(below)) < 0.5:
        return "Optical center in the middle of the photo."
    across = f"{abs(right):.0f} px{_deviation(camera, 'cx')} {'right' if right > 0 else 'left'} of"
    down = f"{abs(below):.0f} px{_deviation(camera, 'cy')} {'below' if below > 0 else 'above'}"
    return f"Optical center {across} and {down} the middle of the photo."


def lens_text(camera: Calibration) -> str:
    """Return the radial distortion; empty where there is none or the photos do not determine it."""
    if camera.radial == 0.0 or "k1" in camera.held:
        return ""
    if abs(camera.radial) < SURE * camera.spread.get("k1", 0.0):
        return f"The lens hardly bends lines, k1 {camera.radial:.3f} +- {camera.spread['k1']:.3f}."
    shape = "outwards (barrel)" if camera.radial < 0 else "inwards (pincushion)"
    deviation = f" +- {camera.spread['k1']:.3f}" if "k1" in camera.spread else ""
    return f"The lens bends lines {shape}, k1 {camera.radial:.3f}{deviation}."


def held_text(camera: Calibration) -> str:
    """Return which parameters are assumed to have their usual values; empty for none."""
    if not camera.held or not camera.identifiable:
        return ""
    return "Assumed, since the photos do not determine it: " + ", ".join(HELD.get(n, n) for n in camera.held) + "."


def _deviation(camera: Calibration, name: str) -> str:
    value = camera.spread.get(name, 0.0)
    return f" +- {value:.0f}" if value >= 1.5 else f" +- {value:.1f}" if value > 0 else ""


def duration_text(seconds: float) -> str:
    """Return seconds in words."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
