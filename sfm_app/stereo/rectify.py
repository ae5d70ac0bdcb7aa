"""Rectification of two posed photos, disparities on the canvases, and the corresponding depths.

Rows of a canvas are epipolar planes, columns are angles from the baseline. Pollefeys, Koch, Van Gool: A simple and
efficient rectification method for general motion. ICCV 1999; here on the sphere of directions. Planar rectification
stretches photos without limit towards the epipole; this one handles motion forward, backward and sideways.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.stereo.view import GrayImage, View
from sfm_app.types import Rejected
from sfm_app.types.arrays import DepthArray, FloatArray, IndexArray

DISPARITY_STEP = 16
"""OpenCV requires multiples of this number of disparities."""


@dataclass(frozen=True, slots=True)
class RectifyOptions:
    """Limits of canvases and disparities."""

    max_disparities: int = 256
    max_growth: float = 2.0
    """Largest area of the canvas, relative to the photo."""
    min_points: int = 5
    """Fewest sparse points in front of both photos."""
    margin_px: float = 4.0
    """Disparities searched beyond those of the sparse points, at either end."""
    near_factor: float = 2.0
    """Largest triangulation angle searched, relative to the nearest sparse points: near surfaces lack features."""


OPTIONS = RectifyOptions()


@dataclass(frozen=True, slots=True, eq=False)
class Rectification:
    """The mapping of the reference (left) and its neighbor (right) to rectified canvases.

    A direction at the angle theta from the baseline, in the plane at the angle phi about it, maps to the row
    ``(phi - phi_min) * rows_per_rad`` and the column ``(theta_max - theta) * columns_per_rad + disparities`` of the
    left canvas, `offset_px` further right in the right one. The disparity of a point is its triangulation angle times
    `columns_per_rad`, less `offset_px`, and lies in [0, disparities).
    """

    rotation: FloatArray
    """(3, 3) rectified frame from world; the x axis points from the reference to the neighbor."""
    baseline: float
    theta_max: float
    phi_min: float
    columns_per_rad: float
    rows_per_rad: float
    size: tuple[int, int]
    """Width and height of both canvases in pixels; OpenCV needs the first `disparities` columns as padding."""
    offset_px: float
    disparities: int

    def warp(self, reference: GrayImage, neighbor: GrayImage, views: tuple[View, View]) -> tuple[GrayImage, GrayImage]:
        """Warp both photos to the canvas; black where they have no pixels."""
        left = self._warp(reference, views[0], 0.0)
        return left, self._warp(neighbor, views[1], self.offset_px)

    def _warp(self, image: GrayImage, view: View, shift_px: float) -> GrayImage:
        columns = np.arange(self.size[0]) + 0.5 - self.disparities - shift_px
        theta = self.theta_max - columns / self.columns_per_rad
        phi = self.phi_min + (np.arange(self.size[1]) + 0.5)[:, None] / self.rows_per_rad
        M = (view.K @ view.R @ self.rotation.T).astype(np.float32)
        cos, sin = np.cos(theta).astype(np.float32), np.sin(theta).astype(np.float32)
        across = np.sin(phi).astype(np.float32), np.cos(phi).astype(np.float32)
        x, y, w = (cos * row[0] + sin * (across[0] * row[1] + across[1] * row[2]) for row in M)
        ahead = (w > 1e-6) & (sin > 0)  # beyond the end of the baseline the photo appears again, mirrored
        # OpenCV has pixel centers at integers
        u = np.where(ahead, x / np.where(ahead, w, 1), -9) - np.float32(0.5)
        v = np.where(ahead, y / np.where(ahead, w, 1), -9) - np.float32(0.5)
        return np.asarray(cv2.remap(image, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT), np.uint8)


def rectify(reference: View, neighbor: View) -> Rectification | Rejected:
    """Compute canvases whose rows lie along the epipolar planes, for any direction of the baseline.

    The canvas covers the overlap of both photos for the depths that the reference's sparse points span. It has the
    reference's resolution, or less if the disparities or its area would exceed their limits.
    """
    rotation = _rectified_rotation(reference, neighbor)
    if rotation is None:
        return Rejected("the photos were taken from the same place")
    angles = _triangulation_angles(reference, neighbor, rotation)
    if len(angles) < OPTIONS.min_points:
        return Rejected("too few sparse points")
    per_rad = reference.focal_px
    most, margin_px = OPTIONS.max_disparities, OPTIONS.margin_px
    near, far = _angle_range(angles, (most - 2 * margin_px) / per_rad)
    left, right = _bounds(rotation, reference), _bounds(rotation, neighbor)
    # theta grows by the triangulation angle from the reference to the neighbor
    low = np.maximum(left[0], right[0] - [near, 0])
    high = np.minimum(left[1], right[1] - [far, 0])
    if np.any(high - low <= 0):
        return Rejected("the photos do not overlap")
    widest = 1.0 if low[0] < np.pi / 2 < high[0] else float(np.sin([low[0], high[0]]).max())
    area = per_rad**2 * widest * float(np.prod(high - low))
    largest = OPTIONS.max_growth * reference.width * reference.height
    per_rad *= min(1.0, most / (per_rad * (near - far) + 2 * margin_px), float(np.sqrt(largest / area)))
    steps = int(np.ceil((per_rad * (near - far) + 2 * margin_px) / DISPARITY_STEP))
    width = int(np.ceil(per_rad * (high[0] - low[0]))) + steps * DISPARITY_STEP
    height = int(np.ceil(per_rad * widest * (high[1] - low[1])))
    return Rectification(
        rotation,
        float(np.linalg.norm(neighbor.center - reference.center)),
        theta_max=float(high[0]),
        phi_min=float(low[1]),
        columns_per_rad=per_rad,
        rows_per_rad=per_rad * widest,
        size=(width, height),
        offset_px=per_rad * far - margin_px,
        disparities=steps * DISPARITY_STEP,
    )


def _rectified_rotation(reference: View, neighbor: View) -> FloatArray | None:
    baseline = neighbor.center - reference.center
    length = np.linalg.norm(baseline)
    if length == 0:
        return None
    x = baseline / length
    # the half plane phi = 0 contains the reference's optical axis or, for motion along it, its y axis
    z = max((reference.R[2], reference.R[1]), key=lambda axis: float(np.linalg.norm(np.cross(axis, x))) > 1e-3)
    z = z - (z @ x) * x
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def _directions(rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return, for rays (N, 3), the angle theta from the x axis and the angle phi about it from the z axis."""
    return np.arctan2(np.hypot(rays[:, 1], rays[:, 2]), rays[:, 0]), np.arctan2(rays[:, 1], rays[:, 2])


