"""Cameras of all photos: by the chosen calibrator from fundamental matrices, or from an earlier run."""

import json
import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sfm_app.camera_files import run_camera
from sfm_app.estimation.claims import Claim, claim, photo_prior, report_claims
from sfm_app.estimation.diagnosis import diagnose_fits, inliers_by_degeneracy
from sfm_app.estimation.fitting import find_views, mostly_known_groups
from sfm_app.estimation.given_cameras import CENTERS, Contradiction, find_contradictions, given_cameras, report_checks
from sfm_app.fundamental.rays import select_inliers
from sfm_app.numerical import FAILURES
from sfm_app.retrieval import choose_by_rank
from sfm_app.runtime.context import Earlier, RunContext
from sfm_app.selfcal import CalibratedCamera, calibrate_photo_set, pair_weights
from sfm_app.types import (
    Calibration,
    EpipolarFit,
    EpipolarGeometry,
    Evidence,
    Intrinsics,
    MatchedImage,
    MatchGraph,
    PairId,
    PhotoPairs,
    ViewGraph,
)
from sfm_app.types.camera import EQUIRECTANGULAR

logger = logging.getLogger("sfm_app")


class OPTIONS:
    """Pairs that calibrate, and inliers through a lens."""

    min_radial: float = 0.02
    """|k1| from which on inliers are chosen again. Chosen on `benchmarks.lenses.distortion`."""
    min_kept: float = 0.7
    """Share of its inliers that a pair must keep then. Chosen by hand."""
    all_pairs: int = 2000
    """Pairs up to which all calibrate. Chosen by hand."""
    pairs_per_photo: int = 4
    """Least partners of each photo in a sample of more. Chosen by hand."""
    lens_rounds: int = 2
    """Most times that inliers are chosen through the lens so far. Chosen on `benchmarks.lenses.distortion`."""


# Inliers through a lens (ours). A fundamental matrix of pixels keeps the matches that a lens bends least, and cameras
# adjusted to these alone have too long or too short a focal. With their lens, each pair selects its inliers again.


def select_inliers_through_lens(
    matches: MatchGraph, views: ViewGraph, cameras: Sequence[CalibratedCamera], run: RunContext
) -> ViewGraph:
    """Choose the inliers of pairs through the lenses of known cameras; return the same graph where none bends."""
    known = {photo: camera.found for camera in cameras for photo in camera.photos if camera.found.is_estimated}
    pairs = [pair for pair, fit in views.fits.items() if not fit.degeneracy and _is_bent(pair, fit, known)]
    if not pairs:
        return views

    max_error_px = run.settings.epipolar.max_error_px

    def choose(pair: PairId) -> EpipolarGeometry:
        fit = views.fits[pair]
        try:
            lenses = [known[photo] for photo in pair]
            inliers, degeneracy = select_inliers(matches.points(pair), lenses, fit.inliers, max_error_px)
        except FAILURES as err:
            logger.info("the inliers of pair %s could not be selected through the lens", pair, exc_info=err)
            return fit
        enough = inliers.sum() >= OPTIONS.min_kept * fit.inlier_count
        return replace(fit, inliers=inliers, degeneracy=degeneracy) if enough else fit

    selected = dict(zip(pairs, run.map(choose, pairs, "matches through the lens"), strict=True))
    return replace(views, fits={pair: selected.get(pair, fit) for pair, fit in views.fits.items()})


def _is_bent(pair: PairId, fit: EpipolarGeometry, known: Mapping[int, Calibration]) -> bool:
    if not isinstance(fit, EpipolarFit) or not known.keys() >= set(pair):
        return False
    return max(abs(known[photo].radial) for photo in pair) >= OPTIONS.min_radial


