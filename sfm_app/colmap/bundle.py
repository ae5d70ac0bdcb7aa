"""The last bundle adjustment: everything that the photos determine is set free."""

from pathlib import Path
from typing import Any

import numpy as np

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import opened

DETERMINED = 0.01
"""An optical centre counts as determined when its standard deviation is below this share of the image's longer side."""

ROUNDS = 2
"""Adjust, drop what does not fit, adjust again."""

MAX_ERROR_PX, MIN_ANGLE_DEG = 4.0, 1.5
"""COLMAP's own limits for a point: largest reprojection error, least angle between its rays."""


def adjust(model: Any, database: Path) -> tuple[Any, dict[str, float]]:
    """Refine poses, points, focals and distortion; the optical centre too where the photos determine it.

    Freeing a centre that they do not determine makes narrow views worse, so its covariance is asked first.

    Returns:
        The refined model, and the standard deviations in pixels of fx, fy, cx, cy of the camera with most photos for
        measurements that are off by 1 px.
    """
    with opened(database) as db:
        cache = pycolmap.DatabaseCache.create(db, pycolmap.DatabaseCacheOptions())
    deviations: dict[str, float] = {}
    for _ in range(ROUNDS):
        freed = pycolmap.Reconstruction(model)
        deviations = _solve(freed, centre=True)
        if _centre_determined(freed, deviations):
            model = freed
        else:
            deviations = _solve(model, centre=False)
        observations = pycolmap.ObservationManager(model, cache.correspondence_graph)
        observations.filter_all_points3D(MAX_ERROR_PX, MIN_ANGLE_DEG)
    return model, deviations


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
    settings = pycolmap.BACovarianceOptions()
    settings.params = pycolmap.BACovarianceOptionsParams.ALL
    covariance = pycolmap.estimate_ba_covariance(settings, model, adjuster)
    other = covariance.get_other_params_cov(_main_camera(model).params) if covariance else None
    if other is None:
        return {}
    names = ("fx", "fy", "cx", "cy") if centre else ("fx", "fy")
    return dict(zip(names, np.sqrt(np.diag(other)).tolist(), strict=False))


def _centre_determined(model: Any, deviations: dict[str, float]) -> bool:
    camera = _main_camera(model)
    limit = DETERMINED * max(camera.width, camera.height)
    return max(deviations.get("cx", np.inf), deviations.get("cy", np.inf)) < limit


def _main_camera(model: Any) -> Any:
    used = [model.images[image_id].camera_id for image_id in model.reg_image_ids()]
    return model.cameras[max(set(used), key=lambda camera_id: (used.count(camera_id), -camera_id))]
