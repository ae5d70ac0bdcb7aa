"""Cameras and focal lengths that the user or EXIF states, and whether the photos contradict them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sfm_app.bundle.lens_parts import CameraRule
from sfm_app.camera.bearings import corner_angle, radius_deviation_px, radius_px
from sfm_app.colmap.backend import Reconstruction
from sfm_app.colmap.bundle import Adjustment
from sfm_app.colmap.model import posed_images
from sfm_app.errors import InputError
from sfm_app.numerical import Json
from sfm_app.runtime.context import RunContext
from sfm_app.types import Calibration, GivenCameras, Intrinsics, MatchedImage, MatchGraph, Scene
from sfm_app.types.camera import EQUIRECTANGULAR, KEPT

# Which photos each camera of a calibration file took, and that camera for the size of these photos.

ROUNDING_PX = 1.0
"""Largest difference in pixels of the shorter side of photos that were only scaled: sizes are whole pixels. By
definition."""


@dataclass(frozen=True, slots=True)
class AssignedCameras:
    """Given cameras of some photos."""

    cameras: Mapping[str, Calibration] = field(default_factory=dict)
    """By camera group, in pixels of its photos."""
    notes: tuple[str, ...] = ()
    """Remarks for the user: which cameras were scaled, and which photos have none and why."""


def assign_cameras(matches: MatchGraph, given: GivenCameras, *, keep: bool) -> AssignedCameras:
    """Return the given camera of every camera group that has one.

    A group has the camera that the file names for its photos, or by the name of the group; else the only one of the
    file, or the only one of the size or the shape of its photos.

    Args:
        matches: has the photos.
        given: contents of the calibration file.
        keep: whether the user wants the cameras unchanged.

    Raises:
        InputError: the file has no camera for any of the photos.
    """
    if not given:
        return AssignedCameras()
    groups: dict[str, list[MatchedImage]] = {}
    for _, image in sorted(matches.images.items()):
        groups.setdefault(image.group, []).append(image)
    cameras, notes, refused = {}, [], []
    for group, images in groups.items():
        if images[0].projection == EQUIRECTANGULAR:
            continue  # nothing about a panorama is unknown
        name, why = _choose_name(group, images, given)
        found, note = fit_to_photos(given.cameras[name], images[0]) if name is not None else (None, why)
        if found is None:
            refused.append(f"the photos {group} have no given camera: {note}")
        else:
            cameras[group] = replace(found, method=KEPT) if keep else found
            notes += [f"the given camera of the photos {group} is scaled: {note}"] if note else []
    if not cameras and refused:
        raise InputError(f"{given.source} fits no photo: {refused[0]}", hint="leave --calibration out to do without")
    return AssignedCameras(cameras, (*notes, *refused))


def fit_to_photos(camera: Calibration, image: MatchedImage) -> tuple[Calibration | None, str]:
    """Return a camera in pixels of a photo, and a note if it was scaled; None with the reason where it cannot be.

    Photos of another shape were cropped, nobody knows where.

    Args:
        camera: for photos of its own size; of any size where that is 0.
        image: one of the photos.
    """
    size = image.width, image.height
    if camera.projection == EQUIRECTANGULAR:
        return None, "the file's camera is that of panoramas, which these photos are not"
    if not camera.width:
        cx, cy = camera.K[:2, 2]
        inside = 0.0 < cx < size[0] and 0.0 < cy < size[1]
        says = f"its optical center lies outside of {size[0]} x {size[1]} pixels"
        return (replace(camera, width=size[0], height=size[1]), "") if inside else (None, says)
    left, top, *shown = image.shown or (0, 0, *size)
    for frame in ((0, 0, *size), (left, top, *shown)):
        across, down = frame[2] / camera.width, frame[3] / camera.height
        if abs(across * camera.height - frame[3]) <= ROUNDING_PX or abs(down * camera.width - frame[2]) <= ROUNDING_PX:
            return _scale(camera, across, down, frame[:2], size)
    turned = camera.width * size[0] == camera.height * size[1]
    return None, (
        f"the file's camera took photos of {camera.width} x {camera.height} pixels, these have {size[0]} x {size[1]}: "
        f"they were {'turned' if turned else 'cropped, or are from another camera'}"
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


# Check cameras that were known before against what the photos say.

CONTRADICTING_SIGMAS, LEAST_SHARE = 3.0, 0.01
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
    clear = (difference > CONTRADICTING_SIGMAS * deviations) & (difference > LEAST_SHARE * radii[1])
    if not clear.any():
        return []
    focals = given.focal_px, found.focal_px
    of_focal = float(np.hypot(given.spread.get("fx", 0.0), found.spread.get("fx", 0.0)))
    same = given.projection == found.projection
    if same and abs(focals[0] - focals[1]) > max(LEAST_SHARE * focals[1], CONTRADICTING_SIGMAS * of_focal):
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
        if name in found.spread and abs(values[0] - values[1]) > max(least, CONTRADICTING_SIGMAS * deviation):
            answers.append(Contradiction(what, *values, deviation))
    return answers


# Compare the focal lengths that EXIF claims with those that the photos determine.
#
# EXIF knows nothing of what was done to a photo later: a crop leaves the focal in pixels as it was, while the claim
# shrinks with the longer side.

TOLERANCE = 0.08
"""Share of the focal by which a claim may be off: the 35 mm equivalent is rounded to a millimeter, counts along the
width or along the diagonal (4 % for photos of 4 : 3), and lenses breathe. Chosen by hand; not measured on its own."""
EXIF_SIGMAS = 3.0
"""Standard deviations of the focal that the difference must exceed, too. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class FocalClaim:
    """What EXIF says of a camera, and what its photos say."""

    claimed_px: float
    """Median over its photos."""
    photos: int
    """Number of photos with a claim."""
    found_px: float
    deviation_px: float

    @property
    def is_contradicted(self) -> bool:
        """Whether the photos exclude the claim."""
        off = abs(self.found_px - self.claimed_px)
        return off > TOLERANCE * self.found_px and off > EXIF_SIGMAS * self.deviation_px

    @property
    def text(self) -> str:
        """Both focals, and what may have happened to the photos."""
        deviation = f" +- {self.deviation_px:.3g}" if self.deviation_px > 0.0 else ""
        longer = self.found_px > self.claimed_px
        reason = "they were cropped or zoomed" if longer else "they were joined, or taken through another lens"
        return f"EXIF says {self.claimed_px:.0f} px, the photos say {self.found_px:.0f}{deviation}: {reason}"

    def to_dict(self) -> dict[str, Json]:
        """Return plain values for the manifest."""
        values = {"claimed_px": self.claimed_px, "found_px": self.found_px, "deviation_px": self.deviation_px}
        rounded: dict[str, Json] = {name: round(value, 2) for name, value in values.items()}
        text = {"text": self.text} if self.is_contradicted else {}
        return rounded | {"photos": self.photos, "contradicted": self.is_contradicted} | text


