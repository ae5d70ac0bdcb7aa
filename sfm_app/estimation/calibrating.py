"""Cameras of all photos from the fundamental matrices of their pairs, by the chosen calibrator."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from sfm_app.estimation.diagnosis import diagnose_fits, inliers_by_degeneracy
from sfm_app.estimation.given_cameras import (
    FocalClaim,
    assign_cameras,
    focal_claim,
    report_checks,
    report_claims,
    shown_share,
)
from sfm_app.numerical import FAILURES
from sfm_app.posegraph.pair_pose import Pair, estimate_pose
from sfm_app.retrieval import choose_by_rank
from sfm_app.runtime.context import RunContext
from sfm_app.selfcal import CalibratedCamera, calibrate_photo_set, pair_weights
from sfm_app.types import (
    Calibration,
    CameraPairs,
    EpipolarFit,
    Intrinsics,
    MatchedImage,
    MatchGraph,
    PairId,
    PhotoPairs,
    ViewGraph,
)
from sfm_app.types.camera import EQUIRECTANGULAR

# Inliers that a lens hid: through a barrel or pincushion lens, right matches lie off straight epipolar lines.
#
# Ours. A fundamental matrix of pixels keeps the matches that a lens bends least, and cameras adjusted to these
# alone have too long or too short a focal. With the lens that they give, each pair chooses its inliers among all
# its matches again.

logger = logging.getLogger("sfm_app")

LEAST_RADIAL = 0.02
"""|k1| from which on matches are chosen again. Chosen on synthetic matches with k1 from -0.35 to 0.2
(`python -m benchmarks.lenses.distortion`): at 0.1 the focal is off by 0.4 % without."""
LEAST_KEPT = 0.7
"""Share of its inliers that a pair must keep for its new ones to be taken. Chosen by hand; not measured on its own."""


def choose_inliers_again(
    matches: MatchGraph, views: ViewGraph, cameras: Sequence[CalibratedCamera], run: RunContext
) -> ViewGraph:
    """Return the view graph with the inliers of its pairs chosen through their lenses; the same one where none bends.

    Args:
        matches: keypoints and raw matches.
        views: fundamental matrices.
        cameras: those of all photos, in pixels of whole photos.
        run: the run.
    """
    known = {photo: camera.found for camera in cameras for photo in camera.photos if camera.found.is_estimated}
    pairs = [pair for pair, fit in views.fits.items() if not fit.degeneracy and _is_bent(pair, known, views, matches)]
    if not pairs:
        return views

    def choose(pair: PairId) -> EpipolarFit:
        fit = views.fits[pair]
        try:
            lens = Pair(matches.points(pair), [known[photo] for photo in pair], run.settings.epipolar.max_error_px)
            pose = estimate_pose(lens, fit)
        except FAILURES as err:
            logger.info("the matches of pair %s could not be chosen again", pair, exc_info=err)
            return fit
        kept = pose is not None and pose.inlier_count >= LEAST_KEPT * fit.inlier_count
        return replace(fit, inliers=pose.inliers) if pose is not None and kept else fit

    found = dict(zip(pairs, run.map(choose, pairs, "matches through the lens"), strict=True))
    return replace(views, fits={pair: found.get(pair, fit) for pair, fit in views.fits.items()})


def _is_bent(pair: PairId, known: Mapping[int, Calibration], views: ViewGraph, matches: MatchGraph) -> bool:
    if not known.keys() >= set(pair) or any(matches.images[photo].group in views.lenses for photo in pair):
        return False
    return max(abs(known[photo].radial) for photo in pair) >= LEAST_RADIAL


ENOUGH_PAIRS, PAIRS_PER_PHOTO = 2000, 4
"""Pairs up to which all are used for calibration, and partners of each photo in a sample of more. Chosen by hand."""
LENS_ROUNDS = 2
"""Times the inliers are chosen again through the lens that the cameras so far have. Chosen on synthetic matches
(`python -m benchmarks.lenses.distortion`)."""


def find_intrinsics(
    matches: MatchGraph, views: ViewGraph, run: RunContext
) -> tuple[Intrinsics, Sequence[CalibratedCamera]]:
    """Find K and lens of every camera, and the camera of every photo; unidentifiable cameras fall back to a guess.

    Args:
        matches, views, run: keypoints and raw matches; fundamental matrices; the run.
    """
    sample = sample_pairs(views, len(matches.images))
    run.record(pairs_asked=len(sample.fits))
    cameras = _calibrate(matches, sample, run)
    for _ in range(LENS_ROUNDS):
        seen = choose_inliers_again(matches, sample, cameras, run)
        if seen is sample:
            break
        cameras = _calibrate(matches, seen, run)
    cameras += cameras_with_lens(matches, views)
    report_claims({camera.name: _exif_claim(camera, matches) for camera in cameras}, run)
    cameras = sorted(_take_given_cameras(cameras, matches, run), key=lambda one: (-len(one.photos), one.name))
    intrinsics = Intrinsics(
        cameras={camera.name: explain_failure(camera, views) for camera in cameras},
        camera_of={matches.images[photo].name: camera.name for camera in cameras for photo in camera.photos},
        photos={image.id: image.name for image in matches.images.values()},
    )
    return intrinsics, cameras


def sample_pairs(views: ViewGraph, photos: int) -> ViewGraph:
    """Return the view graph with as many pairs as cameras need; all of them in small sets.

    Each photo keeps some pairs: those with most inliers, and others of any number, which have more parallax.

    Args:
        views: fundamental matrices.
        photos: number of photos.
    """
    counts = {pair: fit.inlier_count for pair, fit in views.fits.items() if not fit.degeneracy}
    if len(counts) <= ENOUGH_PAIRS:
        return views
    chosen = choose_by_rank(counts, 0, max(PAIRS_PER_PHOTO, ENOUGH_PAIRS // max(photos, 1)))
    return replace(views, fits={pair: fit for pair, fit in views.fits.items() if pair in chosen})


def _calibrate(matches: MatchGraph, views: ViewGraph, run: RunContext) -> list[CalibratedCamera]:
    """Return the cameras of all photos without a wide lens, in pixels of whole photos."""
    options = run.settings.calibration
    calibrator = run.plugins.calibrator(options.calibrator)
    pairs = photo_pairs([image for image in matches.images.values() if image.group not in views.lenses], matches, views)
    # groups that the user defined are not split
    split = run.settings.photos.cameras == "auto"
    cameras = calibrate_photo_set(
        pairs, calibrator.calibrate, options, run.seed, together=calibrator.together, split=split
    )
    return [to_whole_photo(camera, matches.images[camera.photos[0]]) for camera in cameras]


def _exif_claim(camera: CalibratedCamera, matches: MatchGraph) -> FocalClaim | None:
    """Return EXIF's claim about a camera that its photos determine."""
    found, images = camera.found, [matches.images[photo] for photo in camera.photos]
    if not found.identifiable or found.is_given or found.projection == EQUIRECTANGULAR:
        return None
    return focal_claim(images, found.focal_px, found.spread.get("fx", 0.0))


