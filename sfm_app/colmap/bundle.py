"""The last bundle adjustment: everything that the photos determine is set free."""

from collections import Counter
from collections.abc import Mapping
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
    down the ladder until it agrees. The camera with most photos decides; of the others, those that the step asks too
    much of (a single photo with another zoom) stay as mapping left them. Observations that fit badly are then dropped,
    and the same is refined again.

    Returns:
        The refined model, and the standard deviations in pixels of fx, fy, cx, cy of the camera with most photos, as
        far as they were free.
    """
    few, main = model.num_reg_images() < PHOTOS_FOR_CENTRE, main_camera(model)
    for camera_model, centre in LADDER:
        if (camera_model == SQUARE_PIXELS and main.model.name != SQUARE_PIXELS) or (centre and few):
            continue
        freed = pycolmap.Reconstruction(model)
        for camera in freed.cameras.values():
            if camera.model.name == SQUARE_PIXELS:
                _become(camera, camera_model)
        deviations = _solve(freed, centre=centre)
        if _determined(main_camera(freed), deviations):
            break
    _step_back(freed, model, deviations, centre=centre)
    _drop_misfits(freed, database)
    return freed, _solve(freed, centre=centre).get(main.camera_id, {})


def _step_back(freed: Any, model: Any, deviations: Mapping[int, Mapping[str, float]], *, centre: bool) -> None:
    """Give cameras that were set too free their former model, all but the one that decides."""
    weak = [
        camera
        for camera in freed.cameras.values()
        if camera.model.name != model.cameras[camera.camera_id].model.name and not _determined(camera, deviations)
    ]
    for camera in weak:
        former = model.cameras[camera.camera_id]
        camera.model, camera.params = former.model, former.params
    if weak:
        _solve(freed, centre=centre)


def _solve(model: Any, *, centre: bool) -> dict[int, dict[str, float]]:
    """Adjust the model in place; standard deviations of its cameras' parameters, for those where they are finite."""
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
    noise = model.compute_mean_reprojection_error()
    found = {}
    for camera_id in _used_cameras(model):
        camera = model.cameras[camera_id]
        spread = covariance.get_other_params_cov(camera.params) if covariance else None
        if spread is not None:
            focals = ("fx", "fy") if len(camera.focal_length_idxs()) == 2 else ("f",)
            # COLMAP's covariance is that of measurements off by 1 px
            values = (np.sqrt(np.diag(spread)) * noise).tolist()
            found[camera_id] = dict(zip((*focals, "cx", "cy") if centre else focals, values, strict=False))
    return found


def _determined(camera: Any, deviations: Mapping[int, Mapping[str, float]]) -> bool:
    found = deviations.get(camera.camera_id, {})
    limits = {
        "f": FOCAL_DETERMINED * camera.mean_focal_length(),
        "c": CENTRE_DETERMINED * max(camera.width, camera.height),
    }
    return bool(found) and all(value < limits[name[0]] for name, value in found.items())


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


def main_camera(model: Any) -> Any:
    """The camera that took most of the photos that have a pose."""
    used = _used_cameras(model)
    return model.cameras[max(used, key=lambda camera_id: (used[camera_id], -camera_id))]


def _used_cameras(model: Any) -> Counter[int]:
    """How many photos with a pose each camera took, by its id."""
    return Counter(model.images[image_id].camera_id for image_id in model.reg_image_ids())
