"""Other hypotheses about the photos: COLMAP's defaults, one camera for each photo."""

import logging
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import chain, count

import numpy as np

from sfm_app.camera.models import GUESSED_FOCAL, guessed_camera_matrix
from sfm_app.colmap.backend import Reconstruction, run_interruptible, translate_errors
from sfm_app.colmap.database import keep_raw_matches, write_calibrations
from sfm_app.colmap.mapping import copy_database, map_with_colmap_defaults
from sfm_app.colmap.model import cameras_by_photo, posed_photo_ids
from sfm_app.errors import BackendError
from sfm_app.mapping.attempt import MAPPING, Attempt, NoModel, are_many_unregistered, judge_model
from sfm_app.runtime.context import RunContext
from sfm_app.settings import Settings
from sfm_app.types import Calibration, Intrinsics, MatchedImage, MatchGraph, PairId, ViewGraph
from sfm_app.types.camera import PERSPECTIVE
from sfm_app.types.evidence import EpipolarFit

# A rival where the evidence for our model is weak: COLMAP's default pipeline with the usual guess of the camera. It
# uses none of our fundamental matrices, cameras and poses, and so shares none of their errors.

logger = logging.getLogger("sfm_app")

FOLDER = "rival"
MAPPER, NOTE = "colmap", "COLMAP's default pipeline"


@dataclass(frozen=True, slots=True)
class HypothesisOptions:
    """When other hypotheses are tried, and accepted."""

    min_unregistered_share: float = 0.25
    """Share of unregistered photos above which other focals are tried. Chosen by hand."""
    max_photos_for_focals: int = 60
    """Photos above which no other focals are tried. Chosen by hand."""
    min_contradicted_share: float = 0.05
    """Share of contradicting inliers of F above which a rival is tried; right models have 0.1 to 3 %. Measured."""
    min_photos: int = 5
    """With fewer photos, a camera per photo fits almost anything. Chosen by hand."""
    max_photos: int = 100
    """With more photos, a pass costs more than it promises. Chosen by hand."""
    max_remaining_share: float = 0.5
    """Share of the contradictions that may remain with a camera per photo. Chosen on `benchmarks.trouble`."""
    share_tolerance: float = 0.002
    """Largest increase of the contradicted share by two cameras instead of one per photo. Chosen by hand."""


OPTIONS = HypothesisOptions()


def rival_reason(model: Attempt | None, intrinsics: Intrinsics, matches: MatchGraph, views: ViewGraph) -> str:
    """Return why a rival is worth trying, given the main model; empty where the evidence is good."""
    if model is None:
        return "no photo is registered"
    undetermined = {intrinsics.camera_name(image) for image in matches.images.values()} - {
        name for name, camera in intrinsics.cameras.items() if camera.is_estimated
    }
    if undetermined:
        return "the pairs do not determine a camera"
    connected = photos_with_geometry(views.fits)
    if are_many_unregistered(len(connected) - model.photos, len(connected)):
        return f"unregistered photos with matches: {len(connected) - model.photos}"
    inliers = sum(pair.inliers for pair in model.explained.values())
    against = sum(pair.contradicted for pair in model.explained.values())
    return (
        f"{100 * against / inliers:.0f} % of the matches contradict the model"
        if against > OPTIONS.min_contradicted_share * inliers
        else ""
    )


def photos_with_geometry(fits: Mapping[PairId, EpipolarFit]) -> set[int]:
    """Collect the photos of pairs whose geometry is not degenerate."""
    return {photo for pair, fit in fits.items() if not fit.degeneracy for photo in pair}


def map_baseline(matches: MatchGraph, views: ViewGraph, intrinsics: Intrinsics, run: RunContext) -> Attempt | NoModel:
    """Map the same matches with COLMAP's default pipeline and stated focals, and score the model like any other."""
    scratch = run.workspace.root / FOLDER
    models: list[Reconstruction | None] = []
    guess = guessed_intrinsics(intrinsics)
    try:
        with translate_errors("mapping photos with COLMAP's defaults"):
            copy_database(run.workspace.database, scratch)
            write_calibrations(scratch / "database.db", matches, guess)
            keep_raw_matches(scratch / "database.db", matches.matches)
            run_interruptible(
                lambda token: models.append(map_with_colmap_defaults(run.workspace.photos, scratch, run.seed, token)),
                lambda: None,
            )
    except BackendError as err:  # our own model is not lost with it
        logger.info("the rival failed: %s", err)
        return NoModel(MAPPER, f"{NOTE}: failed, {err}")
    return judge_model(matches, views, MAPPER, NOTE, models[0], run)


def is_focal_doubtful(model: Attempt | None, intrinsics: Intrinsics, views: ViewGraph) -> bool:
    """Return whether a wrong guess of the focal may be why photos that match others are unregistered."""
    connected = photos_with_geometry(views.fits)
    known = any(camera.is_estimated or camera.method == "exif" for camera in intrinsics.cameras.values())
    placed = model.photos if model is not None else 0
    return (
        not known
        and len(connected) <= OPTIONS.max_photos_for_focals
        and len(connected) - placed > OPTIONS.min_unregistered_share * len(connected)
    )


def guessed_intrinsics(intrinsics: Intrinsics, sides: float = GUESSED_FOCAL) -> Intrinsics:
    """Replace every perspective camera without a stated focal by a guess of `sides` longer sides."""
    cameras = {
        name: _guess(camera, sides * max(camera.width, camera.height), camera.reason)
        if camera.projection == PERSPECTIVE and camera.method != "exif" and not camera.is_given
        else camera
        for name, camera in intrinsics.cameras.items()
    }
    return replace(intrinsics, cameras=cameras)


