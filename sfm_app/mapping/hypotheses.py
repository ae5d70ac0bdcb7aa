"""Other hypotheses about the photos: COLMAP's defaults, one camera for each photo."""

import logging
from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

import numpy as np

from sfm_app.camera.models import GUESSED_FOCAL, guessed_camera_matrix
from sfm_app.colmap.backend import Reconstruction, run_interruptible, translate_errors
from sfm_app.colmap.database import keep_raw_matches, write_calibrations
from sfm_app.colmap.mapping import copy_database, map_with_colmap_defaults
from sfm_app.colmap.model import cameras_by_photo, posed_photo_ids
from sfm_app.errors import BackendError
from sfm_app.mapping.attempt import (
    EQUAL_TOLERANCE,
    MAX_CONTRADICTED_SHARE,
    Attempt,
    NoModel,
    are_worth_another_try,
    judge_model,
)
from sfm_app.runtime.context import RunContext
from sfm_app.settings import Settings
from sfm_app.types import Calibration, Intrinsics, MatchedImage, MatchGraph, PairId, ViewGraph
from sfm_app.types.camera import PERSPECTIVE
from sfm_app.types.evidence import EpipolarFit

# Rival hypotheses: other models that are tried where the evidence for ours is weak.
#
# Cameras that the pairs do not determine, unregistered photos and contradicting matches are signs that another
# start may explain more. The rival is COLMAP's own pipeline, with the usual guess of the camera and its own
# verification of the matches. It uses none of our fundamental matrices, cameras and poses, and so shares none of
# their errors.

logger = logging.getLogger("sfm_app")

FOLDER = "rival"
MAPPER, NOTE = "colmap", "as COLMAP does by itself"
MIN_UNPLACED_SHARE, MOST_PHOTOS_FOR_DEFAULTS = 0.25, 60
"""Share of unregistered photos above which other focals are tried, and number of photos above which they are not."""
MIN_CONTRADICTED_SHARE = 0.05
"""Share of the inliers of fundamental matrices that contradict a model, above which a rival is tried. Right models of
the Strecha sets, cropped and squeezed, have 0.1 to 3 %."""


def rival_reason(model: Attempt | None, intrinsics: Intrinsics, matches: MatchGraph, views: ViewGraph) -> str:
    """Return why a rival is worth trying, in a few words; empty where the evidence is good.

    Args:
        model: the main model so far.
        intrinsics: cameras from pairs.
        matches: all photos.
        views: fundamental matrices.
    """
    if model is None:
        return "no photo was placed"
    refused = {intrinsics.camera_name(image) for image in matches.images.values()} - {
        name for name, camera in intrinsics.cameras.items() if camera.is_estimated
    }
    if refused:
        return "the pairs do not determine a camera"
    connected = connected_photos(views.fits)
    if are_worth_another_try(len(connected) - model.photos, len(connected)):
        return f"photos that match others have no place: {len(connected) - model.photos}"
    inliers = sum(pair.inliers for pair in model.explained.values())
    against = sum(pair.contradicted for pair in model.explained.values())
    return (
        f"{100 * against / inliers:.0f} % of the matches contradict it"
        if against > MIN_CONTRADICTED_SHARE * inliers
        else ""
    )


def connected_photos(fits: Mapping[PairId, EpipolarFit]) -> set[int]:
    """Collect the photos of pairs whose geometry is not degenerate."""
    return {photo for pair, fit in fits.items() if not fit.degeneracy for photo in pair}


def map_baseline(matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, run: RunContext) -> Attempt | NoModel:
    """Map all photos with COLMAP's own pipeline, and score the model like any other.

    Pairs that are not among the matches, such as those of look-alikes, are removed from its database, too.

    Args:
        matches: keypoints and raw matches.
        views: fundamental matrices.
        intrinsics: cameras from pairs; only those with a focal from EXIF or from the user are used.
        run: the run.
    """
    scratch = run.workspace.root / FOLDER
    found: list[Reconstruction | None] = []
    guess = guessed_intrinsics(intrinsics)
    try:
        with translate_errors("mapping photos by its defaults"):
            copy_database(run.workspace.database, scratch)
            write_calibrations(scratch / "database.db", matches, guess)
            keep_raw_matches(scratch / "database.db", matches.matches)
            run_interruptible(
                lambda token: found.append(map_with_colmap_defaults(run.workspace.photos, scratch, run.seed, token)),
                lambda: None,
            )
    except BackendError as err:  # our own model is not lost with it
        logger.info("the rival failed: %s", err)
        return NoModel(MAPPER, f"{NOTE}: failed, {err}")
    return judge_model(matches, views, (MAPPER, NOTE), found[0], run)


def has_many_unplaced(model: Attempt | None, intrinsics: Intrinsics, views: ViewGraph) -> bool:
    """Return whether a wrong guess of the focal may be why photos that match others are unregistered.

    This is not so where any camera is known. Where there are many photos, a pass costs more than it promises.

    Args:
        model: the main model, if there is one.
        intrinsics: cameras from pairs.
        views: fundamental matrices.
    """
    connected = connected_photos(views.fits)
    known = any(camera.is_estimated or camera.method == "exif" for camera in intrinsics.cameras.values())
    placed = model.photos if model is not None else 0
    return (
        not known
        and len(connected) <= MOST_PHOTOS_FOR_DEFAULTS
        and len(connected) - placed > MIN_UNPLACED_SHARE * len(connected)
    )


def guessed_intrinsics(intrinsics: Intrinsics, sides: float = GUESSED_FOCAL) -> Intrinsics:
    """Replace every perspective camera by a guess, except those with a focal from EXIF, or that the user gave.

    With a perspective camera, COLMAP cannot place photos of a fisheye lens.

    Args:
        intrinsics: cameras from pairs.
        sides: guess of the focal, in longer sides of the photo.
    """
    cameras = {
        name: _guess_by_sides(camera, sides) if camera.projection == PERSPECTIVE and not is_told(camera) else camera
        for name, camera in intrinsics.cameras.items()
    }
    return replace(intrinsics, cameras=cameras)


def is_told(camera: Calibration) -> bool:
    """Return whether the focal comes from EXIF or from the user."""
    return camera.method == "exif" or camera.is_given


def _guess_by_sides(camera: Calibration, sides: float) -> Calibration:
    size = camera.width, camera.height
    K = guessed_camera_matrix(size, sides * max(size))
    return Calibration(K, *size, "guess", identifiable=False, reason=camera.reason)


# One camera for each photo, as a rival hypothesis: a zoom, or several devices, that the pairs do not reveal.
#
# Photos of one size count as one camera until their pairs contradict that. Pairs of a camera that moves forward or
# round one point never do. A model does: with one focal for all photos, it contradicts matches that are right pair
# by pair.

MIN_PHOTOS, MOST_PHOTOS_FOR_OWN_CAMERAS = 5, 100
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
        not MIN_PHOTOS <= max(model.photos, len(connected_photos(views.fits))) <= MOST_PHOTOS_FOR_OWN_CAMERAS
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
            cameras[own], camera_of[image.name] = _guess_of_photo(camera, usual.get(name)), own
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


def _guess_of_photo(camera: Calibration, focal_px: float | None) -> Calibration:
    size = camera.width, camera.height
    K = guessed_camera_matrix(size, camera.focal_px if focal_px is None else focal_px)
    return Calibration(K, *size, "guess", identifiable=False, reason="its photos may each be of another camera")
