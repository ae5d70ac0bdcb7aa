"""The last bundle adjustment: refines cameras, poses, points and tracks until they no longer change."""

import logging
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sfm_app.bundle_adjustment.lens_evidence import PARTS, LensEstimate, LensPriors, estimate_lenses
from sfm_app.bundle_adjustment.normal_equations import (
    FX,
    FY,
    POSE,
    Bundle,
    ReducedSystem,
    apply_step,
    cost,
    lost_points,
    reduce,
)
from sfm_app.colmap.backend import pycolmap, run_in_daemon_thread, translate_errors
from sfm_app.colmap.database import TWO_FOCALS, camera_params, open_database
from sfm_app.colmap.model import finite_mask
from sfm_app.colmap.types import all_cameras, all_points
from sfm_app.errors import NumericalError
from sfm_app.numerical import FAILURES, error_reason, finite_entries

logger = logging.getLogger("sfm_app")

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
    model, points = pycolmap.Reconstruction(model), model.num_points3D()
    for camera in all_cameras(model):
        _generalize(camera)
    drop_infinite_points(model)
    graph = _correspondences(model, database)
    open_points = []
    for _ in range(ROUNDS):
        ids, bundle = read_bundle(model)
        if not (np.isfinite(bundle.params).all() and (bundle.params[:, [FX, FY]] > 0).all()):
            raise NumericalError("a camera has no focal length")
        reduced = reduce(bundle, LOSS_SCALE_PX)
        open_points.append(reduced.open_points)
        found = estimate_lenses(bundle.params, reduced, _lens_priors(model, ids))
        _write_bundle(model, ids, _best_step(bundle, reduced, found))
        if found.step > LONG_STEP:
            solve(model)
        changed = _improve_tracks(model, graph)
        if model.num_points3D() <= MIN_KEPT_SHARE * points:
            raise NumericalError(f"it left {model.num_points3D()} of {points} points")
        if found.step < STEP and changed < CHANGED_SHARE * len(bundle.x):
            break
    model.update_point_3d_errors()
    held = tuple(camera_id for camera_id, away in zip(ids, found.held, strict=True) if away)
    return Adjustment(model, *_summary(ids, found), held=held, open_points=open_points[0])


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


def solve(model: pycolmap.Reconstruction) -> None:
    """Adjust poses and points in place, on one thread: the order of sums over several threads is not fixed."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = LOSS_SCALE_PX
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-5
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in sorted(model.reg_image_ids()):
        config.add_image(image_id)
    for camera_id in photos_per_camera(model):
        config.set_constant_cam_intrinsics(camera_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    run_in_daemon_thread(pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve)


def _improve_tracks(model: pycolmap.Reconstruction, graph: pycolmap.CorrespondenceGraph) -> int:
    """Continue, merge and triangulate tracks, filter them, and return by how many observations their number changed.

    Observations that are added and filtered again do not count: near the limits they come and go forever.
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


def read_bundle(model: pycolmap.Reconstruction) -> tuple[list[int], Bundle]:
    """Return the ids of the cameras in use, and the model as arrays."""
    images = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    ids, points = sorted(photos_per_camera(model)), sorted(model.points3D)
    rows = {point: row for row, point in enumerate(points)}
    seen = [image.get_observation_points2D() for image in images]
    poses = np.array([image.cam_from_world().matrix() for image in images])
    return ids, Bundle(
        params=np.array([model.cameras[camera_id].params for camera_id in ids]),
        camera=np.array([ids.index(image.camera_id) for image in images]),
        R=poses[:, :, :3],
        t=poses[:, :, 3],
        X=np.array([model.points3D[point].xyz for point in points], np.float64).reshape(-1, 3),
        photo=np.repeat(np.arange(len(images)), [len(one) for one in seen]),
        point=np.array([rows[keypoint.point3D_id] for one in seen for keypoint in one], np.int64),
        x=np.array([keypoint.xy for one in seen for keypoint in one], np.float64).reshape(-1, 2),
    )


