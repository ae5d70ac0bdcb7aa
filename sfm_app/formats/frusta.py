"""Wire frames of cameras in a scene."""

import numpy as np

from sfm_app.types import Model, PosedPhoto
from sfm_app.types.arrays import ByteArray, FloatArray, IndexArray

CAMERA_COLOR = (255, 96, 32)
"""sRGB of the cameras: an orange that walls, trees and skies do not have. By hand."""
FRUSTUM_EDGES = ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1))
"""Lines between the camera's center (0) and the corners of its image (1 to 4)."""
DOTS = 12
"""Dots per edge, for formats without lines. By hand."""


def camera_lines(model: Model) -> tuple[FloatArray, IndexArray]:
    """Return the cameras of a model as wire frames: corners (5 C, 3), and lines (8 C, 2) between them."""
    cameras = model.cameras
    if not cameras:
        return np.zeros((0, 3)), np.zeros((0, 2), np.int64)
    depth = frustum_depth(np.array([camera.center for camera in cameras]), model.surface.vertices)
    corners = np.concatenate([frustum_corners(camera, depth) for camera in cameras])
    starts = 5 * np.arange(len(cameras), dtype=np.int64)
    return corners, (starts[:, None, None] + np.array(FRUSTUM_EDGES)).reshape(-1, 2)


def camera_dots(model: Model) -> tuple[FloatArray, ByteArray]:
    """Return the cameras of a model as dotted wire frames: points (D, 3) and colors (D, 3)."""
    corners, lines = camera_lines(model)
    share = np.linspace(0.0, 1.0, DOTS, endpoint=False)[:, None, None]
    dots = ((1 - share) * corners[lines[:, 0]] + share * corners[lines[:, 1]]).reshape(-1, 3)
    return dots, camera_colors(len(dots))


def camera_colors(count: int) -> ByteArray:
    """Return the color of cameras for `count` vertices."""
    return np.tile(np.array(CAMERA_COLOR, np.uint8), (count, 1))


def frustum_corners(camera: PosedPhoto, depth: float) -> FloatArray:
    """Return (5, 3) the camera's center and the corners of its image at this depth, clockwise from the top left."""
    pixels = [(0, 0), (camera.width, 0), (camera.width, camera.height), (0, camera.height)]
    rays = np.linalg.solve(camera.K, np.column_stack([np.array(pixels, np.float64), np.ones(4)]).T).T
    corners = np.concatenate([np.zeros((1, 3)), depth * rays])
    return np.asarray((corners - camera.t) @ camera.R)


def frustum_depth(centers: FloatArray, points: FloatArray) -> float:
    """Return the depth of the frusta: a third of the median distance between neighboring cameras, within bounds."""
    from scipy.spatial import cKDTree

    size = max(scene_size(centers), scene_size(points)) or 1.0
    # the nearest neighbor of a camera is the camera itself
    distances = np.asarray(cKDTree(centers).query(centers, 2)[0]) if len(centers) > 1 else np.full((1, 2), np.inf)
    step = float(np.median(distances[:, 1]))
    # a hundredth to a tenth of the scene is visible and hides little; many cameras on one line need smaller frusta
    least = min(0.01, 1.0 / (3.0 * max(len(centers), 1)))
    return float(np.clip(step / 3, least * size, 0.1 * size))


def scene_size(points: FloatArray) -> float:
    """Return the diagonal of the box that contains nine of ten coordinates along each axis."""
    low, high = np.percentile(points, [5, 95], axis=0)
    return float(np.linalg.norm(high - low))


def append_cameras(model: Model) -> tuple[FloatArray, ByteArray, IndexArray]:
    """Return a model's vertices followed by its cameras' corners, their colors, and the cameras' lines."""
    corners, lines = camera_lines(model)
    surface = model.surface
    colors = np.concatenate([surface.colors, camera_colors(len(corners))])
    return np.concatenate([surface.vertices, corners]), colors, lines + len(surface.vertices)
