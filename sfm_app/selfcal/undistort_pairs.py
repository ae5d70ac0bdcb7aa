"""Pairs without lens distortion: only of these do the zero curves meet.

Ours; the thesis has no lens.
"""

from dataclasses import replace

import numpy as np

from sfm_app.ransac.refine.sampson_refit import refine_sampson
from sfm_app.selfcal.inputs import FloatArray
from sfm_app.selfcal.lens import undistort_kernel
from sfm_app.selfcal.results import parameters_from_calibration
from sfm_app.types import Calibration, CameraPairs

REACH_PX = 3.0
"""Scale of the robust refit of an F. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


def undistort_pairs(pairs: CameraPairs, camera: Calibration) -> CameraPairs:
    """Undistort the inliers and refit every F to them; return the pairs themselves where no lens is known.

    Args:
        pairs: P fundamental matrices in pixels, with or without their inliers.
        camera: the camera of all photos.
    """
    if camera.radial == 0.0 or not pairs.inliers:
        return pairs
    side, middle = float(max(pairs.size)), np.array(pairs.size) / 2
    theta = parameters_from_calibration(camera, side)
    to_sides = np.array([[1 / side, 0, -middle[0] / side], [0, 1 / side, -middle[1] / side], [0, 0, 1]])
    back = np.linalg.inv(to_sides)
    Fs, inliers = np.empty_like(pairs.Fs), []
    for k, seen in enumerate(pairs.inliers):
        views = [undistort_points((np.asarray(seen)[:, i : i + 2] - middle) / side, theta) for i in (0, 2)]
        points = np.asfortranarray(np.hstack(views))
        Fs[k] = to_sides.T @ refine_sampson(points, back.T @ pairs.Fs[k] @ back, scale=REACH_PX / side) @ to_sides
        inliers.append(points * side + np.tile(middle, 2))
    return replace(pairs, Fs=Fs, inliers=tuple(inliers))


def undistort_points(points: FloatArray, theta: FloatArray) -> FloatArray:
    """Return (N, 2) undistorted points of a camera.

    Args:
        points: (N, 2) from the middle of the photo.
        theta: (5,) parameters of the camera, see `lens`, in the same units.
    """
    return np.asarray(undistort_kernel(np.ascontiguousarray(points, np.float64), theta), np.float64)