# A camera per photo, for a zoom or several devices. Photos of one size share a camera until their pairs contradict
# that. Pairs of a camera that moves forward or round one point never do. A model does: with one focal, it contradicts
# matches that are right pair by pair.


def is_shared_camera_doubtful(
    model: Attempt | None, intrinsics: Intrinsics, views: ViewGraph, settings: Settings
) -> bool:
    """Return whether photos of one size may have a camera each: the model is contradicted, or lacks many photos."""
    if model is None or settings.photos.cameras != "auto":
        return False
    if (
        not OPTIONS.min_photos <= max(model.photos, len(photos_with_geometry(views.fits))) <= OPTIONS.max_photos
    ):  # pairs on a plane are not counted as fits
        return False
    return _contradicted_share(model) > MAPPING.max_contradicted_share or is_focal_doubtful(model, intrinsics, views)


def with_camera_per_photo(model: Attempt, shared: Intrinsics, matches: MatchGraph) -> Intrinsics | None:
    """Give each photo its own camera where pairs do not determine the shared one; None if there is none such."""
    focals = {photo: float(K[0, 0] * K[1, 1]) ** 0.5 for photo, (K, *_) in cameras_by_photo(model.model).items()}
    placed = posed_photo_ids(model.model)
    focal_of = {shared.camera_name(matches.images[photo]): focals[photo] for photo in placed if photo in focals}
    members: dict[str, list[MatchedImage]] = {}
    for image in matches.images.values():
        members.setdefault(shared.camera_name(image), []).append(image)
    divided = [name for name, images in members.items() if len(images) > 1 and not shared.cameras[name].identifiable]
    if not divided:
        return None
    cameras, camera_of = dict(shared.cameras), dict(shared.camera_of)
    for name in divided:
        camera = cameras.pop(name)
        focal_px, reason = focal_of.get(name, camera.focal_px), "its photos may each be of another camera"
        names = _free_names(name, {*shared.cameras, *cameras})
        for image, own in zip(sorted(members[name], key=lambda image: image.name), names, strict=False):
            cameras[own], camera_of[image.name] = _guess(camera, focal_px, reason), own
    return replace(shared, cameras=cameras, camera_of=camera_of)


def with_two_cameras(model: Attempt, each: Intrinsics, matches: MatchGraph) -> Intrinsics | None:
    """Replace the cameras of photos of one size by two, divided at the widest gap of focals; None if none can be."""
    of_size: dict[tuple[int, int], dict[str, float]] = {}
    for photo, (K, *_) in cameras_by_photo(model.model).items():
        name = each.camera_name(matches.images[photo])
        if not each.cameras[name].identifiable:
            size = each.cameras[name].width, each.cameras[name].height
            of_size.setdefault(size, {})[name] = float(K[0, 0] * K[1, 1]) ** 0.5
    cameras = dict(each.cameras)
    replacements: dict[str, str] = {}
    for size, focals in of_size.items():
        for group in _split_at_gap(focals):
            K = guessed_camera_matrix(size, float(np.median([focals[name] for name in group])))
            cameras[group[0]] = replace(cameras[group[0]], K=K, identifiable=True, reason="", method="mapping")
            replacements |= dict.fromkeys(group[1:], group[0])
    camera_of = {photo: replacements.get(name, name) for photo, name in each.camera_of.items()}
    used = {name: camera for name, camera in cameras.items() if name not in replacements}
    return replace(each, cameras=used, camera_of=camera_of) if replacements else None


def two_cameras_suffice(two: Attempt | None, own: Attempt) -> bool:
    """Return whether a model with two cameras explains the matches as well as one with a camera per photo."""
    if two is None or two.photos < own.photos or two.support < (1.0 - MAPPING.equal_tolerance) * own.support:
        return False
    return _contradicted_share(two) <= _contradicted_share(own) + OPTIONS.share_tolerance


def camera_per_photo_explains_more(own: Attempt | None, shared: Attempt) -> bool:
    """Return whether a camera per photo explains more matches, and registers more photos or removes contradictions."""
    if own is None or own.photos < shared.photos or own.support <= shared.support:
        return False
    return own.photos > shared.photos or _contradicted_share(own) <= OPTIONS.max_remaining_share * _contradicted_share(
        shared
    )


def _contradicted_share(model: Attempt) -> float:
    inliers = sum(pair.inliers for pair in model.explained.values())
    return sum(pair.contradicted for pair in model.explained.values()) / max(inliers, 1)


def _split_at_gap(focals: Mapping[str, float]) -> list[list[str]]:
    """Return names in two parts, divided at the widest gap between focals; empty if a part has only one name."""
    names = sorted(focals, key=lambda name: (focals[name], name))
    if len(names) < OPTIONS.min_photos:
        return []
    gap = int(np.argmax(np.diff(np.log([focals[name] for name in names])))) + 1
    return [names[:gap], names[gap:]] if 2 <= gap <= len(names) - 2 else []


def _free_names(name: str, taken: Collection[str]) -> Iterable[str]:
    """Return the name itself, then numbered variants of it that are not taken."""
    return chain([name], (other for number in count(2) if (other := f"{name} #{number}") not in taken))


def _guess(camera: Calibration, focal_px: float, reason: str) -> Calibration:
    size = camera.width, camera.height
    return Calibration(guessed_camera_matrix(size, focal_px), *size, "guess", identifiable=False, reason=reason)
