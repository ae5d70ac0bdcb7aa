"""From what is known of cameras to rules of the last adjustment, and what the photos then say of this knowledge."""

from collections.abc import Mapping

import numpy as np

from sfm_app.bundle_adjustment.camera_rules import CameraRule
from sfm_app.colmap.bundle import Adjustment
from sfm_app.colmap.models.model import posed_images
from sfm_app.colmap.types import Reconstruction
from sfm_app.estimation.exif_check import FocalClaim, focal_claim
from sfm_app.types import Calibration, Intrinsics, MatchedImage, MatchGraph, Scene


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