def find_intrinsics(matches: MatchGraph, views: ViewGraph, run: RunContext) -> Intrinsics:
    """Find K and lens of every camera, and the camera of every photo; unidentifiable cameras become a guess."""
    sample = sample_pairs(views, len(matches.images))
    run.record(pairs_asked=len(sample.fits))
    cameras, straight = _calibrate(matches, sample, run), views
    for _ in range(OPTIONS.lens_rounds):
        selected = select_inliers_through_lens(matches, sample, _of_whole_photos(cameras, matches), run)
        if selected is sample:
            break
        straight = replace(views, fits={**views.fits, **selected.fits})
        before, cameras = cameras, _calibrate(matches, selected, run, cameras)
        if _agree(before, cameras):
            break
    cameras, images = _of_whole_photos(cameras, matches), matches.images.values()
    for group, lens in views.lenses.items():  # they precede the fundamental matrices
        cameras.append(CalibratedCamera(group, tuple(image.id for image in images if image.group == group), lens))
    report_claims({camera.name: _claim(camera, matches) for camera in cameras}, run)
    cameras = _take_given_cameras(cameras, matches, run)
    return to_intrinsics((replace(camera, found=explain_failure(camera, straight)) for camera in cameras), matches)


def _agree(before: Sequence[CalibratedCamera], after: Sequence[CalibratedCamera]) -> bool:
    """Return whether focals moved by less than their deviations: then other inliers would not move them, either."""
    earlier = {camera.photos: camera.found.K[0, 0] for camera in before}
    known = [camera for camera in after if "fx" in camera.found.spread]
    if not known or any(camera.photos not in earlier for camera in known):
        return False
    moves = [(camera.found.K[0, 0] - earlier[camera.photos]) / camera.found.spread["fx"] for camera in known]
    return float(np.mean(np.square(moves))) <= 1.0


def find_evidence(matches: MatchGraph, run: RunContext, known: Evidence) -> Evidence:
    """Return the evidence of matches of which some are known: other pairs are fitted, and unknown cameras found."""
    same = {pair for pair, rows in matches.matches.items() if known.matches.matches.get(pair) is rows}
    results = known.views.results
    views = find_views(matches, run, known.views.lenses, {pair: results[pair] for pair in same if pair in results})
    estimated = [known.camera(photo).is_estimated for photo in known.matches.images]
    if 2 * sum(estimated) >= len(estimated) or same.issuperset(views.fits):
        return Evidence(matches, views, known.intrinsics)
    return Evidence(matches, views, find_intrinsics(matches, views, run))


def to_intrinsics(cameras: Iterable[CalibratedCamera], matches: MatchGraph) -> Intrinsics:
    """Return the cameras of all photos, that of the most photos first."""
    ordered = sorted(cameras, key=lambda one: (-len(one.photos), one.name))
    return Intrinsics(
        cameras={camera.name: camera.found for camera in ordered},
        camera_of={matches.images[photo].name: camera.name for camera in ordered for photo in camera.photos},
        photos={image.id: image.name for image in matches.images.values()},
    )