def focal_claim(images: Iterable[MatchedImage], found_px: float, deviation_px: float) -> FocalClaim | None:
    """Return the claim about a camera; None where EXIF says nothing.

    Args:
        images: its photos.
        found_px: focal length that the photos determine.
        deviation_px: its standard deviation.
    """
    claims = [image.exif_focal_px * shown_share(image) for image in images if image.exif_focal_px]
    return FocalClaim(float(np.median(claims)), len(claims), found_px, deviation_px) if claims else None


def shown_share(image: MatchedImage) -> float:
    """Return the longer side of the picture inside its bars over that of the photo, to which EXIF's focal refers."""
    return max(image.shown[2:]) / max(image.width, image.height) if image.shown else 1.0


def report_claims(found: Mapping[str, FocalClaim | None], run: RunContext) -> None:
    """Say which claims the photos contradict, and record all in the manifest; nothing where EXIF says nothing.

    Args:
        found: by name of the camera.
        run: the run.
    """
    known = {name: claim for name, claim in found.items() if claim is not None}
    if not known:
        return
    for name, claim in known.items():
        if claim.is_contradicted:
            run.progress.say(f"the photos {name}: {claim.text}")
    run.record(exif_focals={name: claim.to_dict() for name, claim in known.items()})


# From what is known of cameras to rules of the last adjustment, and what the photos then say of this knowledge.


def camera_rules(
    model: Reconstruction, names: Mapping[str, str], intrinsics: Intrinsics, camera_model: str
) -> dict[int, CameraRule]:
    """Return what the user laid down about the cameras of a model, by camera id; empty for nothing.

    Args:
        model: as mapping left it.
        names: camera of each photo, by photo name.
        intrinsics: cameras before mapping, with those that the user gave.
        camera_model: COLMAP's name of the model that all end with; "auto" for the one that the photos support.
    """
    rules = {}
    for image in posed_images(model):
        camera = intrinsics.cameras.get(names[image.name])
        rule = CameraRule(
            given=camera if camera is not None and camera.is_given else None,
            model="" if camera_model == "auto" else camera_model,
        )
        if rule.given is not None or rule.model:
            rules[image.camera_id] = rule
    return rules


def given_and_found(
    adjusted: Adjustment, names: Mapping[str, str], intrinsics: Intrinsics
) -> dict[str, tuple[Calibration, Calibration | None]]:
    """Return the cameras of a model that the user gave, with what the photos say of them, by name.

    Args:
        adjusted: the model after its last adjustment.
        names: camera of each photo, by photo name.
        intrinsics: cameras before mapping.
    """
    ids = {names[image.name]: image.camera_id for image in posed_images(adjusted.model)}
    known = {name: intrinsics.cameras[name] for name in ids if name in intrinsics.cameras}
    return {name: (camera, adjusted.estimates.get(ids[name])) for name, camera in known.items() if camera.is_given}


def refined_claims(scene: Scene, intrinsics: Intrinsics, matches: MatchGraph) -> dict[str, FocalClaim | None]:
    """Return what EXIF claims about cameras that only the last adjustment determined, by name; None for nothing.

    Args:
        scene: with the cameras after their last adjustment.
        intrinsics: cameras before mapping; of those that pairs determined, or the user gave, the claim is known.
        matches: all photos.
    """
    known = {name for name, camera in intrinsics.cameras.items() if camera.identifiable}
    photos: dict[str, list[MatchedImage]] = {name: [] for name in scene.cameras}
    for image in matches.images.values():
        if image.name in scene.camera_of:
            photos[scene.camera_of[image.name]].append(image)
    return {
        name: focal_claim(photos[name], float(np.sqrt(camera.K[0, 0] * camera.K[1, 1])), camera.deviations["fx"])
        for name, camera in scene.cameras.items()
        if name not in known and "fx" in camera.deviations
    }
