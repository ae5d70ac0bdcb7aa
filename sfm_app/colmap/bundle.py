"""The last bundle adjustment: everything that the photos determine is set free."""

from pathlib import Path
from typing import Any

import numpy as np

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import SQUARE_PIXELS, TWO_FOCALS, camera_params, opened

LADDER = ((TWO_FOCALS, True), (SQUARE_PIXELS, True), (TWO_FOCALS, False), (SQUARE_PIXELS, False))
"""Camera model and whether its optical centre is free, from the most to the least that is left to the photos."""

FOCAL_DETERMINED, CENTRE_DETERMINED = 0.002, 0.003
"""Largest standard deviation that counts as determined: of a focal as a share of it, of the centre in longer sides."""

PHOTOS_FOR_CENTRE = 5
"""With fewer photos, what the camera model does not hold (a lens, a zoom) moves the centre more than the noise does."""

MAX_ERROR_PX, MIN_ANGLE_DEG = 4.0, 1.5
"""COLMAP's own limits for a point: largest reprojection error, least angle between its rays."""


def adjust(model: Any, database: Path) -> tuple[Any, dict[str, float]]:
    """Refine poses, points and cameras; of the cameras as much as the photos determine.

    Freeing what they do not determine makes narrow views and small sets worse, so the covariance is asked first, going
    down the ladder until it agrees. Observations that fit badly are then dropped, and the same is refined again.

    Returns:
        The refined model, and the standard deviations in pixels of fx, fy, cx, cy of the camera with most photos, as
        far as they were free.
    """
    few = model.num_reg_images() < PHOTOS_FOR_CENTRE
    for camera_model, centre in LADDER:
        if (camera_model == SQUARE_PIXELS and not _square(model)) or (centre and few):
            continue
        freed = pycolmap.Reconstruction(model)
        for camera in freed.cameras.values():
            _become(camera, camera_model)
        deviations = _solve(freed, centre=centre)
        if _determined(freed, deviations) or (camera_model, centre) == LADDER[-1]:
            break
    _drop_misfits(freed, database)
    return freed, _solve(freed, centre=centre)


def _solve(model: Any, *, centre: bool) -> dict[str, float]:
    """Adjust the model in place; standard deviations of its main camera's parameters, empty where they are infinite."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_principal_point = centre
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.max_num_iterations = 50
    options.ceres.solver_options.function_tolerance = 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, model)
    adjuster.solve()
    model.update_point_3d_errors()
    settings = pycolmap.BACovarianceOptions()
    settings.params = pycolmap.BACovarianceOptionsParams.ALL
    covariance = pycolmap.estimate_ba_covariance(settings, model, adjuster)
    camera = main_camera(model)
    found = covariance.get_other_params_cov(camera.params) if covariance else None
    if found is None:
        return {}
    # COLMAP's covariance is that of measurements off by 1 px
    deviations = np.sqrt(np.diag(found)) * model.compute_mean_reprojection_error()
    focals = ("fx", "fy") if len(camera.focal_length_idxs()) == 2 else ("f",)
    return dict(zip((*focals, "cx", "cy") if centre else focals, deviations.tolist(), strict=False))


def _determined(model: Any, deviations: dict[str, float]) -> bool:
    camera = main_camera(model)
    limits = {
        "f": FOCAL_DETERMINED * camera.mean_focal_length(),
        "c": CENTRE_DETERMINED * max(camera.width, camera.height),
    }
    return bool(deviations) and all(value < limits[name[0]] for name, value in deviations.items())


def _drop_misfits(model: Any, database: Path) -> None:
    options = pycolmap.DatabaseCacheOptions()
    options.image_names = {model.images[image_id].name for image_id in model.reg_image_ids()}
    with opened(database) as db:
        cache = pycolmap.DatabaseCache.create(db, options)
    pycolmap.ObservationManager(model, cache.correspondence_graph).filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)


def _become(camera: Any, camera_model: str) -> None:
    """Change the camera model in place; both models share the first radial term."""
    if camera.model.name != camera_model:
        K, radial = camera.calibration_matrix(), float(camera.params[camera.extra_params_idxs()[0]])
        camera.model = getattr(pycolmap.CameraModelId, camera_model)
        camera.params = camera_params(K, camera_model, radial)


def _square(model: Any) -> bool:
    return all(camera.model.name == SQUARE_PIXELS for camera in model.cameras.values())


def main_camera(model: Any) -> Any:
    """The camera that took most of the photos that have a pose."""
    used = [model.images[image_id].camera_id for image_id in model.reg_image_ids()]
    return model.cameras[max(set(used), key=lambda camera_id: (used.count(camera_id), -camera_id))]