def _take_given_cameras(
    cameras: Sequence[CalibratedCamera], matches: MatchGraph, run: RunContext
) -> list[CalibratedCamera]:
    """Return the cameras with those that the user gave in place of the calibrated ones, which are checked first.

    Those with a wide lens were checked before the fundamental matrices.
    """
    given = assign_cameras(matches, run.given, keep=run.settings.calibration.keep).cameras
    found, checked = [], {}
    for camera in cameras:
        group = matches.images[camera.photos[0]].group
        if group not in given or camera.found.is_given:
            found.append(camera)
            continue
        checked[camera.name] = given[group], camera.found
        if camera.name == group:
            photos = tuple(photo for photo, image in matches.images.items() if image.group == group)
            own = replace(given[group], key_pairs=camera.found.key_pairs)
            found.append(CalibratedCamera(group, photos, own))
    report_checks(checked, run)
    return found


def cameras_with_lens(matches: MatchGraph, views: ViewGraph) -> list[CalibratedCamera]:
    """Return the cameras with a wide lens, which were found before the fundamental matrices.

    Args:
        matches: all photos.
        views: has the lenses.
    """
    return [
        CalibratedCamera(group, tuple(photo for photo, one in matches.images.items() if one.group == group), lens)
        for group, lens in views.lenses.items()
    ]


def explain_failure(camera: CalibratedCamera, views: ViewGraph) -> Calibration:
    """Return the calibration; if it failed because most pairs are degenerate, its reason says how.

    Args:
        camera: the calibrated camera with its photos.
        views: fundamental matrices.
    """
    kinds = inliers_by_degeneracy(views, camera.photos)
    if camera.found.identifiable or not kinds.total() > kinds[""]:
        return camera.found
    return replace(camera.found, reason=f"{camera.found.reason}; {diagnose_fits(views, camera.photos).message}")


def to_whole_photo(camera: CalibratedCamera, image: MatchedImage) -> CalibratedCamera:
    """Return a camera in pixels of the whole photo, if it was found in those of the picture inside the bars.

    Args:
        camera: as returned by calibration.
        image: one of its photos.
    """
    if image.shown is None:
        return camera
    K = camera.found.K.copy()
    K[:2, 2] += image.shown[:2]
    return replace(camera, found=replace(camera.found, K=K, width=image.width, height=image.height))


def photo_pairs(images: list[MatchedImage], matches: MatchGraph, views: ViewGraph) -> PhotoPairs:
    """Return the pairs of some photos that are not degenerate, in pixels of the pictures inside their bars.

    Args:
        images: the photos.
        matches: keypoints and raw matches.
        views: fundamental matrices.
    """
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
        focal_hints_px={image.id: image.exif_focal_px * shown_share(image) for image in images if image.exif_focal_px},
        padded_sizes={image.id: (image.width, image.height) for image in images if image.shown},
    ).with_origins({photo: frame[:2] for photo, frame in shown.items()})


def camera_pairs(images: list[MatchedImage], matches: MatchGraph, views: ViewGraph) -> CameraPairs:
    """Return the input of a calibrator for the photos of one camera.

    Args:
        images: photos of the camera.
        matches: keypoints and raw matches.
        views: fundamental matrices.
    """
    return photo_pairs(images, matches, views).to_camera_pairs([image.id for image in images])
