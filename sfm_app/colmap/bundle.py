"""The last bundle adjustment: refines cameras, poses, points and tracks until they no longer change."""

import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sfm_app.bundle_adjustment.camera_rules import calibration_from_params, fit_to_model, params_of_calibration
from sfm_app.bundle_adjustment.lens_family import convert_lens
from sfm_app.bundle_adjustment.lens_parts import part_names
from sfm_app.colmap.backend import pycolmap, translate_errors
from sfm_app.colmap.bundles.bundle_arrays import (
    FILE_MODELS,
    NO_RULES,
    PLACES,
    Rules,
    camera_family,
    file_model,
    photos_per_camera,
    read_camera,
    write_camera,
)
from sfm_app.colmap.bundles.bundle_rounds import Rounds, adjust_in_rounds, solve
from sfm_app.colmap.bundles.lens_choice import Families, LensRecord, best_families, record_lenses
from sfm_app.colmap.database import open_database
from sfm_app.colmap.models.model import finite_mask
from sfm_app.colmap.types import all_cameras, all_points
from sfm_app.geometry.lenses.projections import FX, FY, PANORAMA
from sfm_app.numerical import FAILURES, error_reason, finite_entries
from sfm_app.types import Calibration
from sfm_app.types.correlations import named_correlations

logger = logging.getLogger("sfm_app")


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The refined model, and the uncertainty of its cameras."""

    model: pycolmap.Reconstruction
    deviations: dict[int, dict[str, float]]
    """Standard deviations by camera id, as in `CameraModel`."""
    determined: dict[int, tuple[str, ...]]
    """Parameters that the photos determine, by camera id, as in `CameraModel`."""
    correlations: dict[int, dict[str, float]] = field(default_factory=dict)
    """Correlations of parameters by camera id, as in `CameraModel`; lacks cameras without any."""
    failure: str = ""
    """Why the adjustment failed, empty where it did not; the model is then the given one, without deviations."""
    held: tuple[int, ...] = ()
    """Ids of cameras whose estimate diverged; they keep their parameters."""
    open_points: int = 0
    """Points that their rays did not determine when the adjustment began."""
    lenses: dict[int, LensRecord] = field(default_factory=dict)
    """The chosen camera model and its rivals, by camera id; empty where the adjustment failed."""
    estimates: dict[int, Calibration] = field(default_factory=dict)
    """What the photos say of the cameras that the user gave, by camera id; lacks those that they do not determine."""


def adjust(
    model: pycolmap.Reconstruction, database: Path, rules: Rules = NO_RULES, *, settled: bool = False
) -> Adjustment:
    """Refine cameras, poses, points and tracks in turn; only camera parameters that the photos determine are freed.

    In each round, poses and points are eliminated, and the likelihood of the cameras is weighed against their priors.
    The cameras make the resulting step. Poses and points follow linearly; after a long step COLMAP's solver refines
    them. Then tracks are completed and filtered.

    Args:
        model: result of mapping; not changed.
        database: has all keypoints and matches.
        rules: what the user laid down about cameras, by id.
        settled: whether an adjustment of most of these photos has chosen between fisheye and perspective lenses.

    Raises:
        NumericalError: the adjustment diverges; the given model is unchanged.
    """
    model = pycolmap.Reconstruction(model)
    for camera in all_cameras(model):
        write_camera(camera, read_camera(camera), camera_family(camera))
    if rules:
        apply_rules(model, rules)
    drop_infinite_points(model)
    graph = find_correspondences(model, database)
    rounds = adjust_in_rounds(model, graph, rules)
    open_points = rounds.open_points
    families = Families(model) if settled else best_families(model, rounds, rules)
    if families.model is not model:
        model = families.model
        rounds = adjust_in_rounds(model, graph, rules)
    model.update_point_3d_errors()
    held = tuple(camera_id for camera_id, away in zip(rounds.ids, rounds.found.held, strict=True) if away)
    lenses = record_lenses(model, rounds, families.rivals)
    estimates = given_estimates(model, rounds, rules)
    return Adjustment(
        model, *_summary(rounds), _correlations(rounds), held=held, open_points=open_points, lenses=lenses,
        estimates=estimates,
    )  # fmt: skip


def adjust_or_keep(
    model: pycolmap.Reconstruction, database: Path, rules: Rules = NO_RULES, *, settled: bool = False
) -> Adjustment:
    """Adjust a model; where that fails numerically, return the given model with the reason.

    Args:
        model, database, rules, settled: as in `adjust`.

    Raises:
        BackendError: COLMAP failed.
    """
    try:
        with translate_errors("adjusting the bundle"):
            return adjust(model, database, rules, settled=settled)
    except FAILURES as err:
        logger.info("the last adjustment failed", exc_info=err)
        nothing: dict[int, dict[str, float]] = {camera_id: {} for camera_id in photos_per_camera(model)}
        return Adjustment(model, nothing, dict.fromkeys(nothing, ()), failure=error_reason(err))


def drop_infinite_points(model: pycolmap.Reconstruction) -> None:
    """Remove points at infinity, in place."""
    for point_id in [key for key, point in all_points(model) if not finite_mask(point.xyz)]:
        model.delete_point3D(point_id)


def find_correspondences(model: pycolmap.Reconstruction, database: Path) -> pycolmap.CorrespondenceGraph:
    """Return the graph of all matches between the photos of a model.

    Args:
        model: COLMAP's reconstruction.
        database: has all keypoints and matches.
    """
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
        determined[camera_id] = part_names(int(rounds.bundle.family[row]), rounds.found.determined[row])
        values = rounds.found.deviations[row]
        entries = {key: float(values[PLACES[key][0]]) for key in _adjusted_names(rounds, row)}
        deviations[camera_id] = finite_entries(entries)
    return deviations, determined


def _correlations(rounds: Rounds) -> dict[int, dict[str, float]]:
    """Return the correlations of `Adjustment`."""
    found = {}
    for row, camera_id in enumerate(rounds.ids):
        names = _adjusted_names(rounds, row)
        places = [PLACES[name][0] for name in names]
        found[camera_id] = named_correlations(names, rounds.found.mean_squares[row][np.ix_(places, places)])
    return found


def _adjusted_names(rounds: Rounds, row: int) -> tuple[str, ...]:
    """Return COLMAP's names of the parameters of a camera that were adjusted; none of a panorama or a fixed camera."""
    family = int(rounds.bundle.family[row])
    is_fixed = rounds.bundle.fixed is not None and bool(rounds.bundle.fixed[row])
    if family not in FILE_MODELS or is_fixed:
        return ()
    return tuple(FILE_MODELS[family][file_model(rounds.found.params[row], family)])


