"""Check cameras that were known before against what the photos say."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sfm_app.geometry.lenses.lens_curve import corner_angle, radius_deviation_px, radius_px
from sfm_app.numerical import Json
from sfm_app.runtime.context import RunContext
from sfm_app.types import Calibration
from sfm_app.types.calibration import EQUIRECTANGULAR

SIGMAS, LEAST_SHARE = 3.0, 0.01
"""A difference contradicts a camera if it exceeds both: this many standard deviations, and this share of the radius, or
of the longer side for the optical center. Chosen by hand: lenses are calibrated at one focus and used at another, which
changes the focal by a few tenths of a percent; not measured on their own."""
INNER, OUTER, ANGLES = 0.3, 0.8, 20
"""Range of angles that are compared, as shares of that of the corner, and their number. Nearer to the axis a focal and
a distortion compensate each other, and the corners hold few matches. Chosen by hand; not measured on their own."""

CENTERS = ("optical center, across", "optical center, down")
"""What a contradiction of the optical center is about."""


@dataclass(frozen=True, slots=True)
class Contradiction:
    """One property of a camera on which the user and the photos disagree."""

    what: str
    given_px: float
    found_px: float
    deviation_px: float
    """Standard deviation of the difference."""

    @property
    def text(self) -> str:
        """Both values in words."""
        deviation = f" +- {self.deviation_px:.3g}" if self.deviation_px > 0.0 else ""
        return f"{self.what}: given {self.given_px:.5g} px, the photos say {self.found_px:.5g}{deviation} px"

    def to_dict(self) -> dict[str, Json]:
        """Return plain values for the manifest."""
        values = {"given_px": self.given_px, "found_px": self.found_px, "deviation_px": self.deviation_px}
        return {"what": self.what} | {name: round(value, 3) for name, value in values.items()}


def report_checks(checked: Mapping[str, tuple[Calibration, Calibration | None]], run: RunContext) -> None:
    """Say where the photos contradict given cameras, and record it in the manifest; nothing where none was given.

    Args:
        checked: by name of the camera the given one, and what the photos say; None where they say nothing.
        run: the run.
    """
    if not checked:
        return
    answers = {name: find_contradictions(given, found) if found else [] for name, (given, found) in checked.items()}
    for name, contradicted in answers.items():
        for one in contradicted:
            run.progress.say(f"beware: the photos contradict the given camera {name}: {one.text}")
    figures = {
        name: {
            "from": run.given.source,
            "kept": given.is_kept,
            "checked": found is not None and found.identifiable,
            "contradicted": [one.to_dict() | {"text": one.text} for one in answers[name]],
        }
        for name, (given, found) in checked.items()
    }
    run.record(given_cameras=figures)


def find_contradictions(given: Calibration, found: Calibration) -> list[Contradiction]:
    """Return the properties of a given camera that the photos contradict; empty where they agree or do not say.

    Args:
        given: what the user gave, for these photos.
        found: what the photos say, with standard deviations.
    """
    if EQUIRECTANGULAR in (given.projection, found.projection) or not found.identifiable:
        return []
    return [*_curve_contradictions(given, found), *_center_contradictions(given, found)]


def _curve_contradictions(given: Calibration, found: Calibration) -> list[Contradiction]:
    """Return at most one: focal lengths where these differ, else radii at the angle where they differ most."""
    theta = np.linspace(INNER, OUTER, ANGLES) * min(corner_angle(given), corner_angle(found))
    radii = radius_px(theta, given), radius_px(theta, found)
    deviations = np.hypot(radius_deviation_px(theta, given), radius_deviation_px(theta, found))
    difference = np.abs(radii[0] - radii[1])
    clear = (difference > SIGMAS * deviations) & (difference > LEAST_SHARE * radii[1])
    if not clear.any():
        return []
    focals = given.focal_px, found.focal_px
    of_focal = float(np.hypot(given.spread.get("fx", 0.0), found.spread.get("fx", 0.0)))
    same = given.projection == found.projection
    if same and abs(focals[0] - focals[1]) > max(LEAST_SHARE * focals[1], SIGMAS * of_focal):
        return [Contradiction("focal length", *focals, of_focal)]
    worst = int(np.argmax(np.where(clear, difference / radii[1], 0.0)))
    what = f"radius of what is {np.degrees(theta[worst]):.0f} degrees off the axis"
    if not same:
        what = f"a {given.projection} lens is given, and the photos show a {found.projection} one; {what}"
    return [Contradiction(what, float(radii[0][worst]), float(radii[1][worst]), float(deviations[worst]))]


def _center_contradictions(given: Calibration, found: Calibration) -> list[Contradiction]:
    if "center" in found.held:
        return []
    least, answers = LEAST_SHARE * max(found.width, found.height), []
    for name, axis, what in (("cx", 0, CENTERS[0]), ("cy", 1, CENTERS[1])):
        values = float(given.K[axis, 2]), float(found.K[axis, 2])
        deviation = float(np.hypot(given.spread.get(name, 0.0), found.spread.get(name, 0.0)))
        if name in found.spread and abs(values[0] - values[1]) > max(least, SIGMAS * deviation):
            answers.append(Contradiction(what, *values, deviation))
    return answers
