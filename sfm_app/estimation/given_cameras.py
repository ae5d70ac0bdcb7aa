"""Cameras that the user gives, and whether the photos contradict them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sfm_app.camera.bearings import corner_angle, radius_deviation_px, radius_px
from sfm_app.colmap.bundle import Adjustment
from sfm_app.colmap.model import posed_images
from sfm_app.errors import InputError
from sfm_app.numerical import Json
from sfm_app.runtime.context import RunContext
from sfm_app.types import Calibration, GivenCameras, Intrinsics, MatchedImage, MatchGraph
from sfm_app.types.camera import EQUIRECTANGULAR, KEPT

# Cameras of a calibration file, for the photos of a run.


@dataclass(frozen=True, slots=True)
class AssignedCameras:
    """Given cameras of some photos."""

    cameras: Mapping[str, Calibration] = field(default_factory=dict)
    """By camera group, in pixels of its photos."""
    notes: tuple[str, ...] = ()
    """Remarks for the user: which cameras were scaled, and which photos have none and why."""


def given_cameras(matches: MatchGraph, run: RunContext) -> AssignedCameras:
    """Return the given cameras of a run; none where they are only claims, see `claims`."""
    options = run.settings.calibration
    given = GivenCameras() if options.deviation else run.given
    return assign_cameras(matches, given, keep=options.keep)


def assign_cameras(matches: MatchGraph, given: GivenCameras, *, keep: bool) -> AssignedCameras:
    """Return the given camera of every camera group that has one.

    A group has the camera that the file names for its photos, or by the name of the group; else the only one of the
    file, or the only one of the size or the shape of its photos. With `keep`, cameras stay unchanged. InputError if the
    file has no camera for any of the photos.
    """
    if not given:
        return AssignedCameras()
    cameras, notes, rejections = {}, [], []
    for group, images in matches.groups.items():
        if images[0].projection == EQUIRECTANGULAR:
            continue  # nothing about a panorama is unknown
        name, reason = _choose_name(group, images, given)
        camera, note = fit_to_photos(given.cameras[name], images[0]) if name is not None else (None, reason)
        if camera is None:
            rejections.append(f"no given camera for the photos {group}: {note}")
        else:
            cameras[group] = replace(camera, method=KEPT) if keep else camera
            notes += [f"scaled the given camera of the photos {group}: {note}"] if note else []
    if not cameras and rejections:
        raise InputError(f"{given.source} fits no photo: {rejections[0]}", hint="leave --calibration out")
    return AssignedCameras(cameras, (*notes, *rejections))


def fit_to_photos(camera: Calibration, image: MatchedImage) -> tuple[Calibration | None, str]:
    """Return a camera in pixels of a photo, and a note if it was scaled; None with the reason where it cannot be."""
    size = image.width, image.height
    if camera.projection == EQUIRECTANGULAR:
        return None, "the file's camera is that of panoramas, which these photos are not"
    if not camera.width:
        cx, cy = camera.K[:2, 2]
        inside = 0.0 < cx < size[0] and 0.0 < cy < size[1]
        reason = f"its optical center lies outside of {size[0]} x {size[1]} pixels"
        return (replace(camera, width=size[0], height=size[1]), "") if inside else (None, reason)
    x, y, *shown = image.shown or (0, 0, *size)
    for frame in ((0, 0, *size), (x, y, *shown)):
        across, down = frame[2] / camera.width, frame[3] / camera.height
        if min(abs(across * camera.height - frame[3]), abs(down * camera.width - frame[2])) <= 1.0:  # whole pixels
            return _scale(camera, across, down, frame[:2], size)
    is_turned = camera.width * size[0] == camera.height * size[1]
    return None, (
        f"the file's camera took photos of {camera.width} x {camera.height} pixels, these have {size[0]} x {size[1]}: "
        f"they were {'turned' if is_turned else 'cropped, or are from another camera'}"
    )


def _scale(
    camera: Calibration, across: float, down: float, corner: tuple[int, ...], size: tuple[int, int]
) -> tuple[Calibration, str]:
    """Return a camera for photos of another size whose picture begins at a corner, and a note."""
    K = camera.K.copy()
    K[0] *= across
    K[1] *= down
    K[:2, 2] += corner
    factors = {"fx": across, "fy": down, "cx": across, "cy": down}
    spread = {name: value * factors.get(name, 1.0) for name, value in camera.spread.items()}
    scaled = (across, down) != (1.0, 1.0)
    note = f"from {camera.width} x {camera.height} to {size[0]} x {size[1]} pixels" if scaled else ""
    return replace(camera, K=K, width=size[0], height=size[1], spread=spread), note


def _choose_name(group: str, images: Sequence[MatchedImage], given: GivenCameras) -> tuple[str | None, str]:
    """Return the name of a group's camera in the file; None with the reason where it has none."""
    named = {given.camera_name(image.name) for image in images} - {None}
    if len(named) == 1:
        return named.pop(), ""
    if len(named) > 1:
        return None, f"the file has several cameras for them: {', '.join(sorted(map(str, named)))}"
    if group in given.cameras:
        return group, ""
    if len(given.cameras) == 1:
        return next(iter(given.cameras)), ""
    size = images[0].width, images[0].height
    same = [name for name, one in given.cameras.items() if (one.width, one.height) == size]
    alike = [name for name, one in given.cameras.items() if fit_to_photos(one, images[0])[0] is not None]
    for names in (same, alike):
        if len(names) == 1:
            return names[0], ""
    if not alike:
        return None, f"none of the file's {len(given.cameras)} cameras took photos of the shape {size[0]} x {size[1]}"
    return None, f"{len(alike)} cameras of the file fit them, and none is named '{group}'"


