"""Pairs as a camera without its lens would have given them: only there do zero curves meet."""

from dataclasses import replace

import numpy as np

from sfm_app.geometry.epipolar import eight_point
from sfm_app.ransac.refit import refine_sampson
from sfm_app.selfcal.lens import straightened
from sfm_app.types import Calibration, CameraPairs


def without_lens(pairs: CameraPairs, camera: Calibration) -> CameraPairs:
    """The inliers straightened and every F fitted to them anew; the pairs themselves where no lens is known."""
    if camera.radial == 0.0 or not pairs.inliers:
        return pairs
    side, middle = float(max(pairs.size)), np.tile(np.array(pairs.size) / 2, 2)
    (fx, _, cx), (_, fy, cy), _ = camera.K
    focal = camera.focal_px / side
    centre = (np.array([cx, cy]) - middle[:2]) / side
    theta = np.array([np.log(focal), *centre, np.log(fy / fx), camera.radial / focal**2])
    to_sides = np.array([[1 / side, 0, -middle[0] / side], [0, 1 / side, -middle[1] / side], [0, 0, 1]])
    Fs, inliers = [], []
    for seen in pairs.inliers:
        x = (np.asarray(seen, np.float64) - middle) / side
        views = [straightened(np.ascontiguousarray(x[:, half]), theta) for half in (slice(0, 2), slice(2, 4))]
        straight = np.asfortranarray(np.hstack(views))
        Fs.append(to_sides.T @ refine_sampson(straight, eight_point(*views)) @ to_sides)
        inliers.append(straight * side + middle)
    return replace(pairs, Fs=np.array(Fs), inliers=tuple(inliers))
