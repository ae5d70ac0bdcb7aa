"""Fits and cameras that an earlier run has."""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from sfm_app.camera_files import run_camera
from sfm_app.estimation.calibrating import find_intrinsics, photo_pairs, to_whole_photo
from sfm_app.estimation.given_cameras import CENTERS, Contradiction, find_contradictions, focal_claim
from sfm_app.runtime.context import Earlier, RunContext
from sfm_app.selfcal import CalibratedCamera, calibrate_photo_set
from sfm_app.types import Calibration, EpipolarFit, Intrinsics, MatchedImage, MatchGraph, PairId, Rejected, ViewGraph

# Wide lenses and fundamental matrices of an earlier run.

LEAST_KNOWN = 0.5
"""Share of the photos of a camera group that an earlier run must have seen for what it found of the camera to stay: by
definition, most of them."""


def mostly_known_groups(matches: MatchGraph, earlier: Earlier) -> dict[str, tuple[list[MatchedImage], int]]:
    """Return the camera groups most of whose photos are known: their photos, and how many of these are known.

    Args:
        matches: all photos.
        earlier: what an earlier run left behind.
    """
    groups: dict[str, list[MatchedImage]] = {}
    for _, image in sorted(matches.images.items()):
        groups.setdefault(image.group, []).append(image)
    counts = {group: sum(image.name in earlier.known for image in images) for group, images in groups.items()}
    return {
        group: (images, counts[group]) for group, images in groups.items() if counts[group] > LEAST_KNOWN * len(images)
    }


def known_lenses(matches: MatchGraph, before: ViewGraph, earlier: Earlier) -> dict[str, Calibration | None]:
    """Return what was found of the lenses of camera groups that are mostly known: wide ones, None for the usual ones.

    Args:
        matches: all photos.
        before: view graph of the earlier run.
        earlier: what that left behind.
    """
    return {group: before.lenses.get(group) for group in mostly_known_groups(matches, earlier)}


def known_fits(
    matches: MatchGraph, before: ViewGraph, same: Collection[PairId], lenses: Mapping[str, Calibration]
) -> dict[PairId, tuple[EpipolarFit | Rejected, int]]:
    """Return the fits of pairs with the same matches and the same lenses; their stationary matches are not counted.

    Args:
        matches: all photos.
        before: view graph of the earlier run.
        same: pairs whose matches are the same.
        lenses: of this run, by camera group.
    """
    groups = {image.group for image in matches.images.values()}
    unchanged = {group for group in groups if _text(before.lenses.get(group)) == _text(lenses.get(group))}
    every: dict[PairId, EpipolarFit | Rejected] = {**before.fits, **before.rejected}
    return {
        pair: (every[pair], 0)
        for pair in same
        if pair in every and all(matches.images[photo].group in unchanged for photo in pair)
    }


def _text(lens: Calibration | None) -> str:
    return "" if lens is None else str(lens.to_dict())


# Cameras of an earlier run, which its last adjustment has refined, as those of the photos that came later.

METHOD = "earlier run"
"""Name of what found a camera: the last adjustment of a run with other photos."""
ZOOM_SHARE = 0.05
"""Share by which radii have to differ for new photos to be those of another camera. Chosen by hand: 20 photos of
kitchen1000 put the optical center five stated deviations off, and focusing changes a focal by a few percent."""


def find_or_keep_intrinsics(
    matches: MatchGraph, views: ViewGraph, run: RunContext
) -> tuple[Intrinsics, Sequence[CalibratedCamera]]:
    """Return the cameras of all photos: those that an earlier run has refined, and new ones of the other groups.

    A camera stays where most photos of its group are known, the photos determined it, and the new photos do not
    contradict it. Where a group was split, or the user gave cameras, all are found as in a first run.

    Args:
        matches, views, run: keypoints and raw matches; fundamental matrices; the run.
    """
    kept = {} if run.earlier is None or run.given.source else known_cameras(matches, views, run, run.earlier)
    if not kept:
        return find_intrinsics(matches, views, run)
    images = matches.images.values()
    cameras = [
        CalibratedCamera(group, tuple(image.id for image in images if image.group == group), camera)
        for group, camera in kept.items()
    ]
    if others := {image.id: image for image in images if image.group not in kept}:
        new = find_intrinsics(*_part(matches, views, others), run)[1]
        if not all(camera.found.is_estimated for camera in new):  # pairs with the known cameras may tell more
            return find_intrinsics(matches, views, run)
        cameras += new
    run.record(kept_cameras=sorted(kept))
    return _assemble(cameras, matches)


