"""The last bundle adjustment: refines cameras, poses, points and tracks until they no longer change."""

import logging
from dataclasses import dataclass, field
from pathlib import Path

from sfm_app.bundle_adjustment.lens_parts import part_names
from sfm_app.colmap.backend import pycolmap, translate_errors
from sfm_app.colmap.bundle_arrays import (
    FILE_MODELS,
    PLACES,
    camera_family,
    file_model,
    photos_per_camera,
    read_camera,
    write_camera,
)
from sfm_app.colmap.bundle_rounds import Rounds, adjust_in_rounds
from sfm_app.colmap.database import open_database
from sfm_app.colmap.lens_choice import LensRecord, best_families, record_lenses
from sfm_app.colmap.model import finite_mask
from sfm_app.colmap.types import all_cameras, all_points
from sfm_app.numerical import FAILURES, error_reason, finite_entries

logger = logging.getLogger("sfm_app")


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The refined model, and the uncertainty of its cameras."""

    model: pycolmap.Reconstruction
    deviations: dict[int, dict[str, float]]
    """Standard deviations by camera id, as in `CameraModel`."""
    determined: dict[int, tuple[str, ...]]
    """Parameters that the photos determine, by camera id, as in `CameraModel`."""
    failure: str = ""
    """Why the adjustment failed, empty where it did not; the model is then the given one, without deviations."""
    held: tuple[int, ...] = ()
    """Ids of cameras whose estimate diverged; they keep their parameters."""
    open_points: int = 0
    """Points that their rays did not determine when the adjustment began."""
    lenses: dict[int, LensRecord] = field(default_factory=dict)
    """The chosen camera model and its rivals, by camera id; empty where the adjustment failed."""


def adjust(model: pycolmap.Reconstruction, database: Path) -> Adjustment:
    """Refine cameras, poses, points and tracks in turn; only camera parameters that the photos determine are freed.

    In each round, poses and points are eliminated, and the likelihood of the cameras is weighed against their priors.
    The cameras make the resulting step. Poses and points follow linearly; after a long step COLMAP's solver refines
    them. Then tracks are completed and filtered.

    Args:
        model: result of mapping; not changed.
        database: has all keypoints and matches.

    Raises:
        NumericalError: the adjustment diverges; the given model is unchanged.
    """
    model = pycolmap.Reconstruction(model)
    for camera in all_cameras(model):
        write_camera(camera, read_camera(camera), camera_family(camera))
    drop_infinite_points(model)
    graph = _correspondences(model, database)
    rounds = adjust_in_rounds(model, graph)
    open_points = rounds.open_points
    families = best_families(model, rounds)
    if families.model is not model:
        model = families.model
        rounds = adjust_in_rounds(model, graph)
    model.update_point_3d_errors()
    held = tuple(camera_id for camera_id, away in zip(rounds.ids, rounds.found.held, strict=True) if away)
    lenses = record_lenses(model, rounds, families.rivals)
    return Adjustment(model, *_summary(rounds), held=held, open_points=open_points, lenses=lenses)


def adjust_or_keep(model: pycolmap.Reconstruction, database: Path) -> Adjustment:
    """Adjust a model; where that fails numerically, return the given model with the reason.

    Args:
        model, database: as in `adjust`.

    Raises:
        BackendError: COLMAP failed.
    """
    try:
        with translate_errors("adjusting the bundle"):
            return adjust(model, database)
    except FAILURES as err:
        logger.info("the last adjustment failed", exc_info=err)
        nothing: dict[int, dict[str, float]] = {camera_id: {} for camera_id in photos_per_camera(model)}
        return Adjustment(model, nothing, dict.fromkeys(nothing, ()), failure=error_reason(err))


def drop_infinite_points(model: pycolmap.Reconstruction) -> None:
    """Remove points at infinity, in place."""
    for point_id in [key for key, point in all_points(model) if not finite_mask(point.xyz)]:
        model.delete_point3D(point_id)


def _correspondences(model: pycolmap.Reconstruction, database: Path) -> pycolmap.CorrespondenceGraph:
    options = pycolmap.DatabaseCacheOptions()
    options.load_all_images = True  # else photos that no pair in the database connects would be missing
    options.image_names = {model.images[image_id].name for image_id in model.reg_image_ids()}
    with open_database(database) as db:
        return pycolmap.DatabaseCache.create(db, options).correspondence_graph


def _summary(rounds: Rounds) -> tuple[dict[int, dict[str, float]], dict[int, tuple[str, ...]]]:
    """Return deviations and determined parameters of `Adjustment`."""
    deviations: dict[int, dict[str, float]] = {}
    determined: dict[int, tuple[str, ...]] = {}
    for row, camera_id in enumerate(rounds.ids):
        family = int(rounds.bundle.family[row])
        determined[camera_id] = part_names(family, rounds.found.determined[row])
        deviations[camera_id] = {}
        if family in FILE_MODELS:
            keys = FILE_MODELS[family][file_model(rounds.found.params[row], family)]
            values = rounds.found.deviations[row]
            deviations[camera_id] = finite_entries({key: float(values[PLACES[key][0]]) for key in keys})
    return deviations, determined