def _best_step(bundle: Bundle, reduced: ReducedSystem, found: LensEstimate) -> Bundle:
    """Return the bundle with the estimated cameras, and with poses and points moved if that does not raise the cost.

    A point that would move behind a camera stays: along an undetermined direction a linear step has no bound.
    """
    nowhere = np.zeros((len(bundle.R), POSE)), np.zeros_like(bundle.X)
    poses, points = reduced.back_substitute(found.params - bundle.params)
    tried = [apply_step(bundle, found.params, *nowhere)]
    if np.isfinite(poses).all():
        points[~np.isfinite(points).all(axis=1)] = 0.0
        points[lost_points(apply_step(bundle, found.params, poses, points)) & ~lost_points(bundle)] = 0.0
        tried.insert(0, apply_step(bundle, found.params, poses, points))
    return min(tried, key=lambda one: cost(one, LOSS_SCALE_PX))


def _write_bundle(model: pycolmap.Reconstruction, ids: list[int], bundle: Bundle) -> None:
    """Write arrays in the order of `read_bundle` into the model."""
    for camera_id, params in zip(ids, bundle.params, strict=True):
        model.cameras[camera_id].params = params.tolist()
    for image_id, R, t in zip(sorted(model.reg_image_ids()), bundle.R, bundle.t, strict=True):
        image = model.images[image_id]
        model.frames[image.frame_id].set_cam_from_world(image.camera_id, pycolmap.Rigid3d(pycolmap.Rotation3d(R), t))
    for point, xyz in zip(sorted(model.points3D), bundle.X, strict=True):
        model.points3D[point].xyz = xyz


def _lens_priors(model: pycolmap.Reconstruction, ids: list[int]) -> LensPriors:
    """Return the priors of the cameras, before any evidence from the bundle."""
    used = photos_per_camera(model)
    sizes = np.array([(model.cameras[camera_id].width, model.cameras[camera_id].height) for camera_id in ids], float)
    many = np.array([used[camera_id] >= MIN_PHOTOS for camera_id in ids])
    asked = many[:, None] | np.array([part.name == "k1" for part in PARTS])
    return LensPriors(sizes / 2, sizes.max(axis=1), asked)


def photos_per_camera(model: pycolmap.Reconstruction) -> Counter[int]:
    """Return the number of posed photos of each camera, by its id."""
    return Counter(model.images[image_id].camera_id for image_id in sorted(model.reg_image_ids()))


def _generalize(camera: pycolmap.Camera) -> None:
    """Change the camera in place to the model with all parameters that may be freed; keep its first radial term."""
    if camera.model.name != TWO_FOCALS:
        K, radial = camera.calibration_matrix(), float(camera.params[camera.extra_params_idxs()[0]])
        camera.model = pycolmap.CameraModelId.__members__[TWO_FOCALS]
        camera.params = camera_params(K, TWO_FOCALS, radial)


def _correspondences(model: pycolmap.Reconstruction, database: Path) -> pycolmap.CorrespondenceGraph:
    options = pycolmap.DatabaseCacheOptions()
    options.load_all_images = True  # else photos that no pair in the database connects would be missing
    options.image_names = {model.images[image_id].name for image_id in model.reg_image_ids()}
    with open_database(database) as db:
        return pycolmap.DatabaseCache.create(db, options).correspondence_graph


def _summary(ids: list[int], found: LensEstimate) -> tuple[dict[int, dict[str, float]], dict[int, tuple[str, ...]]]:
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    deviations = {
        camera_id: finite_entries(dict(zip(names, map(float, values), strict=True)))
        for camera_id, values in zip(ids, found.deviations, strict=True)
    }
    determined = {
        camera_id: tuple(part.name for part, on in zip(PARTS, row, strict=True) if on)
        for camera_id, row in zip(ids, found.determined, strict=True)
    }
    return deviations, determined
