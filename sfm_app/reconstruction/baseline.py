"""Rival hypotheses: other models that are tried where the evidence for ours is weak.

Cameras that the pairs do not determine, unregistered photos and contradicting matches are signs that another start may
explain more. The rival is COLMAP's own pipeline, with the usual guess of the camera and its own verification of the
matches. It uses none of our fundamental matrices, cameras and poses, and so shares none of their errors.
"""

import logging
from collections.abc import Mapping
from dataclasses import replace

from sfm_app.colmap.backend import run_interruptible, translate_errors
from sfm_app.colmap.database import keep_raw_matches, write_calibrations
from sfm_app.colmap.mapping import copy_database, map_with_colmap_defaults
from sfm_app.colmap.types import Reconstruction
from sfm_app.errors import BackendError
from sfm_app.geometry.camera import GUESSED_FOCAL, guessed_camera_matrix
from sfm_app.reconstruction.mapping_runs import Attempt, NoModel, judge_model
from sfm_app.reconstruction.unregistered import are_worth_another_try
from sfm_app.runtime.context import RunContext
from sfm_app.types import Calibration, Intrinsics, MatchGraph, PairId, ViewGraph
from sfm_app.types.calibration import PERSPECTIVE
from sfm_app.types.epipolar import EpipolarFit

logger = logging.getLogger("sfm_app")

FOLDER = "rival"
MAPPER, NOTE = "colmap", "as COLMAP does by itself"
MIN_UNPLACED_SHARE, MAX_PHOTOS = 0.25, 60
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
    return not known and len(connected) <= MAX_PHOTOS and len(connected) - placed > MIN_UNPLACED_SHARE * len(connected)


def guessed_intrinsics(intrinsics: Intrinsics, sides: float = GUESSED_FOCAL) -> Intrinsics:
    """Replace every perspective camera by a guess, except those with a focal from EXIF, or that the user gave.

    With a perspective camera, COLMAP cannot place photos of a fisheye lens.

    Args:
        intrinsics: cameras from pairs.
        sides: guess of the focal, in longer sides of the photo.
    """
    cameras = {
        name: _guess(camera, sides) if camera.projection == PERSPECTIVE and not is_told(camera) else camera
        for name, camera in intrinsics.cameras.items()
    }
    return replace(intrinsics, cameras=cameras)


def is_told(camera: Calibration) -> bool:
    """Return whether the focal comes from EXIF or from the user."""
    return camera.method == "exif" or camera.is_given


def _guess(camera: Calibration, sides: float) -> Calibration:
    size = camera.width, camera.height
    K = guessed_camera_matrix(size, sides * max(size))
    return Calibration(K, *size, "guess", identifiable=False, reason=camera.reason)
