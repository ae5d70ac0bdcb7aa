"""SIFT descriptors from COLMAP's database."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import open_database


def largest_descriptors(path: Path, photo: int, most: int) -> NDArray[np.uint8]:
    """Return (N, 128) descriptors of a photo, those of the largest features first; none where it has none.

    Args:
        path: database file.
        photo: id.
        most: number of descriptors.
    """
    with open_database(path) as database:
        if not database.exists_descriptors(photo):
            return np.zeros((0, 128), np.uint8)
        descriptors = _values(database.read_descriptors(photo))
        shapes = np.asarray(database.read_keypoints(photo), np.float64)[:, 2:]
    areas = np.abs(shapes[:, 0] * shapes[:, 3] - shapes[:, 1] * shapes[:, 2])
    return descriptors[np.argsort(-areas, kind="stable")[:most]]


def _values(descriptors: pycolmap.FeatureDescriptors) -> NDArray[np.uint8]:
    return np.asarray(descriptors.data, np.uint8).reshape(-1, 128)
