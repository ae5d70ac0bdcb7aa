"""Claims about cameras: of EXIF, of plug-ins, and of a calibration file that may be off.

They are priors that the photos weigh; here they are collected, and those that the photos contradict are named.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from sfm_app.bundle.lens_parts import CameraRule
from sfm_app.camera.models import calibration_from_model
from sfm_app.colmap.backend import Reconstruction
from sfm_app.colmap.model import posed_images
from sfm_app.errors import PluginError
from sfm_app.estimation.given_cameras import OPTIONS as CHECKS
from sfm_app.estimation.given_cameras import assign_cameras, center_contradictions
from sfm_app.matching.features import read_pixels
from sfm_app.numerical import Json
from sfm_app.plugins import CameraPriorMethod
from sfm_app.runtime.context import RunContext
from sfm_app.selfcal.pairs import claimed_calibration
from sfm_app.types import Calibration, CameraModel, CameraPrior, Intrinsics, MatchedImage, MatchGraph, Scene
from sfm_app.types.camera import EQUIRECTANGULAR, PERSPECTIVE
from sfm_app.types.photos import EXIF, join_priors

CONTRADICTED = 2.0
"""Standard deviations of a claimed focal from which on the photos may contradict it; chosen by hand."""


@dataclass(frozen=True, slots=True)
class Claim:
    """Claim about a camera, and the camera according to its photos."""

    prior: CameraPrior
    photos: int
    """Number of photos with a claim."""
    found: Calibration

    @property
    def is_contradicted(self) -> bool:
        """Whether the photos exclude the claim."""
        return bool(self.text)

    @property
    def text(self) -> str:
        """The contradictions in words, with a likely cause; empty for none."""
        claimed, found, sigma = self.prior.focal_px, self.found.focal_px, self.found.spread.get("fx", 0.0)
        off, text = abs(found - claimed), ""
        if off > CONTRADICTED * self.prior.focal_deviation_px and off > CHECKS.sigmas * sigma:
            deviation = f" +- {sigma:.3g}" if sigma > 0.0 else ""
            text = f"{self.prior.source} says {claimed:.0f} px, the photos say {found:.0f}{deviation} px"
            if self.prior.source == EXIF:
                # a later crop leaves the focal in pixels as it was, while EXIF's shrinks with the longer side
                text += (
                    f": they were {'cropped or zoomed' if found > claimed else 'joined, or taken through another lens'}"
                )
        size = self.found.width, self.found.height
        centers = center_contradictions(claimed_calibration(self.prior, size, "", {}), self.found)
        return "; ".join(filter(None, (text, *(one.text for one in centers if self.prior.center_px is not None))))

    def to_dict(self) -> dict[str, Json]:
        """Return plain values for the manifest."""
        prior, found = self.prior, self.found
        values = {
            "claimed_px": prior.focal_px, "claimed_deviation_px": prior.focal_deviation_px,
            "found_px": found.focal_px, "deviation_px": found.spread.get("fx", 0.0),
        }  # fmt: skip
        record: dict[str, Json] = {"source": prior.source, "photos": self.photos, "contradicted": self.is_contradicted}
        record |= {name: round(value, 2) for name, value in values.items()}
        return record | ({"text": self.text} if self.is_contradicted else {})


def photo_prior(image: MatchedImage) -> CameraPrior | None:
    """Return the claim about a photo; EXIF's focal is that of the picture inside the bars."""
    prior = image.prior
    if prior is None or prior.source != EXIF or not image.shown:
        return prior
    share = max(image.shown[2:]) / max(image.width, image.height)
    return CameraPrior(EXIF, prior.focal_px * share, prior.focal_deviation_px * share)


def claim(images: Iterable[MatchedImage], found: Calibration) -> Claim | None:
    """Return the claim about the camera of some photos; None without any."""
    priors = [prior for prior in map(photo_prior, images) if prior is not None]
    joined = join_priors(priors)
    return None if joined is None else Claim(joined, len(priors), found)


def find_priors(matches: MatchGraph, run: RunContext) -> dict[str, CameraPrior]:
    """Return the claims of a calibration file, else of a plug-in, by photo; InputError or PluginError if unusable."""
    of_file = _priors_of_file(matches, run)
    priors = {one.name: of_file[one.group] for one in matches.images.values() if one.group in of_file}
    method = run.plugins.camera_prior_method(run.settings.calibration.priors)
    if method is not None:
        others = [one for one in matches.images.values() if one.name not in priors]
        unknown = [one for one in others if one.projection != EQUIRECTANGULAR]
        found = run.map(lambda image: _find_prior(method, image, run), unknown, "cameras from single photos")
        known = {one.name: prior for one, prior in zip(unknown, found, strict=True) if prior is not None}
        run.record(camera_priors={"method": method.name, "photos": len(known)})
        priors |= known
    return priors


