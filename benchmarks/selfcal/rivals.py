"""Rivals of zero curves on our fundamental matrices: COLMAP's view-graph calibration, focals of pairs by PoseLib."""

import shutil
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.command_line import import_rival
from sfm_app.camera.models import guessed_camera_matrix
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import open_database
from sfm_app.types import Calibration, MatchGraph, ViewGraph

VIEW_GRAPH = "view-graph calibration"
ITERATED = "iterated focals, PoseLib"
"""Kocur, Kyselica and Kukelova (CVPR 2024); a camera gets the median of its pairs."""


def view_graph_calibration(
    database: Path, scratch: Path, matches: MatchGraph, views: ViewGraph, seed: int = 0
) -> tuple[dict[int, Calibration], float]:
    """Calibrate a copy of the database whose focals start at 1.2 times the longer side, without a prior.

    Degenerate pairs stay in it, marked as such, as they do for mapping. Relative poses are not re-estimated: that
    is not part of the calibration and would only add to its time.

    Returns:
        Calibrations by image id, and the seconds of COLMAP's part alone. A camera that stays at its guess counts as not
        identifiable, although COLMAP itself does not report this.
    """
    copy = scratch / "view_graph_calibration.db"
    shutil.copyfile(database, copy)
    _write_fits(copy, matches, views)
    _reset_cameras(copy)
    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed, options.reestimate_relative_pose = seed, False
    start = time.perf_counter()
    done = pycolmap.calibrate_view_graph(copy, options)
    seconds = time.perf_counter() - start
    with open_database(copy) as opened_copy:
        found = {
            entry.image_id: _to_calibration(opened_copy.read_camera(entry.camera_id), done)
            for entry in opened_copy.read_all_images()
        }
    copy.unlink()
    return found, seconds


def _write_fits(path: Path, matches: MatchGraph, views: ViewGraph) -> None:
    kinds = pycolmap.TwoViewGeometryConfiguration
    with open_database(path) as database:
        database.clear_two_view_geometries()
        for pair, fit in views.fits.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.config = kinds.PLANAR_OR_PANORAMIC if fit.degeneracy else kinds.UNCALIBRATED
            geometry.F = fit.matrix
            geometry.inlier_matches = np.ascontiguousarray(matches.matches[pair][fit.inliers])
            database.write_two_view_geometry(*pair, geometry)


def _reset_cameras(path: Path) -> None:
    with open_database(path) as database, pycolmap.DatabaseTransaction(database):
        for camera in database.read_all_cameras():
            camera.model = pycolmap.CameraModelId.SIMPLE_RADIAL
            K = guessed_camera_matrix((camera.width, camera.height))
            camera.params = [K[0, 0], *K[:2, 2], 0.0]
            camera.has_prior_focal_length = False
            database.update_camera(camera)


def _to_calibration(camera: Any, done: bool) -> Calibration:
    K = np.asarray(camera.calibration_matrix(), np.float64)
    known = done and camera.has_prior_focal_length  # COLMAP sets it where it accepts its estimate
    reason = "" if known else "kept the guess" if done else "gave up"
    return Calibration(K, camera.width, camera.height, VIEW_GRAPH, identifiable=known, reason=reason)


def iterated_focals(matches: MatchGraph, views: ViewGraph) -> tuple[dict[int, Calibration], float]:
    """Estimate focals pair by pair, from the usual guess and with its weights; centers stay in the middle.

    Returns:
        Calibrations by image id, and seconds. A camera without a pair counts as not identifiable.
    """
    poselib = import_rival("poselib")
    images, focals = matches.images, defaultdict[str, list[float]](list)
    guesses = {}
    for k, image in images.items():
        focal = guessed_camera_matrix((image.width, image.height))[0, 0]
        params = [focal, image.width / 2, image.height / 2]
        guesses[k] = {"model": "SIMPLE_PINHOLE", "width": image.width, "height": image.height, "params": params}
    start = time.perf_counter()
    for pair, fit in views.fits.items():
        if not fit.degeneracy:
            *found, _ = poselib.focals_from_fundamental_iterative(fit.matrix, *(guesses[k] for k in pair))
            for k, camera in zip(pair, found, strict=True):
                focals[images[k].group].append(camera.params[0])
    medians = {name: float(np.median(values)) for name, values in focals.items()}
    seconds = time.perf_counter() - start
    calibrated = {}
    for k, image in images.items():
        focal, size = medians.get(image.group), (image.width, image.height)
        K, reason = guessed_camera_matrix(size, focal), "no pair" if focal is None else ""
        calibrated[k] = Calibration(K, *size, ITERATED, identifiable=focal is not None, reason=reason)
    return calibrated, seconds
