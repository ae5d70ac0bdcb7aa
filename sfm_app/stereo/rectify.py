"""Two posed photos turned so that matches lie in the same row, on a canvas made to measure.

Fusiello, Trucco, Verri: A compact algorithm for rectification of stereo pairs. Machine Vision and Applications 2000.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from sfm_app.stereo.view import FloatArray, GreyImage, View
from sfm_app.types import Rejected

MIN_AXIS_SINE = 0.4
"""Least sine between baseline and viewing direction; closer to the epipole the stretching ruins the photos."""
MAX_DISPARITIES = 256
MAX_GROWTH = 2.0
"""Largest area of the canvas in areas of the photo."""
DISPARITY_STEP = 16
"""OpenCV wants multiples of this."""
MIN_POINTS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Rectification:
    """How the reference (left) and its neighbour (right) come into one frame.

    A point at depth Z of that frame has the disparity ``focal_px * baseline / Z - offset_px`` in [0, disparities).
    """

    rotation: FloatArray
    """(3, 3) rectified camera from world; the x axis points from the reference to the neighbour."""
    left: FloatArray
    """(3, 3) rectified pixels from pixels of the reference."""
    right: FloatArray
    """(3, 3) rectified pixels from pixels of the neighbour."""
    size: tuple[int, int]
    """Width and height of both rectified images in pixels."""
    focal_px: float
    baseline: float
    offset_px: float
    disparities: int

    def warp(self, reference: GreyImage, neighbour: GreyImage) -> tuple[GreyImage, GreyImage]:
        """Both photos on the common canvas, black where they have no pixels."""
        to_center = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
        to_index = np.linalg.inv(to_center)  # OpenCV has pixel centres at whole numbers
        left, right = (
            cv2.warpPerspective(image, to_index @ H @ to_center, self.size, flags=cv2.INTER_CUBIC)
            for image, H in ((reference, self.left), (neighbour, self.right))
        )
        return np.asarray(left, np.uint8), np.asarray(right, np.uint8)


def rectify(reference: View, neighbour: View) -> Rectification | Rejected:
    """Turn both views about their centres until the baseline is the x axis, whatever its direction in the photos.

    The canvas shows what both photos see of the depths that the reference's sparse points span, at the reference's
    resolution (less where the disparities would exceed `MAX_DISPARITIES`), and leaves room on the left for the largest
    disparity, because OpenCV finds nothing in that margin.
    """
    rotation = _rectified_rotation(reference, neighbour)
    if isinstance(rotation, Rejected):
        return rotation
    left = rotation @ reference.R.T @ np.linalg.inv(reference.K)
    right = rotation @ neighbour.R.T @ np.linalg.inv(neighbour.K)
    boxes = [_bounds(H, view) for H, view in ((left, reference), (right, neighbour))]
    points = (reference.points - reference.center) @ rotation.T
    points = points[points[:, 2] > 0]
    if boxes[0] is None or boxes[1] is None:
        return Rejected("the neighbour looks in another direction")
    if len(points) < MIN_POINTS:
        return Rejected("too few sparse points")
    baseline = float(np.linalg.norm(neighbour.center - reference.center))
    near, far = _disparity_range(baseline / points[:, 2])
    low, high = _canvas(boxes[0], boxes[1], near, far)
    if np.any(high - low <= 0):
        return Rejected("the photos do not overlap")
    focal = _focal_px(left, reference)
    focal *= min(1.0, MAX_DISPARITIES / (focal * (near - far) + 8), _shrink(focal * (high - low), reference))
    steps = int(np.ceil((focal * (near - far) + 8) / DISPARITY_STEP))
    disparities, offset = steps * DISPARITY_STEP, focal * far - 4
    K_left = np.array([[focal, 0, disparities - focal * low[0]], [0, focal, -focal * low[1]], [0, 0, 1]])
    K_right = K_left + np.array([[0, 0, offset], [0, 0, 0], [0, 0, 0]])
    width, height = np.ceil(focal * (high - low)).astype(int)
    size = (int(width) + disparities, int(height))
    return Rectification(rotation, K_left @ left, K_right @ right, size, focal, baseline, offset, disparities)


def _rectified_rotation(reference: View, neighbour: View) -> FloatArray | Rejected:
    baseline = neighbour.center - reference.center
    length = np.linalg.norm(baseline)
    if length == 0:
        return Rejected("same place")
    x = baseline / length
    mean_axis = reference.R[2] + neighbour.R[2]
    mean_axis /= max(float(np.linalg.norm(mean_axis)), 1e-12)
    z = mean_axis - (mean_axis @ x) * x
    if np.linalg.norm(z) < MIN_AXIS_SINE:
        return Rejected("motion along the viewing direction")
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z])


def _bounds(H: FloatArray, view: View) -> FloatArray | None:
    """Lowest and highest x and y, (2, 2), of the photo's border; None where it is 70 degrees off the axis."""
    w, h = float(view.width), float(view.height)
    corners = np.array([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]]) @ H.T
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    if np.any(corners[:, 2] < 0.34):
        return None
    xy = corners[:, :2] / corners[:, 2:]
    return np.stack([xy.min(axis=0), xy.max(axis=0)])


def _disparity_range(disparities: FloatArray) -> tuple[float, float]:
    """Largest and smallest disparity, per focal length, of the surface; sparse points rarely reach its ends."""
    low, high = np.percentile(disparities, [1, 99])
    margin = 0.15 * (high - low) + 0.02 * high
    return float(high + margin), float(max(low - margin, 0.25 * low))


def _canvas(left: FloatArray, right: FloatArray, near: float, far: float) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner of what the reference and, shifted by some disparity, the neighbour both cover."""
    low = np.maximum(left[0], right[0] + [far, 0])
    high = np.minimum(left[1], right[1] + [near, 0])
    return low, high


def _focal_px(H: FloatArray, view: View) -> float:
    """Focal length at which the middle of the photo keeps its size: a homography scales areas by det(H) / z^3."""
    z = H[2] @ [view.width / 2, view.height / 2, 1]
    return float(np.sqrt(z**3 / np.linalg.det(H)))


def _shrink(canvas_px: FloatArray, view: View) -> float:
    return float(np.sqrt(MAX_GROWTH * view.width * view.height / np.prod(canvas_px)))