def _find_prior(method: CameraPriorMethod, image: MatchedImage, run: RunContext) -> CameraPrior | None:
    pixels = read_pixels(run.workspace.photos / image.name)
    turns = image.turn_deg // 90
    try:
        prior = method.find(np.ascontiguousarray(np.rot90(pixels, -turns)))
    except Exception as err:  # a plug-in may raise anything
        text = f"the camera priors '{method.name}' failed on {image.name}: {type(err).__name__}: {err}"
        raise PluginError(text, hint="choose others with --set calibration.priors=NAME, or none") from err
    if prior is None or prior.center_px is None:
        return prior
    (x, y), width, height = prior.center_px, image.width, image.height
    for turn in range(turns):  # back to the orientation of the sensor
        x, y = y, (height if (turns - turn) % 2 else width) - x
    return replace(prior, center_px=(x, y))


def _priors_of_file(matches: MatchGraph, run: RunContext) -> dict[str, CameraPrior]:
    """Return the claims of a calibration file whose focals may be off, by camera group.

    It claims center and lens only where it states their deviations.
    """
    share, priors = run.settings.calibration.deviation, {}
    for group, camera in assign_cameras(matches, run.given, keep=False).cameras.items() if share else ():
        known, (cx, cy) = camera.spread, camera.K[:2, 2].tolist()
        prior = CameraPrior(
            "the calibration file", camera.focal_px, math.hypot(share * camera.focal_px, known.get("fx", 0.0))
        )
        if known.keys() >= {"cx", "cy"}:
            prior = replace(prior, center_px=(cx, cy), center_deviation_px=max(known["cx"], known["cy"]))
        if "k1" in known and camera.projection == PERSPECTIVE:
            prior = replace(prior, k1=camera.radial, k1_deviation=known["k1"])
        priors[group] = prior
    return priors


def report_claims(claims: Mapping[str, Claim | None], run: RunContext) -> None:
    """Announce the claims that the photos contradict, and record all, by name of the camera."""
    stated = {name: claim for name, claim in claims.items() if claim is not None}
    if not stated:
        return
    for name, claim in stated.items():
        if claim.is_contradicted:
            run.progress.say(f"the photos {name}: {claim.text}")
    run.record(camera_claims={name: claim.to_dict() for name, claim in stated.items()})


# The last adjustment: rules before it, and checks after it.


def camera_rules(
    model: Reconstruction, names: Mapping[str, str], intrinsics: Intrinsics, matches: MatchGraph, camera_model: str
) -> dict[int, CameraRule]:
    """Return the rules and claims about the cameras of a model, by camera id; empty for none.

    `names` has the camera of each photo by photo name. `camera_model` is COLMAP's model of all cameras; "auto"
    for the one that the photos support.
    """
    by_name = {image.name: image for image in matches.images.values()}
    rules, priors = {}, defaultdict[int, list[CameraPrior]](list)
    for image in posed_images(model):
        camera = intrinsics.cameras.get(names[image.name])
        if (prior := photo_prior(by_name[image.name])) is not None:
            priors[image.camera_id].append(prior)
        joined = join_priors(priors[image.camera_id])
        rules[image.camera_id] = CameraRule(
            given=camera if camera is not None and camera.is_given else None,
            prior=joined and _agreeing_parts(joined, camera),
            model="" if camera_model == "auto" else camera_model,
        )
    return {camera_id: rule for camera_id, rule in rules.items() if rule.given or rule.prior or rule.model}


def _agreeing_parts(prior: CameraPrior, camera: Calibration | None) -> CameraPrior:
    """Return a claim without a center or a lens that the pairs have rejected; the focal may still prove right."""
    if camera is None:
        return prior
    if prior.center_px is not None:
        off = np.abs(camera.K[:2, 2] - prior.center_px).max()
        if off > CHECKS.sigmas * prior.center_deviation_px:
            prior = replace(prior, center_px=None)
    if prior.k1 is not None and abs(camera.radial - prior.k1) > CHECKS.sigmas * prior.k1_deviation:
        prior = replace(prior, k1=None)
    return prior


def refined_claims(scene: Scene, intrinsics: Intrinsics, matches: MatchGraph) -> dict[str, Claim | None]:
    """Return the claims about cameras that only the last adjustment determined, by name."""
    known = {name for name, camera in intrinsics.cameras.items() if camera.identifiable}
    photos: dict[str, list[MatchedImage]] = {name: [] for name in scene.cameras}
    for image in matches.images.values():
        if image.name in scene.camera_of:
            photos[scene.camera_of[image.name]].append(image)
    return {
        name: claim(photos[name], _refined(camera))
        for name, camera in scene.cameras.items()
        if name not in known and "fx" in camera.deviations
    }


def _refined(camera: CameraModel) -> Calibration:
    known = calibration_from_model(camera.model, camera.params, (camera.width, camera.height))
    held = () if "center" in camera.determined else ("center",)
    return replace(known, spread=camera.deviations, held=held)
