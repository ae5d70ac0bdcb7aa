"""intrinsics: ViewGraph -> Intrinsics."""

import json
from dataclasses import replace

import numpy as np

from sfm_app.colmap.backend import backend
from sfm_app.colmap.database import write_calibrations
from sfm_app.context import RunContext
from sfm_app.geometry.camera import guessed_camera_matrix
from sfm_app.selfcal import pair_weights
from sfm_app.types import Calibration, CameraPairs, Intrinsics, MatchedImage, MatchGraph, ViewGraph


def calibrate(matches: MatchGraph, views: ViewGraph, run: RunContext) -> Intrinsics:
    """Find K of every camera group from the pairs within it; what is not identifiable falls back to a guess."""
    groups: dict[str, list[MatchedImage]] = {}
    for image in matches.images.values():
        groups.setdefault(image.group, []).append(image)
    by_size = sorted(groups, key=lambda name: (-len(groups[name]), name))
    cameras = {name: calibrate_group(groups[name], matches, views, run) for name in by_size}
    intrinsics = Intrinsics(cameras)
    run.record(
        cameras={name: _summary(camera) for name, camera in cameras.items()},
        identifiable=sum(camera.identifiable for camera in cameras.values()),
    )
    with run.workspace.replacing(run.workspace.calibration) as path:
        values = {name: camera.to_dict() for name, camera in cameras.items()}
        path.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
    with backend("writing calibrations"):
        write_calibrations(run.workspace.database, matches, intrinsics)
    return intrinsics


def calibrate_group(images: list[MatchedImage], matches: MatchGraph, views: ViewGraph, run: RunContext) -> Calibration:
    """K of the photos of one camera."""
    options = run.settings.calibration
    pairs = camera_pairs(images, matches, views)
    found = run.plugins.calibrator(options.calibrator).calibrate(pairs, options, run.seed)
    return found if found.identifiable else fall_back(found, images)


def camera_pairs(images: list[MatchedImage], matches: MatchGraph, views: ViewGraph) -> CameraPairs:
    """What a calibrator gets to know about the photos of one camera: all pairs among them that are not degenerate."""
    ids = {image.id for image in images}
    fits = {pair: fit for pair, fit in views.fits.items() if ids.issuperset(pair) and not fit.degeneracy}
    return CameraPairs(
        Fs=np.array([fit.F for fit in fits.values()], np.float64).reshape(-1, 3, 3),
        weights=pair_weights(np.array([fit.inlier_count for fit in fits.values()], np.int64)),
        size=(images[0].width, images[0].height),
        photos=tuple(fits),
        inliers=tuple(np.hstack(matches.points(pair))[fit.inliers] for pair, fit in fits.items()),
        focal_hints_px=tuple(image.exif_focal_px for image in images if image.exif_focal_px),
    )


def fall_back(found: Calibration, images: list[MatchedImage]) -> Calibration:
    """The K that mapping starts from when the photos do not determine it: EXIF's claim, else the usual guess."""
    claims = [image.exif_focal_px for image in images if image.exif_focal_px]
    K = guessed_camera_matrix((found.width, found.height), float(np.median(claims)) if claims else None)
    return replace(found, K=K, method="exif" if claims else "guess", spread={})


def load_intrinsics(run: RunContext) -> Intrinsics:
    """Read calibration.json back."""
    values = json.loads(run.workspace.calibration.read_text(encoding="utf-8"))
    return Intrinsics({name: Calibration.from_dict(camera) for name, camera in values.items()})


def _summary(camera: Calibration) -> dict[str, object]:
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    plain = {name: round(float(value), 3) for name, value in (("fx", fx), ("fy", fy), ("cx", cx), ("cy", cy))}
    return plain | {"method": camera.method, "identifiable": camera.identifiable, "reason": camera.reason}