def _assemble(cameras: list[CalibratedCamera], matches: MatchGraph) -> tuple[Intrinsics, Sequence[CalibratedCamera]]:
    """Return the cameras as those of a run, the one with most photos first."""
    cameras = sorted(cameras, key=lambda one: (-len(one.photos), one.name))
    found = Intrinsics(
        cameras={camera.name: camera.found for camera in cameras},
        camera_of={matches.images[photo].name: camera.name for camera in cameras for photo in camera.photos},
        photos={image.id: image.name for image in matches.images.values()},
    )
    return found, cameras


def known_cameras(matches: MatchGraph, views: ViewGraph, run: RunContext, earlier: Earlier) -> dict[str, Calibration]:
    """Return the cameras of an earlier run that stay, by camera group.

    Args:
        matches, views, run: as in `find_or_keep_intrinsics`.
        earlier: what the earlier run left behind.
    """
    if "scene" not in earlier.stages:
        return {}
    values = json.loads(earlier.place.scene.read_text(encoding="utf-8"))
    found = {}
    for group, (images, _) in mostly_known_groups(matches, earlier).items():
        names = {values["camera_of"].get(image.name, group) for image in images if image.name in earlier.known}
        camera = refined_camera(values["cameras"].get(group)) if names == {group} else None
        if camera is not None and not _is_contradicted(camera, images, matches, views, run, earlier.known):
            found[group] = camera
    return found


def refined_camera(entry: Mapping[str, Any] | None) -> Calibration | None:
    """Return a camera of scene.json; None where there is none, or the photos did not determine its focal.

    Args:
        entry: `CameraModel` as plain values.
    """
    if entry is None or "fx" not in entry.get("deviations", {}):
        return None
    found = run_camera(entry)
    if found is None:
        return None
    held = tuple(name for name in ("center", "aspect", "k1") if name not in entry.get("determined", ()))
    return replace(found, method=METHOD, identifiable=True, reason="", held=held)


def _is_contradicted(
    camera: Calibration, images: Sequence[MatchedImage], matches: MatchGraph, views: ViewGraph, run: RunContext,
    known: Collection[str],
) -> bool:  # fmt: skip
    """Return whether the new photos of a group say that another camera took them: their EXIF, or their own pairs."""
    new = [image for image in images if image.name not in known]
    claim, before = (
        focal_claim(some, camera.focal_px, camera.spread["fx"])
        for some in (new, [image for image in images if image.name in known])
    )
    against = []
    if claim is not None and claim.is_contradicted and not (before is not None and before.is_contradicted):
        against.append(claim.text)
    if not against and images[0].group not in views.lenses:
        against += [one.text for one in _pair_contradictions(camera, new, matches, views, run)]
    for text in against:
        run.progress.say(f"the new photos contradict the camera {images[0].group} so far: {text}")
    return bool(against)


def _pair_contradictions(
    camera: Calibration, new: list[MatchedImage], matches: MatchGraph, views: ViewGraph, run: RunContext
) -> list[Contradiction]:
    """Return in what the camera that the pairs of new photos determine differs from that of the known ones."""
    pairs, options = photo_pairs(new, matches, views), run.settings.calibration
    if not pairs.photos:
        return []
    calibrator = run.plugins.calibrator(options.calibrator)
    own = calibrate_photo_set(pairs, calibrator.calibrate, options, run.seed, together=calibrator.together, split=False)
    cameras = [to_whole_photo(mine, new[0]).found for mine in own]
    return [one for found in cameras for one in find_contradictions(camera, found) if _is_zoom(one)]


def _is_zoom(one: Contradiction) -> bool:
    """Return whether two cameras differ by more than focusing changes, and few photos get wrong."""
    return one.what not in CENTERS and abs(one.given_px - one.found_px) > ZOOM_SHARE * one.found_px


def _part(matches: MatchGraph, views: ViewGraph, images: Mapping[int, MatchedImage]) -> tuple[MatchGraph, ViewGraph]:
    """Return the matches and fundamental matrices among some photos."""
    keypoints = {photo: matches.keypoints[photo] for photo in images}
    rows = {pair: found for pair, found in matches.matches.items() if images.keys() >= set(pair)}
    fits = {pair: fit for pair, fit in views.fits.items() if images.keys() >= set(pair)}
    groups = {image.group for image in images.values()}
    lenses = {group: lens for group, lens in views.lenses.items() if group in groups}
    refused = {pair: why for pair, why in views.rejected.items() if images.keys() >= set(pair)}
    return MatchGraph(images, keypoints, rows), ViewGraph(fits, refused, lenses)
