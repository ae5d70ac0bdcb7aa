"""One camera for each photo, as a rival hypothesis: a zoom, or several devices, that the pairs do not reveal.

Photos of one size count as one camera until their pairs contradict that. Pairs of a camera that moves forward or round
one point never do. A model does: with one focal for all photos, it contradicts matches that are right pair by pair.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

import numpy as np

from sfm_app.colmap.models.model import cameras_by_photo, posed_photo_ids
from sfm_app.geometry.camera import guessed_camera_matrix
from sfm_app.reconstruction.baseline import connected_photos, has_many_unplaced
from sfm_app.reconstruction.mapping_runs import EQUAL_TOLERANCE, MAX_CONTRADICTED_SHARE, Attempt
from sfm_app.settings import Settings
from sfm_app.types import Calibration, Intrinsics, MatchedImage, MatchGraph, ViewGraph

MIN_PHOTOS, MAX_PHOTOS = 5, 100
"""Range of the number of photos: with fewer, a camera per photo fits almost anything; with more than a video has
by default, a pass costs more than it promises."""
MAX_REMAINING_SHARE = 0.5
"""Largest share of the contradictions that may remain with a camera per photo; else shared cameras were not the cause.
Chosen on folders 0 to 180 of `python -m benchmarks.trouble`."""
SHARE_TOLERANCE = 0.002
"""Largest increase of the contradicted share with two cameras, compared to a camera per photo: right cameras leave up
to this share."""


def can_have_own_cameras(model: Attempt | None, intrinsics: Intrinsics, views: ViewGraph, settings: Settings) -> bool:
    """Return whether photos of one size may have a camera each: matches contradict the model, or it lacks many photos.

    Args:
        model: the main model so far.
        intrinsics: cameras from pairs.
        views: fundamental matrices.
        settings: a user's choice of which photos share a camera is kept.
    """
    if model is None or settings.photos.cameras != "auto":
        return False
    if (
        not MIN_PHOTOS <= max(model.photos, len(connected_photos(views.fits))) <= MAX_PHOTOS
    ):  # pairs on a plane are not counted as fits
        return False
    return _contradicted_share(model) > MAX_CONTRADICTED_SHARE or has_many_unplaced(model, intrinsics, views)


def with_camera_per_photo(model: Attempt, found: Intrinsics, matches: MatchGraph) -> Intrinsics | None:
    """Give each photo its own camera where pairs do not determine the shared one; return None if none is divided.

    The focal of a new camera is the one that mapping found for the shared camera, as a guess.

    Args:
        model: mapped with shared cameras.
        found: the shared cameras.
        matches: all photos.
    """
    focals = {photo: float(K[0, 0] * K[1, 1]) ** 0.5 for photo, (K, *_) in cameras_by_photo(model.model).items()}
    placed = posed_photo_ids(model.model)
    usual = {found.camera_name(matches.images[photo]): focals[photo] for photo in placed if photo in focals}
    members: dict[str, list[MatchedImage]] = {}
    for image in matches.images.values():
        members.setdefault(found.camera_name(image), []).append(image)
    divided = [name for name, images in members.items() if len(images) > 1 and not found.cameras[name].identifiable]
    if not divided:
        return None
    cameras, camera_of = dict(found.cameras), dict(found.camera_of)
    for name in divided:
        camera = cameras.pop(name)
        names = _free_names(name, {*found.cameras, *cameras})
        for image, own in zip(sorted(members[name], key=lambda image: image.name), names, strict=False):
            cameras[own], camera_of[image.name] = _guess(camera, usual.get(name)), own
    return replace(found, cameras=cameras, camera_of=camera_of)


def with_two_cameras(model: Attempt, each: Intrinsics, matches: MatchGraph) -> Intrinsics | None:
    """Replace the cameras of photos of one size by two; return None if no size can be divided.

    For each size, the focals that mapping found are divided at their widest gap.

    Args:
        model: mapped with a camera for each photo.
        each: the cameras of the photos.
        matches: all photos.
    """
    of_size: dict[tuple[int, int], dict[str, float]] = {}
    for photo, (K, *_) in cameras_by_photo(model.model).items():
        name = each.camera_name(matches.images[photo])
        if not each.cameras[name].identifiable:
            size = each.cameras[name].width, each.cameras[name].height
            of_size.setdefault(size, {})[name] = float(K[0, 0] * K[1, 1]) ** 0.5
    cameras = dict(each.cameras)
    instead: dict[str, str] = {}
    for size, focals in of_size.items():
        for group in _split_at_gap(focals):
            K = guessed_camera_matrix(size, float(np.median([focals[name] for name in group])))
            cameras[group[0]] = replace(cameras[group[0]], K=K, identifiable=True, reason="", method="mapping")
            instead |= dict.fromkeys(group[1:], group[0])
    camera_of = {photo: instead.get(name, name) for photo, name in each.camera_of.items()}
    used = {name: camera for name, camera in cameras.items() if name not in instead}
    return replace(each, cameras=used, camera_of=camera_of) if instead else None


def is_as_good(two: Attempt | None, own: Attempt) -> bool:
    """Return whether two cameras explain the matches as well as one for each photo.

    Args:
        two: model with two cameras, if there is one.
        own: model with a camera for each photo.
    """
    if two is None or two.photos < own.photos or two.support < (1.0 - EQUAL_TOLERANCE) * own.support:
        return False
    return _contradicted_share(two) <= _contradicted_share(own) + SHARE_TOLERANCE


def is_better(own: Attempt | None, shared: Attempt) -> bool:
    """Return whether a camera per photo explains more matches, and registers more photos or removes contradictions.

    Args:
        own: model with a camera for each photo, if there is one.
        shared: model with one camera for all.
    """
    if own is None or own.photos < shared.photos or own.support <= shared.support:
        return False
    return own.photos > shared.photos or _contradicted_share(own) <= MAX_REMAINING_SHARE * _contradicted_share(shared)


def _contradicted_share(model: Attempt) -> float:
    """Return the share of the inliers of fundamental matrices that contradict a model."""
    inliers = sum(pair.inliers for pair in model.explained.values())
    return sum(pair.contradicted for pair in model.explained.values()) / max(inliers, 1)


def _split_at_gap(focals: Mapping[str, float]) -> list[list[str]]:
    """Return names in two parts, divided at the widest gap between focals; empty if a part has only one name."""
    names = sorted(focals, key=lambda name: (focals[name], name))
    if len(names) < MIN_PHOTOS:
        return []
    gap = int(np.argmax(np.diff(np.log([focals[name] for name in names])))) + 1
    return [names[:gap], names[gap:]] if 2 <= gap <= len(names) - 2 else []


def _free_names(name: str, taken: Collection[str]) -> Iterable[str]:
    """Yield the name itself, then numbered variants of it that are not taken."""
    yield name
    number = 2
    while True:
        if (other := f"{name} #{number}") not in taken:
            yield other
        number += 1


def _guess(camera: Calibration, focal_px: float | None) -> Calibration:
    size = camera.width, camera.height
    K = guessed_camera_matrix(size, camera.focal_px if focal_px is None else focal_px)
    return Calibration(K, *size, "guess", identifiable=False, reason="its photos may each be of another camera")
