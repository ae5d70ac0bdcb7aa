"""Masks in COLMAP's dense workspace: undistorted, at the size of the photos there."""

from math import ceil
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap, translate_errors
from sfm_app.colmap.types import all_images
from sfm_app.photos import mask_path, read_mask, save_mask
from sfm_app.stereo import View

MASKS = "masks"
REACH_PX = 2
"""Width of the border around masked pixels that is not used either: colors are interpolated between four pixels, at
most half a pixel aside."""

BoolImage = NDArray[np.bool_]
"""(H, W)."""


class MaskUndistorter:
    """Writes masks of undistorted photos; on its way to another process, it is the paths of its inputs.

    Args:
        model_dir: model with the cameras of the photos.
        mask_dir: masks of the original photos.
        dense_dir: workspace with the undistorted photos.
    """

    def __init__(self, model_dir: Path, mask_dir: Path, dense_dir: Path) -> None:
        self._inputs = model_dir, mask_dir, dense_dir
        with translate_errors("reading the model"):
            model = pycolmap.Reconstruction(model_dir)
            self._cameras = {image.name: model.cameras[image.camera_id] for image in all_images(model)}

    def __reduce__(self) -> tuple[type["MaskUndistorter"], tuple[Path, Path, Path]]:
        return MaskUndistorter, self._inputs

    def __call__(self, view: View) -> None:
        """Write the mask of an undistorted photo."""
        _, mask_dir, dense_dir = self._inputs
        used = _undistort_mask(read_mask(mask_dir, view.name), self._cameras[view.name], view)
        save_mask(dense_dir / MASKS, view.name, used)


def has_masks(dense_dir: Path) -> bool:
    """Return whether any undistorted photo has a mask.

    Args:
        dense_dir: folder with undistorted photos and their maps.
    """
    return (dense_dir / MASKS).is_dir()


def used_pixels(dense_dir: Path, view: View) -> BoolImage | None:
    """Return (H, W) which pixels of an undistorted photo may be used; None if it has no mask.

    Args:
        dense_dir: folder with undistorted photos and their maps.
        view: an undistorted photo.
    """
    place = dense_dir / MASKS
    return read_mask(place, view.name) if mask_path(place, view.name).exists() else None


def _undistort_mask(used: BoolImage, camera: pycolmap.Camera, view: View) -> BoolImage:
    """Return (H, W) the mask of an undistorted photo: a pixel is used if all original pixels under it are."""
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.linalg.inv(view.K).T
    with translate_errors(f"undistorting the mask of {view.name}"):
        at = np.floor(camera.img_from_cam(rays)).astype(np.int64).reshape(view.height, view.width, 2)
    col, row = at[..., 0], at[..., 1]
    height, width = used.shape
    inside = (col >= 0) & (col < width) & (row >= 0) & (row < height)
    whole = _erode(used, ceil(max(camera.focal_length_x / view.K[0, 0], camera.focal_length_y / view.K[1, 1])))
    return shrink_mask(inside & whole[row.clip(0, height - 1), col.clip(0, width - 1)])


def shrink_mask(used: BoolImage) -> BoolImage:
    """Return the mask of an undistorted photo without its border, where colors are mixed.

    Args:
        used: (H, W) which pixels may be used.
    """
    return _erode(used, REACH_PX)


def _erode(used: BoolImage, reach: int) -> BoolImage:
    """Return the mask without pixels that have an unused one within `reach` pixels."""
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.erode(used.view(np.uint8), square)) > 0
