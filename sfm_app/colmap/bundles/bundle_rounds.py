"""Rounds of the last bundle adjustment: a step of everything, then tracks are completed and filtered."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm_app.bundle_adjustment.camera_rules import NO_RULE, CameraRule, choices_of_model
from sfm_app.bundle_adjustment.elimination_width import elimination_width
from sfm_app.bundle_adjustment.lens_evidence import LensEstimate, estimate_lenses
from sfm_app.bundle_adjustment.lens_parts import COUNT, PARTS, LensPriors, consistent_choices
from sfm_app.bundle_adjustment.normal_equations import Bundle, best_step, reduce
from sfm_app.colmap.backend import pycolmap, run_in_daemon_thread
from sfm_app.colmap.bundles.bundle_arrays import NO_RULES, Rules, photos_per_camera, read_bundle, write_bundle
from sfm_app.colmap.types import all_points
from sfm_app.errors import NumericalError
from sfm_app.geometry.lenses.projections import FX, FY, PANORAMA

MIN_PHOTOS = 5
"""Photos of a camera below which only its focal and k1 are refined: with fewer, effects that the camera model leaves
out (a lens, a zoom) change its parameters more than the noise does."""

LOSS_SCALE_PX = 0.5
"""Scale of COLMAP's SOFT_L1 loss: about twice the noise of SIFT keypoints. Poses are better than with COLMAP's 1."""

MAX_ERROR_PX, MIN_ANGLE_DEG = 4.0, 1.5
"""COLMAP's own limits for a point: largest reprojection error, least angle between its rays."""

ROUNDS, CHANGED_SHARE, STEP = 6, 0.0005, 0.2
"""Largest number of rounds. They end early when less than this share of the observations changes, and no camera
parameter by more than this share of its standard deviation."""

MIN_KEPT_SHARE = 0.1
"""Smallest share of the points that an adjustment must keep; one that drops more has diverged and is rejected. Chosen
on no set; none of six that were run fell below it."""

LONG_STEP = 1.0
"""Step of the cameras, in standard deviations, above which the linear step of poses and points is too inaccurate and
COLMAP's solver refines them."""

MOST_TIED = 250
"""Photos that a photo is tied to (`elimination_width`) above which COLMAP's solver takes conjugate gradients. Where all
see the same, a factorization grows with the cube of the photos: on every 5th photo of kitchen1000 (200) they take half
as long to the same cost. Along streets they take five times as long as a factorization (250 photos of a town)."""


@dataclass(frozen=True, slots=True, eq=False)
class Rounds:
    """What the last of some rounds found; its step is in the model."""

    ids: list[int]
    """Ids of the cameras, in the order of the arrays."""
    bundle: Bundle
    """Before the last step."""
    found: LensEstimate
    noise_px: float
    """As in `ReducedSystem`."""
    open_points: int
    """Points that their rays did not determine when the rounds began."""


def adjust_in_rounds(
    model: pycolmap.Reconstruction, graph: pycolmap.CorrespondenceGraph | None, rules: Rules = NO_RULES
) -> Rounds:
    """Refine cameras, poses, points and tracks of a model in place, until they no longer change.

    Args:
        model: COLMAP's reconstruction, with cameras of FILE_MODELS.
        graph: of all matches; None to keep the tracks.
        rules: of some cameras, by id.

    Raises:
        NumericalError: the adjustment diverges.
    """
    points, open_points = model.num_points3D(), []
    for _ in range(ROUNDS):
        ids, bundle = read_bundle(model, rules)
        if not (np.isfinite(bundle.params).all() and (bundle.params[:, [FX, FY]] > 0).all()):
            raise NumericalError("a camera has no focal length")
        reduced = reduce(bundle, LOSS_SCALE_PX)
        open_points.append(reduced.open_points)
        found = estimate_lenses(bundle.params, reduced, lens_priors(model, ids, bundle, rules))
        write_bundle(model, ids, best_step(bundle, reduced, found.params, LOSS_SCALE_PX))
        if found.step > LONG_STEP:
            solve(model)
        changed = improve_tracks(model, graph) if graph else 0
        if model.num_points3D() <= MIN_KEPT_SHARE * points:
            raise NumericalError(f"it left {model.num_points3D()} of {points} points")
        if found.step < STEP and changed < CHANGED_SHARE * len(bundle.x):
            break
    return Rounds(ids, bundle, found, reduced.noise_px, open_points[0])


