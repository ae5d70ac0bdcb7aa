"""Fits and cameras of an earlier run."""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sfm_app.camera_files import run_camera
from sfm_app.estimation.calibrating import find_intrinsics, photo_pairs, to_intrinsics, to_whole_photo
from sfm_app.estimation.given_cameras import CENTERS, Contradiction, find_contradictions, focal_claim
from sfm_app.runtime.context import Earlier, RunContext
from sfm_app.selfcal import CalibratedCamera, calibrate_photo_set
from sfm_app.types import (
    Calibration,
    EpipolarGeometry,
    Intrinsics,
    MatchedImage,
    MatchGraph,
    PairId,
    Rejected,
    ViewGraph,
)

# Wide lenses and fundamental matrices of an earlier run.


def mostly_known_groups(matches: MatchGraph, earlier: Earlier) -> dict[str, list[MatchedImage]]:
    """Return the photos of the camera groups with most photos known."""
    groups: dict[str, list[MatchedImage]] = {}
    for _, image in sorted(matches.images.items()):
        groups.setdefault(image.group, []).append(image)
    known = {group: sum(image.name in earlier.known for image in images) for group, images in groups.items()}
    return {group: images for group, images in groups.items() if known[group] > 0.5 * len(images)}


def known_lenses(matches: MatchGraph, before: ViewGraph, earlier: Earlier) -> dict[str, Calibration | None]:
    """Return the lenses of mostly known camera groups in the earlier view graph: wide ones, None for the usual ones."""
    return {group: before.lenses.get(group) for group in mostly_known_groups(matches, earlier)}


def known_fits(
    matches: MatchGraph, before: ViewGraph, same: Collection[PairId], lenses: Mapping[str, Calibration]
) -> dict[PairId, EpipolarGeometry | Rejected]:
    """Return the fits of pairs with the same matches and lenses."""
    groups = {image.group for image in matches.images.values()}
    unchanged = {group for group in groups if _text(before.lenses.get(group)) == _text(lenses.get(group))}
    results = before.results
    return {
        pair: results[pair]
        for pair in same
        if pair in results and all(matches.images[photo].group in unchanged for photo in pair)
    }


def _text(lens: Calibration | None) -> str:
    return "" if lens is None else str(lens.to_dict())


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
    """Return whether EXIF or the pairs of the new photos of a group contradict the camera."""
    new = [image for image in images if image.name not in known]
    claim, before = (
        focal_claim(some, camera.focal_px, camera.spread["fx"])
        for some in (new, [image for image in images if image.name in known])
    )
    contradictions = []
    if claim is not None and claim.is_contradicted and not (before is not None and before.is_contradicted):
        contradictions.append(claim.text)
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
