"""Disparities of rectified photos, and the corresponding depths."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.stereo.rectify import Rectification
from sfm_app.stereo.view import DepthArray, FloatArray, GrayImage, View

BLOCK_PX = 3
NO_DISPARITY = -1.0
MIN_PARALLAX_PX = 1.0
"""Smaller parallaxes, near the epipole and far away, do not determine the depth."""


def disparities(left: GrayImage, right: GrayImage, count: int) -> NDArray[np.float32]:
    """Compute subpixel disparities in [0, count) by semi-global matching (Hirschmueller, PAMI 2008; OpenCV's variant).

    Args:
        left: (H, W) rectified.
        right: (H, W) rectified.
        count: pixels, a multiple of 16.

    Returns:
        (H, W) disparity of the left image in pixels; -1 where left and right disagree by more than a pixel, where a
        second disparity is nearly as good, and on small specks.
    """
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=BLOCK_PX,
        P1=8 * BLOCK_PX**2,
        P2=32 * BLOCK_PX**2,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,  # five directions take a third longer without better results
    )
    sixteenths = matcher.compute(left, right)
    return np.where(sixteenths < 0, NO_DISPARITY, sixteenths / 16.0).astype(np.float32)


def depths_from_disparities(
    disparity: NDArray[np.float32], rectification: Rectification, reference: View, neighbor: View
) -> tuple[DepthArray, DepthArray]:
    """Lift a rectified disparity map to depths of the reference.

    Args:
        disparity: (H, W) of the left canvas in pixels; < 0 where unknown.
        rectification: of the two views.
        reference: the view of the left canvas.
        neighbor: the view of the right one.

    Returns:
        (H, W) depth of the reference's pixels, 0 where unknown or not seen by the neighbor, and (H, W) the parallax
        in pixels, to which the relative accuracy of the depth is proportional.
    """
    K_inv = np.linalg.inv(reference.K)
    to_rectified = rectification.rotation @ reference.R.T @ K_inv
    # x of the neighbor = M x z + m for the pixel x of the reference at depth z
    M = neighbor.K @ neighbor.R @ reference.R.T @ K_inv
    m = neighbor.K @ (neighbor.t - neighbor.R @ reference.R.T @ reference.t)
    size = np.array([reference.height, reference.width, neighbor.height, neighbor.width])
    depth = np.zeros((reference.height, reference.width), np.float32)
    parallax = np.zeros_like(depth)
    r = rectification
    canvas = np.array(
        [r.baseline, r.theta_max, r.phi_min, r.columns_per_rad, r.rows_per_rad, r.disparities, r.offset_px]
    )
    _lift(disparity, canvas, to_rectified, np.column_stack([M, m]), reference.sample_px, size, depth, parallax)
    return depth, parallax


@kernel
def _lift(
    disparity: NDArray[np.float32],
    canvas: FloatArray,
    to_rectified: FloatArray,
    P: FloatArray,
    sample: float,
    size: NDArray[np.int64],
    depth: DepthArray,
    parallax: DepthArray,
) -> None:
    baseline, theta_max, phi_min, columns_per_rad, rows_per_rad, margin, offset = canvas
    R = to_rectified
    for row in range(size[0]):
        for col in range(size[1]):
            x, y = col + sample, row + sample
            a = R[0, 0] * x + R[0, 1] * y + R[0, 2]
            b = R[1, 0] * x + R[1, 1] * y + R[1, 2]
            c = R[2, 0] * x + R[2, 1] * y + R[2, 2]
            across = np.sqrt(b * b + c * c)
            theta = np.arctan2(across, a)
            u = (theta_max - theta) * columns_per_rad + margin - 0.5
            v = (np.arctan2(b, c) - phi_min) * rows_per_rad - 0.5
            d = _interpolate(disparity, u, v)
            if d < 0 or d + offset <= 0:
                continue
            angle = (d + offset) / columns_per_rad
            if theta + angle >= np.pi or across <= 0:
                continue
            # law of sines in the epipolar triangle; across = |ray| sin(theta)
            sine = np.sin(angle) * np.sin(theta + angle) / np.sin(theta)
            shift = columns_per_rad * sine
            if shift < MIN_PARALLAX_PX:
                continue
            z = baseline * np.sin(theta + angle) / np.sin(angle) / np.sqrt(a * a + across * across)
            p2 = z * (P[2, 0] * x + P[2, 1] * y + P[2, 2]) + P[2, 3]
            if p2 <= 0:
                continue
            p0 = (z * (P[0, 0] * x + P[0, 1] * y + P[0, 2]) + P[0, 3]) / p2
            p1 = (z * (P[1, 0] * x + P[1, 1] * y + P[1, 2]) + P[1, 3]) / p2
            # beyond the neighbor's border the matcher only extrapolates
            if 2 < p0 < size[3] - 2 and 2 < p1 < size[2] - 2:
                depth[row, col] = z
                parallax[row, col] = shift


@kernel
def _interpolate(disparity: NDArray[np.float32], u: float, v: float) -> float:
    """Return the bilinear value where the surface is continuous, else the nearest one; -1 where there is none."""
    height, width = disparity.shape
    i, j = int(np.floor(v)), int(np.floor(u))
    if i < 0 or j < 0 or i + 1 >= height or j + 1 >= width:
        return -1.0
    a, b, c, d = disparity[i, j], disparity[i, j + 1], disparity[i + 1, j], disparity[i + 1, j + 1]
    lowest, highest = min(a, b, c, d), max(a, b, c, d)
    fu, fv = u - j, v - i
    if lowest >= 0 and highest - lowest < 1.5:
        return float((1 - fv) * ((1 - fu) * a + fu * b) + fv * ((1 - fu) * c + fu * d))
    return float(disparity[i + (fv >= 0.5), j + (fu >= 0.5)])
