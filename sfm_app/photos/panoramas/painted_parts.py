"""The perspective views in which a panorama is painted onto a surface: the faces of a cube, in its own resolution."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.camera import panorama_matrix
from sfm_app.geometry.lenses.bearings import RAY, bearings, project
from sfm_app.geometry.lenses.perspective_views import PerspectiveView, cover_rays
from sfm_app.photos.resample import resample
from sfm_app.types.calibration import EQUIRECTANGULAR, Calibration

GRID = 257
"""Rows and columns of a panorama whose rays are covered. Chosen by hand; not measured on its own."""


def panorama_parts(size: tuple[int, int]) -> list[PerspectiveView]:
    """Return the views of a panorama.

    Args:
        size: (width, height) of the panorama in pixels.
    """
    x, y = np.meshgrid(np.linspace(0.0, size[0], GRID), np.linspace(0.0, size[1], GRID))
    rays = bearings(np.column_stack([x.ravel(), y.ravel()]), _camera(size))[:, RAY]
    return cover_rays(rays, size[0] / (2.0 * np.pi), size[0])


def show_part(panorama: NDArray[np.uint8], part: PerspectiveView) -> NDArray[np.uint8]:
    """Return a view (h, w, 3) into a panorama.

    Args:
        panorama: (H, W, 3).
        part: the view.
    """
    height, width = panorama.shape[:2]
    at = part.locate(partial(project, camera=_camera((width, height))))
    return resample(panorama, at, (width, height), wraps=True)


def mask_part(used: NDArray[np.bool_], part: PerspectiveView) -> NDArray[np.bool_]:
    """Return (h, w) which pixels of a view into a panorama may be used.

    Args:
        used: (H, W) of the panorama.
        part: the view.
    """
    height, width = used.shape
    at = part.locate(partial(project, camera=_camera((width, height))))
    column, row = np.moveaxis(at.astype(np.int64), -1, 0)
    return np.asarray(used[row.clip(0, height - 1), column.clip(0, width - 1)])


def _camera(size: tuple[int, int]) -> Calibration:
    return Calibration(panorama_matrix(size), *size, "panorama", True, projection=EQUIRECTANGULAR)
