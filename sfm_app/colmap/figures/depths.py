"""A photo beside its depth map, read by name: a report needs no more of a dense workspace."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap, translate_errors
from sfm_app.hashing import is_below


def read_photo_and_depth(dense_dir: Path, name: str) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return the undistorted photo (H, W, 3) RGB and its confirmed depths (H, W), <= 0 where there is none.

    Args:
        dense_dir: dense workspace.
        name: of the undistorted photo.

    Raises:
        ValueError: the name leads out of the workspace, or the photo is none.
        OSError: the photo is not there.
        BackendError: the depth map cannot be read.
    """
    if not is_below(name):
        raise ValueError(f"{name} does not lie in {dense_dir}")
    # imdecode, because OpenCV does not open names beyond ASCII on every system
    image = cv2.imdecode(np.fromfile(dense_dir / "images" / name, np.uint8), cv2.IMREAD_COLOR_RGB)
    if image is None:
        raise ValueError(f"{name} is no photo")
    with translate_errors(f"reading the depth map of {name}"):
        stored = pycolmap.DepthMap()
        stored.read(dense_dir / "stereo" / "depth_maps" / f"{name}.geometric.bin")
    return np.asarray(image, np.uint8), np.array(stored.to_array(), np.float32)