def solve(model: pycolmap.Reconstruction, refined: Collection[int] = ()) -> None:
    """Adjust poses and points in place, on one thread: the order of sums over several threads is not fixed.

    Args:
        model: COLMAP's reconstruction.
        refined: ids of the cameras whose focal is adjusted, too.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = LOSS_SCALE_PX
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-5
    options.ceres.solver_options.num_threads = 1
    options.ceres.max_num_images_direct_sparse_cpu_solver = _choose_most_factored(model)
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    options.refine_principal_point = options.refine_extra_params = False
    for camera_id in sorted(photos_per_camera(model).keys() - set(refined)):
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    run_in_daemon_thread(pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve)


def _choose_most_factored(model: pycolmap.Reconstruction) -> int:
    """Return up to how many photos COLMAP's solver is to factor the normal equations: all photos, or `MOST_TIED`."""
    photos = sorted(model.reg_image_ids())
    if len(photos) <= MOST_TIED:
        return MOST_TIED
    rows = {photo: row for row, photo in enumerate(photos)}
    seen = [(rows[one.image_id], k) for k, (_, point) in enumerate(all_points(model)) for one in point.track.elements]
    photo, point = np.array(seen, np.int64).reshape(-1, 2).T
    return len(photos) if elimination_width(photo, point) <= MOST_TIED else MOST_TIED


def improve_tracks(model: pycolmap.Reconstruction, graph: pycolmap.CorrespondenceGraph) -> int:
    """Continue, merge and triangulate tracks, filter them, and return by how many observations their number changed.

    Observations that are added and filtered again do not count: near the limits they come and go forever.

    Args:
        model: changed in place.
        graph: of all matches.
    """
    before = model.compute_num_observations()
    observations = pycolmap.ObservationManager(model, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, model, observations)
    options = pycolmap.IncrementalTriangulatorOptions()
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    triangulator.retriangulate(options)
    observations.filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)
    return abs(int(model.compute_num_observations() - before))


def lens_priors(model: pycolmap.Reconstruction, ids: list[int], bundle: Bundle, rules: Rules = NO_RULES) -> LensPriors:
    """Return the priors of the cameras, before any evidence from the bundle.

    Args:
        model: has the photos and their sizes.
        ids, bundle: from `read_bundle`.
        rules: of some cameras, by id.
    """
    used = photos_per_camera(model)
    sizes = np.array([(model.cameras[camera_id].width, model.cameras[camera_id].height) for camera_id in ids], float)
    many = np.array([used[camera_id] >= MIN_PHOTOS for camera_id in ids])
    only_k1 = [[part.name == "k1" for part in PARTS[int(kind)]] for kind in bundle.family]
    asked = (many[:, None] | np.array(only_k1).reshape(-1, COUNT)) & (bundle.family != PANORAMA)[:, None]
    priors = LensPriors.from_cameras(bundle.params, bundle.family, sizes, asked)
    return _apply_rules(priors, [rules.get(camera_id, NO_RULE) for camera_id in ids]) if rules else priors


def _apply_rules(priors: LensPriors, rules: Sequence[CameraRule]) -> LensPriors:
    """Return the priors with what the user laid down about each camera."""
    asked, usual, choices = priors.asked.copy(), priors.usual.copy(), list(priors.choices)
    for row, rule in enumerate(rules):
        family = int(priors.family[row])
        given, parts = rule.usual(family), rule.parts(family)
        if given is not None:
            usual[row] = given
        if rule.kept:
            asked[row] = False
            choices[row] = priors.choices[row][:1]
        elif parts is not None:
            choices[row] = choices_of_model(parts, consistent_choices(family))
            asked[row] = choices[row].any(axis=0)
    fixed = np.array([rule.kept for rule in rules], np.bool_)
    return replace(priors, asked=asked, usual=usual, choices=tuple(choices), fixed=fixed)
