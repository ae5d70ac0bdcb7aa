"""A calibration in words that need no knowledge of cameras."""

import numpy as np

from sfm_app.types import Calibration

SOURCES = {"exif": "what the camera wrote into the files", "guess": "the usual guess"}
HELD = {
    "centre": "optical centre near the middle of the photo",
    "aspect": "square pixels",
    "k1": "a lens that bends no lines",
}
"""What is assumed where the photos do not tell."""


def field_of_view_deg(camera: Calibration) -> tuple[float, float]:
    """How much the camera sees from left to right and from top to bottom, in degrees; the lens is left out."""
    (fx, _, cx), (_, fy, cy), _ = camera.K
    across = np.arctan2([cx, camera.width - cx], fx)
    down = np.arctan2([cy, camera.height - cy], fy)
    return float(np.degrees(across.sum())), float(np.degrees(down.sum()))


def verdict(camera: Calibration) -> str:
    """Whether K is known, and if not, why, and what it is instead."""
    if camera.identifiable:
        return "The photos tell it."
    return f"The photos do not tell it ({camera.reason}): this is {SOURCES.get(camera.method, camera.method)}."


def focal_text(camera: Calibration) -> str:
    """Focal length and field of view."""
    across, down = field_of_view_deg(camera)
    focal = f"Focal length {camera.focal_px:.0f} px{_deviation(camera, 'fx')}"
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    shape = "" if abs(fy / fx - 1) < 1e-9 else f", pixels {fx / fy:.3f} times as high as wide"
    return f"{focal}: the camera sees {across:.0f} by {down:.0f} degrees{shape}."


def centre_text(camera: Calibration) -> str:
    """Where the optical centre lies, from the middle of the photo."""
    right, below = camera.K[0, 2] - camera.width / 2, camera.K[1, 2] - camera.height / 2
    steps = [
        f"{abs(value):.0f} px{_deviation(camera, name)} {ways[int(value > 0)]}"
        for value, name, ways in ((right, "cx", ("left", "right")), (below, "cy", ("above", "below")))
        if abs(value) >= 0.5
    ]
    return f"Optical centre {' and '.join(steps)} of the middle." if steps else "Optical centre in the middle."


def lens_text(camera: Calibration) -> str:
    """The radial term, or nothing where none was found."""
    if camera.radial == 0.0:
        return ""
    shape = "outwards (barrel)" if camera.radial < 0 else "inwards (pincushion)"
    deviation = f" +- {camera.spread['k1']:.3f}" if "k1" in camera.spread else ""
    return f"The lens bends lines {shape}, k1 {camera.radial:.3f}{deviation}."


def held_text(camera: Calibration) -> str:
    """What is assumed, or nothing."""
    if not camera.held or not camera.identifiable:
        return ""
    return "Assumed, since the photos do not tell: " + ", ".join(HELD.get(name, name) for name in camera.held) + "."


def _deviation(camera: Calibration, name: str) -> str:
    value = camera.spread.get(name, 0.0)
    return f" +- {value:.0f}" if value >= 1.5 else f" +- {value:.1f}" if value > 0 else ""
