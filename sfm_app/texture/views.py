"""Views for texturing: lens and pose of a photo, and kernels that project and sample."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.models import camera_matrix, row_of_model
from sfm_app.camera.perspective_views import PerspectiveView
from sfm_app.camera.projection import distort_point, lens_terms, plane_point, radial_factor, shown_angle
from sfm_app.camera.rows import CX, CY, FISHEYE, FX, FY, PERSPECTIVE
from sfm_app.errors import ReconstructionError
from sfm_app.jit import kernel
from sfm_app.types import CameraModel, PosedPhoto
from sfm_app.types.arrays import FloatArray

LENS = 12
"""Number of lens parameters at the start of a camera row: COLMAP's FULL_OPENCV or THIN_PRISM_FISHEYE, fx, fy, cx, cy,
k1, k2, p1, p2, k3, k4, then k5, k6 or sx1, sy1."""
KIND, LIMIT, POSE = range(LENS, LENS + 3)
"""Columns of the kind of lens, of the squared radius before distortion at the end of the image, and of [R | t]."""
ANGLES = 360
"""Rays from the axis to the back, half a degree apart, that are searched for the widest angle of a photo."""
OPENCV, RATIONAL, ANGULAR = 0.0, 1.0, 2.0
"""Kinds of lenses: polynomial perspective, rational perspective, fisheye."""
KINDS = {"OPENCV": OPENCV, "FULL_OPENCV": RATIONAL, "OPENCV_FISHEYE": ANGULAR, "THIN_PRISM_FISHEYE": ANGULAR}
"""Kinds of COLMAP's models."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoView(PosedPhoto):
    """A posed photo with its lens, or a perspective view into a panorama."""

    photo: str
    """Name of the photo that it shows."""
    distortion: tuple[float, ...] = (0.0,) * (LENS - 4)
    """The parameters of a camera row after fx, fy, cx, cy."""
    kind: float = OPENCV
    limit: float = np.inf
    """Squared radius before distortion at the end of the image: squared tangent or angle."""
    part: PerspectiveView | None = None
    """The view into the panorama `photo`; None for a whole photo."""

    @property
    def lens(self) -> tuple[float, ...]:
        """(12,) as in a camera row."""
        fx, fy, cx, cy = (float(self.K[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
        return (fx, fy, cx, cy, *self.distortion)

    @property
    def row(self) -> FloatArray:
        """(26,) lens and pose for the kernels."""
        return np.concatenate([self.lens, [self.kind, self.limit], self.cam_from_world.ravel()])

    @property
    def widest_angle(self) -> float:
        """Upper bound in radians of the angle between the axis and the visible rays."""
        return _widest_angle(self.lens, self.kind, self.limit, self.width, self.height)


def photo_view(name: str, camera: CameraModel, cam_from_world: FloatArray) -> PhotoView:
    """Return the view of a photo with the pose [R | t] (3, 4); a ReconstructionError names an unknown camera model."""
    if camera.model not in KINDS:
        raise ReconstructionError(f"texturing does not support the camera model {camera.model}")
    kind, lens = KINDS[camera.model], row_of_model(camera.model, camera.params)
    limit = np.inf if kind == OPENCV else _image_limit(lens, kind, camera.width, camera.height)
    K, terms = camera_matrix(*lens[:4]), tuple(lens[4:].tolist())
    return PhotoView(name, K, cam_from_world, camera.width, camera.height, name, terms, kind, limit)


def part_view(name: str, photo: str, part: PerspectiveView, cam_from_world: FloatArray) -> PhotoView:
    """Return a perspective view, given in the frame of the panorama `photo`, whose pose is [R | t] (3, 4)."""
    return PhotoView(name, part.K, part.R @ cam_from_world, part.width, part.height, photo, part=part)


def _image_limit(lens: FloatArray, kind: float, width: int, height: int) -> float:
    """Return the squared tangent or angle at which a lens reaches the corner of the photo, or folds."""
    corners = np.abs([[x - lens[2], y - lens[3]] for x in (0.0, width) for y in (0.0, height)]) / lens[:2]
    reach = float(np.linalg.norm(corners, axis=1).max())
    angle = shown_angle(lens, FISHEYE if kind == ANGULAR else PERSPECTIVE, reach)
    return float(angle if kind == ANGULAR else np.tan(angle)) ** 2


@cache
def _widest_angle(lens: tuple[float, ...], kind: float, limit: float, width: int, height: int) -> float:
    """Return the largest angle from the axis of visible rays in all directions, plus two steps."""
    row = np.concatenate([lens, [kind, limit], np.eye(3, 4).ravel()])
    return min(np.pi, _largest_angle(row, width, height) + 2.0 * np.pi / ANGLES)


@kernel
def _largest_angle(camera: FloatArray, width: float, height: float) -> float:
    largest, turns = 0.0, 2 * ANGLES
    for j in range(turns):
        turn = 2.0 * np.pi * j / turns
        for i in range(ANGLES):
            angle = np.pi * (i + 1) / ANGLES
            side = np.sin(angle)
            x, y, depth = project(camera, side * np.cos(turn), side * np.sin(turn), np.cos(angle))
            if depth > 0.0 and 0.0 <= x <= width and 0.0 <= y <= height:
                largest = max(largest, angle)
    return largest


@kernel
def project(camera: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Project a world point through a camera row: pixel, and depth or, of a fisheye, distance; 0 if invisible."""
    Z = camera[22] * x + camera[23] * y + camera[24] * z + camera[25]
    X = camera[14] * x + camera[15] * y + camera[16] * z + camera[17]
    Y = camera[18] * x + camera[19] * y + camera[20] * z + camera[21]
    if camera[KIND] == ANGULAR:
        if X == 0.0 and Y == 0.0 and Z <= 0.0:
            return 0.0, 0.0, 0.0
        return _through_lens(camera, FISHEYE, X, Y, Z, np.sqrt(X * X + Y * Y + Z * Z))
    return _through_lens(camera, PERSPECTIVE, X, Y, Z, Z) if Z > 0.0 else (0.0, 0.0, 0.0)


@kernel
def _through_lens(
    camera: FloatArray, family: int, X: float, Y: float, Z: float, depth: float
) -> tuple[float, float, float]:
    """Project a point of the camera's frame at a depth; see `project`."""
    u, v = plane_point(X, Y, Z, family)
    r2 = u * u + v * v
    terms = lens_terms(camera)
    factor, slope, _ = radial_factor(r2, terms, family)
    # near 0, the derivative of the distorted radius: the lens folds
    if r2 > camera[LIMIT] or (camera[KIND] == OPENCV and factor + 2.0 * r2 * slope < 0.1):
        return 0.0, 0.0, 0.0
    x, y = distort_point(u, v, factor, terms, family)
    return camera[FX] * x + camera[CX], camera[FY] * y + camera[CY], depth


@kernel
def sample(photo: NDArray[np.uint8], x: float, y: float, channel: int) -> float:
    """Return the bilinear value of a photo (H, W, 3) at a pixel, centers at +0.5, clamped to the photo."""
    height, width = photo.shape[0], photo.shape[1]
    x = min(max(x - 0.5, 0.0), width - 1.0)
    y = min(max(y - 0.5, 0.0), height - 1.0)
    left, top = int(x), int(y)
    right, below = min(left + 1, width - 1), min(top + 1, height - 1)
    a, b = x - left, y - top
    upper: float = (1.0 - a) * photo[top, left, channel] + a * photo[top, right, channel]
    lower: float = (1.0 - a) * photo[below, left, channel] + a * photo[below, right, channel]
    value: float = (1.0 - b) * upper + b * lower
    return value
