"""intrinsics: ViewGraph -> Intrinsics."""

import json
from dataclasses import replace

import numpy as np

from sfm_app.colmap.backend import backend
from sfm_app.colmap.database import cameras_seal, write_calibrations
from sfm_app.context import RunContext
from sfm_app.diagnosis import of_fits, votes
from sfm_app.numerical import json_text
from sfm_app.selfcal import Camera, calibrate_photo_set, pair_weights
from sfm_app.stored import fingerprint
from sfm_app.types import Calibration, CameraPairs, Intrinsics, MatchedImage, MatchGraph, PhotoPairs, ViewGraph
from sfm_app.workspace import Workspace
from sfm_app.written import replacing


def calibrate(matches: MatchGraph, views: ViewGraph, run: RunContext) -> Intrinsics:
    """Find K and lens of every camera, and which photos are whose; what is not identifiable falls back to a guess."""
    options = run.settings.calibration
    calibrator = run.plugins.calibrator(options.calibrator)
    pairs = photo_pairs(list(matches.images.values()), matches, views)
    # a group that the user made is not split
    split = run.settings.photos.cameras == "auto"
    cameras = calibrate_photo_set(
        pairs, calibrator.calibrate, options, run.seed, together=calibrator.together, split=split
    )
    cameras = [of_whole_photo(camera, matches.images[camera.photos[0]]) for camera in cameras]
    intrinsics = Intrinsics(
        cameras={camera.name: explained(camera, views) for camera in cameras},
        camera_of={matches.images[photo].name: camera.name for camera in cameras for photo in camera.photos},
        photos={image.id: image.name for image in matches.images.values()},
    )
    run.record(
        cameras={name: _summary(camera) for name, camera in intrinsics.cameras.items()},
        photos={camera.name: len(camera.photos) for camera in cameras},
        identifiable=sum(camera.found.identifiable for camera in cameras),
    )
    with replacing(run.workspace.calibration) as path:
        path.write_text(json_text(intrinsics.to_dict()), encoding="utf-8")
    with backend("writing calibrations"):
        write_calibrations(run.workspace.database, matches, intrinsics)
    return intrinsics


def explained(camera: Camera, views: ViewGraph) -> Calibration:
    """What was found; where that is nothing, with what the pairs are that could not be asked."""
    kinds = votes(views, camera.photos)
    if camera.found.identifiable or not kinds.total() > kinds[""]:
        return camera.found
    return replace(camera.found, reason=f"{camera.found.reason}; {of_fits(views, camera.photos).message}")


def of_whole_photo(camera: Camera, image: MatchedImage) -> Camera:
    """A camera in pixels of its photos, where it was found in those of the pictures within their bars."""
    if image.shown is None:
        return camera
    K = camera.found.K.copy()
    K[:2, 2] += image.shown[:2]
    return replace(camera, found=replace(camera.found, K=K, width=image.width, height=image.height))


def photo_pairs(images: list[MatchedImage], matches: MatchGraph, views: ViewGraph) -> PhotoPairs:
    """What is known about all pairs of these photos that are not degenerate, in pixels of the pictures within bars."""
    shown = {image.id: image.shown for image in images if image.shown}
    ids = {image.id for image in images}
    fits = {pair: fit for pair, fit in views.fits.items() if ids.issuperset(pair) and not fit.degeneracy}
    return PhotoPairs(
        Fs=np.array([fit.F for fit in fits.values()], np.float64).reshape(-1, 3, 3),
        weights=pair_weights(np.array([fit.inlier_count for fit in fits.values()], np.int64)),
        photos=tuple(fits),
        inliers=tuple(np.hstack(matches.points(pair))[fit.inliers] for pair, fit in fits.items()),
        sizes={image.id: image.shown[2:] if image.shown else (image.width, image.height) for image in images},
        groups={image.id: image.group for image in images},
        focal_hints_px={image.id: image.exif_focal_px * _share_shown(image) for image in images if image.exif_focal_px},
        brought_to={image.id: (image.width, image.height) for image in images if image.shown},
    ).moved({photo: frame[:2] for photo, frame in shown.items()})


def _share_shown(image: MatchedImage) -> float:
    """Longer side of the picture within bars over that of the photo, which EXIF's claim was reckoned with."""
    return max(image.shown[2:]) / max(image.width, image.height) if image.shown else 1.0


def camera_pairs(images: list[MatchedImage], matches: MatchGraph, views: ViewGraph) -> CameraPairs:
    """What a calibrator gets to know about the photos of one camera."""
    return photo_pairs(images, matches, views).among([image.id for image in images])


def intrinsics_seal(place: Workspace) -> str:
    """Hash of what this stage left: calibration.json without what the scene adds, and the cameras of the database."""
    known = json.loads(place.calibration.read_text(encoding="utf-8"))
    known.pop("refined", None)
    return fingerprint(known, cameras_seal(place.database))


def load_intrinsics(run: RunContext) -> Intrinsics:
    """Read calibration.json back."""
    return Intrinsics.from_dict(json.loads(run.workspace.calibration.read_text(encoding="utf-8")))


def _summary(camera: Calibration) -> dict[str, object]:
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    plain = {name: round(float(value), 3) for name, value in (("fx", fx), ("fy", fy), ("cx", cx), ("cy", cy))}
    plain["k1"] = round(camera.radial, 5)
    return plain | {"method": camera.method, "identifiable": camera.identifiable, "reason": camera.reason}