def sample_pairs(views: ViewGraph, photos: int) -> ViewGraph:
    """Return the view graph with as many pairs as cameras need: of each photo those with most inliers, and others."""
    counts = {pair: fit.inlier_count for pair, fit in views.fits.items() if not fit.degeneracy}
    if len(counts) <= OPTIONS.all_pairs:
        return views
    chosen = choose_by_rank(counts, 0, max(OPTIONS.pairs_per_photo, OPTIONS.all_pairs // max(photos, 1)))
    return replace(views, fits={pair: fit for pair, fit in views.fits.items() if pair in chosen})


def _calibrate(
    matches: MatchGraph, views: ViewGraph, run: RunContext, before: Sequence[CalibratedCamera] = ()
) -> list[CalibratedCamera]:
    """Return the cameras of the pictures inside the bars of the photos."""
    options = run.settings.calibration
    calibrator = run.plugins.calibrator(options.calibrator)
    pairs = photo_pairs([image for image in matches.images.values() if image.group not in views.lenses], matches, views)
    # groups that the user defined are not split
    split = run.settings.photos.cameras == "auto"
    return calibrate_photo_set(
        pairs, calibrator.calibrate, options, run.seed, together=calibrator.together, split=split, before=before
    )


def _of_whole_photos(cameras: Sequence[CalibratedCamera], matches: MatchGraph) -> list[CalibratedCamera]:
    return [to_whole_photo(camera, matches.images[camera.photos[0]]) for camera in cameras]


def _claim(camera: CalibratedCamera, matches: MatchGraph) -> Claim | None:
    calibration = camera.found
    if not calibration.identifiable or calibration.is_given or calibration.projection == EQUIRECTANGULAR:
        return None
    return claim((matches.images[photo] for photo in camera.photos), calibration)


def _take_given_cameras(
    cameras: Sequence[CalibratedCamera], matches: MatchGraph, run: RunContext
) -> list[CalibratedCamera]:
    """Replace calibrated cameras by those that the user gave; those with a wide lens were checked before."""
    given = given_cameras(matches, run).cameras
    result, checked = [], {}
    for camera in cameras:
        group = matches.images[camera.photos[0]].group
        if group not in given or camera.found.is_given:
            result.append(camera)
            continue
        checked[camera.name] = given[group], camera.found
        if camera.name == group:
            photos = tuple(photo for photo, image in matches.images.items() if image.group == group)
            own = replace(given[group], key_pairs=camera.found.key_pairs)
            result.append(CalibratedCamera(group, photos, own))
    report_checks(checked, run)
    return result


def explain_failure(camera: CalibratedCamera, views: ViewGraph) -> Calibration:
    """Return the calibration; if it failed because most pairs are degenerate, its reason names the degeneracy."""
    kinds = inliers_by_degeneracy(views, camera.photos)
    if camera.found.identifiable or kinds[""] >= kinds.total() / 2:
        return camera.found
    return replace(camera.found, reason=f"{camera.found.reason}; {diagnose_fits(views, camera.photos).message}")


def to_whole_photo(camera: CalibratedCamera, image: MatchedImage) -> CalibratedCamera:
    """Return a camera of the picture inside the bars of a photo in pixels of the whole photo."""
    if image.shown is None:
        return camera
    K = camera.found.K.copy()
    K[:2, 2] += image.shown[:2]
    return replace(camera, found=replace(camera.found, K=K, width=image.width, height=image.height))


def photo_pairs(
    images: list[MatchedImage], matches: MatchGraph, views: ViewGraph, kind: type[EpipolarGeometry] = EpipolarFit
) -> PhotoPairs:
    """Return the pairs of some photos that are not degenerate, in pixels of the pictures inside their bars.

    The matrices of the kind `RayFit` are of bearing vectors.
    """
    ids = {image.id for image in images}
    fits = {p: f for p, f in views.fits.items() if ids.issuperset(p) and isinstance(f, kind) and not f.degeneracy}
    return PhotoPairs(
        Fs=np.array([fit.matrix for fit in fits.values()], np.float64).reshape(-1, 3, 3),
        weights=pair_weights(np.array([fit.inlier_count for fit in fits.values()], np.int64)),
        photos=tuple(fits),
        inliers=tuple(np.hstack(matches.points(pair))[fit.inliers] for pair, fit in fits.items()),
        sizes={image.id: image.shown[2:] if image.shown else (image.width, image.height) for image in images},
        groups={image.id: image.group for image in images},
        priors={image.id: prior for image in images if (prior := photo_prior(image)) is not None},
        padded_sizes={image.id: (image.width, image.height) for image in images if image.shown},
    ).with_origins({image.id: image.shown[:2] for image in images if image.shown})


# Cameras of an earlier run, which its last adjustment has refined.

METHOD = "earlier run"
"""Source of a camera: the last adjustment of a run with other photos."""


def find_or_keep_intrinsics(matches: MatchGraph, views: ViewGraph, run: RunContext) -> Intrinsics:
    """Return the cameras of all photos: refined ones of an earlier run that nothing contradicts, and new ones."""
    known = {} if run.earlier is None or run.given.source else known_cameras(matches, views, run, run.earlier)
    if not known:
        return find_intrinsics(matches, views, run)
    new = Intrinsics({})
    if others := {image.id: image for image in matches.images.values() if image.group not in known}:
        new = find_intrinsics(*_part(matches, views, others), run)
        if not all(
            camera.is_estimated for camera in new.cameras.values()
        ):  # pairs with the known cameras may tell more
            return find_intrinsics(matches, views, run)
    run.record(kept_cameras=sorted(known))
    members: dict[str, list[int]] = {}
    for image in matches.images.values():
        members.setdefault(image.group if image.group in known else new.camera_name(image), []).append(image.id)
    cameras = {**known, **new.cameras}
    return to_intrinsics((CalibratedCamera(name, tuple(ids), cameras[name]) for name, ids in members.items()), matches)


def known_cameras(matches: MatchGraph, views: ViewGraph, run: RunContext, earlier: Earlier) -> dict[str, Calibration]:
    """Return the cameras of an earlier run that stay, by camera group."""
    if "scene" not in earlier.stages:
        return {}
    values = json.loads(earlier.place.scene.read_text(encoding="utf-8"))
    cameras = {}
    for group, images in mostly_known_groups(matches, earlier).items():
        names = {values["camera_of"].get(image.name, group) for image in images if image.name in earlier.known}
        camera = refined_camera(values["cameras"].get(group)) if names == {group} else None
        if camera is not None and not _is_contradicted(camera, images, matches, views, run, earlier.known):
            cameras[group] = camera
    return cameras


def refined_camera(entry: Mapping[str, Any] | None) -> Calibration | None:
    """Return a camera of scene.json; None where there is none, or the photos did not determine its focal."""
    if entry is None or "fx" not in entry.get("deviations", {}):
        return None
    camera = run_camera(entry)
    if camera is None:
        return None
    held = tuple(name for name in ("center", "aspect", "k1") if name not in entry.get("determined", ()))
    return replace(camera, method=METHOD, identifiable=True, reason="", held=held)


def _is_contradicted(
    camera: Calibration, images: Sequence[MatchedImage], matches: MatchGraph, views: ViewGraph, run: RunContext,
    known: Collection[str],
) -> bool:  # fmt: skip
    """Return whether claims or the pairs of the new photos of a group contradict the camera."""
    new = [image for image in images if image.name not in known]
    claimed, before = (claim(some, camera) for some in (new, [image for image in images if image.name in known]))
    contradictions = []
    if claimed is not None and claimed.is_contradicted and not (before is not None and before.is_contradicted):
        contradictions.append(claimed.text)
    if not contradictions:
        contradictions += [one.text for one in _pair_contradictions(camera, new, matches, views, run)]
    for text in contradictions:
        run.progress.say(f"the new photos contradict the earlier camera {images[0].group}: {text}")
    return bool(contradictions)


def _pair_contradictions(
    camera: Calibration, new: list[MatchedImage], matches: MatchGraph, views: ViewGraph, run: RunContext
) -> list[Contradiction]:
    """Return how the camera that the pairs of new photos determine differs from the known one."""
    pairs, options = photo_pairs(new, matches, views), run.settings.calibration
    if not pairs.photos:
        return []
    calibrator = run.plugins.calibrator(options.calibrator)
    own = calibrate_photo_set(pairs, calibrator.calibrate, options, run.seed, together=calibrator.together, split=False)
    cameras = [to_whole_photo(mine, new[0]).found for mine in own]
    differences = [one for estimated in cameras for one in find_contradictions(camera, estimated)]
    # focusing changes less; chosen by hand
    return [
        one for one in differences
        if one.what not in CENTERS and abs(one.given_px - one.found_px) > 0.05 * one.found_px
    ]  # fmt: skip


def _part(matches: MatchGraph, views: ViewGraph, images: Mapping[int, MatchedImage]) -> tuple[MatchGraph, ViewGraph]:
    keypoints = {photo: matches.keypoints[photo] for photo in images}
    rows = {pair: found for pair, found in matches.matches.items() if images.keys() >= set(pair)}
    fits = {pair: fit for pair, fit in views.fits.items() if images.keys() >= set(pair)}
    groups = {image.group for image in images.values()}
    lenses = {group: lens for group, lens in views.lenses.items() if group in groups}
    rejected = {pair: why for pair, why in views.rejected.items() if images.keys() >= set(pair)}
    return MatchGraph(images, keypoints, rows), ViewGraph(fits, rejected, lenses)