# Checks of given cameras against the photos.


class OPTIONS:
    """When photos contradict a stated camera. Chosen by hand."""

    sigmas: float = 3.0
    """Standard deviations that a difference must exceed."""
    min_share: float = 0.01
    """Share of the radius, or of the longer side for the center, that it must exceed: focusing changes less."""
    inner: float = 0.3
    """Smallest compared angle, as a share of that of the corner: a focal compensates distortion there."""
    outer: float = 0.8
    """Largest compared angle: the corners hold few matches."""
    angles: int = 20
    """Number of compared angles."""


CENTERS = ("optical center, across", "optical center, down")
"""Coordinates of the optical center."""


@dataclass(frozen=True, slots=True)
class Contradiction:
    """One property of a camera on which the user and the photos disagree."""

    what: str
    given_px: float
    found_px: float
    deviation_px: float

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
    """Announce contradictions, and record all checks: by name the given camera and that of the photos, if any."""
    if not checked:
        return
    contradictions = {k: find_contradictions(a, b) if b else [] for k, (a, b) in checked.items()}
    for name, contradicted in contradictions.items():
        for one in contradicted:
            run.progress.say(f"beware: the photos contradict the given camera {name}: {one.text}")
    figures = {
        name: {
            "from": run.given.source,
            "kept": given.is_kept,
            "checked": estimate is not None and estimate.identifiable,
            "contradicted": [one.to_dict() | {"text": one.text} for one in contradictions[name]],
        }
        for name, (given, estimate) in checked.items()
    }
    run.record(given_cameras=figures)


def find_contradictions(given: Calibration, estimated: Calibration) -> list[Contradiction]:
    """Return the properties of a given camera that the photos contradict; empty where they do not determine it."""
    if EQUIRECTANGULAR in (given.projection, estimated.projection) or not estimated.identifiable:
        return []
    return [*_curve_contradictions(given, estimated), *center_contradictions(given, estimated)]


def _curve_contradictions(given: Calibration, estimated: Calibration) -> list[Contradiction]:
    """Return at most one: focal lengths where these differ, else radii at the angle where they differ most."""
    theta = np.linspace(OPTIONS.inner, OPTIONS.outer, OPTIONS.angles) * min(
        corner_angle(given), corner_angle(estimated)
    )
    radii = radius_px(theta, given), radius_px(theta, estimated)
    deviations = np.hypot(radius_deviation_px(theta, given), radius_deviation_px(theta, estimated))
    difference = np.abs(radii[0] - radii[1])
    clear = (difference > OPTIONS.sigmas * deviations) & (difference > OPTIONS.min_share * radii[1])
    if not clear.any():
        return []
    focals = given.focal_px, estimated.focal_px
    of_focal = float(np.hypot(given.spread.get("fx", 0.0), estimated.spread.get("fx", 0.0)))
    same = given.projection == estimated.projection
    if same and abs(focals[0] - focals[1]) > max(OPTIONS.min_share * focals[1], OPTIONS.sigmas * of_focal):
        return [Contradiction("focal length", *focals, of_focal)]
    worst = int(np.argmax(np.where(clear, difference / radii[1], 0.0)))
    what = f"radius of what is {np.degrees(theta[worst]):.0f} degrees off the axis"
    if not same:
        what = f"a {given.projection} lens is given, and the photos show a {estimated.projection} one; {what}"
    return [Contradiction(what, float(radii[0][worst]), float(radii[1][worst]), float(deviations[worst]))]


def center_contradictions(given: Calibration, estimated: Calibration) -> list[Contradiction]:
    """Return the coordinates of a given center that the photos contradict; none where they do not determine it."""
    if "center" in estimated.held:
        return []
    least, contradictions = OPTIONS.min_share * max(estimated.width, estimated.height), []
    for name, axis, what in (("cx", 0, CENTERS[0]), ("cy", 1, CENTERS[1])):
        values = float(given.K[axis, 2]), float(estimated.K[axis, 2])
        deviation = float(np.hypot(given.spread.get(name, 0.0), estimated.spread.get(name, 0.0)))
        if name in estimated.spread and abs(values[0] - values[1]) > max(least, OPTIONS.sigmas * deviation):
            contradictions.append(Contradiction(what, *values, deviation))
    return contradictions


# Checks after the last adjustment.


def given_and_found(
    adjusted: Adjustment, names: Mapping[str, str], intrinsics: Intrinsics
) -> dict[str, tuple[Calibration, Calibration | None]]:
    """Return the given cameras of an adjusted model, and its own, by name; `names` has the camera of each photo."""
    ids = {names[image.name]: image.camera_id for image in posed_images(adjusted.model)}
    known = {name: intrinsics.cameras[name] for name in ids if name in intrinsics.cameras}
    return {name: (camera, adjusted.estimates.get(ids[name])) for name, camera in known.items() if camera.is_given}