def apply_rules(model: pycolmap.Reconstruction, rules: Rules) -> None:
    """Give cameras the values or the model that the user laid down, in place, and adjust poses and points to them.

    Mapping may have changed a camera that is kept, and may have used another model.

    Args:
        model: as mapping left it, with cameras of FILE_MODELS.
        rules: by camera id.
    """
    changed = False
    for camera_id, rule in rules.items():
        camera = model.cameras[camera_id]
        family, before = camera_family(camera), read_camera(camera)
        params, wanted = before, family if rule.family is None else rule.family
        if PANORAMA in (family, wanted):
            continue
        if rule.given is not None and rule.kept:
            params = params_of_calibration(rule.given)
        elif wanted != family:
            reach = np.hypot(camera.width, camera.height) / (2.0 * np.sqrt(before[FX] * before[FY]))
            other = convert_lens(before, family, float(reach))
            params, wanted = (before, family) if other is None else (other, wanted)
        parts = None if rule.kept else rule.parts(wanted)
        if parts is not None:
            params = fit_to_model(params, parts, wanted)
        changed = changed or wanted != family or not np.array_equal(params, before)
        write_camera(camera, params, wanted)
    if changed:
        solve(model)


def given_estimates(model: pycolmap.Reconstruction, rounds: Rounds, rules: Rules) -> dict[int, Calibration]:
    """Return what the photos say of the cameras that the user gave, by id; not of those that they do not determine.

    Where one is kept, everything is adjusted once more with free cameras, to the same tracks.

    Args:
        model: adjusted.
        rounds: the last rounds of its adjustment.
        rules: by camera id.
    """
    if all(rule.given is None for rule in rules.values()):
        return {}
    if any(rule.kept for rule in rules.values()):
        try:
            rounds = adjust_in_rounds(pycolmap.Reconstruction(model), None)
        except FAILURES as err:
            logger.info("the given cameras could not be checked", exc_info=err)
            return {}
    estimates, found = {}, rounds.found
    for row, camera_id in enumerate(rounds.ids):
        family = int(rounds.bundle.family[row])
        if camera_id not in rules or rules[camera_id].given is None or found.held[row] or family == PANORAMA:
            continue
        camera = model.cameras[camera_id]
        determined = part_names(family, found.determined[row])
        estimates[camera_id] = calibration_from_params(
            found.params[row], family, (camera.width, camera.height), found.deviations[row], determined
        )
    return estimates