def _triangulation_angles(reference: View, neighbor: View, rotation: FloatArray) -> FloatArray:
    """Return (N,) triangulation angles, in radians, of the reference's sparse points in front of both photos."""
    ahead = (reference.depths(reference.points) > 0) & (neighbor.depths(reference.points) > 0)
    points = reference.points[ahead]
    return np.asarray(
        _directions((points - neighbor.center) @ rotation.T)[0]
        - _directions((points - reference.center) @ rotation.T)[0]
    )


def _angle_range(angles: FloatArray, room: float) -> tuple[float, float]:
    """Return the largest and smallest triangulation angle to search; `room` is the range that needs no downsampling."""
    # sparse points rarely reach the extremes, least at the near end: close pavement has few features
    low, high = np.percentile(angles, [1, 99])
    margin = 0.15 * (high - low) + 0.02 * high
    far = max(low - margin, 0.25 * low)
    return float(max(high + margin, min(OPTIONS.near_factor * high, far + room))), float(far)


def _bounds(rotation: FloatArray, view: View) -> FloatArray:
    """Return lowest and highest theta and phi of a photo, (2, 2); the full range of phi if it contains an epipole."""
    s, e = np.linspace(0, 1, 33), np.ones(33)
    border = np.concatenate([np.stack(side, -1) for side in ((s, 0 * e), (s, e), (0 * e, s), (e, s))])
    theta, phi = _directions(view.rays(border * [view.width, view.height]) @ view.R @ rotation.T)
    low, high = np.array([theta.min(), phi.min()]), np.array([theta.max(), phi.max()])
    for sign, end in ((1.0, 0.0), (-1.0, np.pi)):
        epipole = sign * (view.K @ view.R @ rotation[0])
        inside = epipole[2] > 0 and 0 <= epipole[0] <= view.width * epipole[2]
        if inside and 0 <= epipole[1] <= view.height * epipole[2]:
            low, high = np.array([min(low[0], end), -np.pi]), np.array([max(high[0], end), np.pi])
    if high[1] - low[1] > np.pi:  # the photo lies across the seam at phi = pi
        low[1], high[1] = -np.pi, np.pi
    return np.stack([low, high])


def disparities(left: GrayImage, right: GrayImage, count: int) -> NDArray[np.float32]:
    """Compute subpixel disparities in [0, count) by semi-global matching (Hirschmueller, PAMI 2008; OpenCV's variant).

    The photos are rectified; `count` is a multiple of 16.

    Return (H, W) the disparity of the left image in pixels; -1 where left and right disagree by more than a pixel,
    where a second disparity is nearly as good, and on small specks.
    """
    block_px = 3
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=block_px,
        P1=8 * block_px**2,
        P2=32 * block_px**2,
        disp12MaxDiff=1,
        preFilterCap=63,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,  # five directions take a third longer without better results
    )
    sixteenths = matcher.compute(left, right)
    return np.where(sixteenths < 0, -1.0, sixteenths / 16.0).astype(np.float32)


def depths_from_disparities(
    disparity: NDArray[np.float32], rectification: Rectification, reference: View, neighbor: View
) -> DepthArray:
    """Lift a disparity map (H, W) of the left canvas, < 0 where unknown, to depths of the reference.

    Return (H, W) depths, 0 where unknown, outside the neighbor, or where the parallax is below a pixel.
    """
    to_rectified = rectification.rotation @ reference.R.T @ np.linalg.inv(reference.K)
    size = np.array([reference.height, reference.width, neighbor.height, neighbor.width])
    depth = np.zeros((reference.height, reference.width), np.float32)
    r = rectification
    canvas = np.array(
        [r.baseline, r.theta_max, r.phi_min, r.columns_per_rad, r.rows_per_rad, r.disparities, r.offset_px]
    )
    into_neighbor = reference.projection_into(neighbor)
    _lift(disparity, canvas, to_rectified, into_neighbor, reference.sample_px, size, depth)
    return depth


@kernel
def _lift(
    disparity: NDArray[np.float32],
    canvas: FloatArray,
    to_rectified: FloatArray,
    P: FloatArray,
    sample: float,
    size: IndexArray,
    depth: DepthArray,
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
            # parallaxes below a pixel, near the epipole and far away, do not determine the depth
            if columns_per_rad * sine < 1.0:
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


@kernel
def _interpolate(disparity: NDArray[np.float32], u: float, v: float) -> float:
    """Return the bilinear value where the surface is continuous, else the nearest value; -1 where unknown."""
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
