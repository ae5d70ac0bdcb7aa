"""Projection of points into photos whose rows are read one after the other. Ours; to first order in the motion of the
camera, the model is that of Hedborg et al. 2012.

While a photo is read, its camera keeps its velocity. A row is given by its share: from -1/2, the first row that is
read, to 1/2, the last one. The pose of a photo is that of its middle row.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sfm_app.bundle_adjustment.normal_equations import Bundle
from sfm_app.geometry.lenses.projections import project_points

FloatArray = NDArray[np.float64]


class RowProjection(NamedTuple):
    """Observations as a rolling shutter sees them, and their derivatives."""

    x: FloatArray
    """(N, 2) pixels."""
    depth: FloatArray
    """(N,) of the points before the camera, at the moment of their row."""
    by_camera: FloatArray
    """(N, 2, 12)"""
    by_pose: FloatArray
    """(N, 2, 6) as of `normal_equations.project`."""
    by_motion: FloatArray
    """(N, 2, 6)"""
    by_point: FloatArray
    """(N, 2, 3)"""


def project_rows(bundle: Bundle, share: FloatArray, motion: FloatArray) -> RowProjection:
    """Project the points of all observations, each from the pose at the time of its row.

    Args:
        bundle: the model, its poses those of the middle rows.
        share: (N,) row of each observation.
        motion: (I, 6) velocity of each photo as in `PathVelocity`, times the readout.
    """
    rows, R = bundle.camera[bundle.photo], bundle.R[bundle.photo]
    points = np.einsum("nij,nj->ni", R, bundle.X[bundle.point])
    middle, moved = points + bundle.t[bundle.photo], share[:, None] * motion[bundle.photo]
    turn = Rotation.from_rotvec(moved[:, :3]).as_matrix()
    seen = np.einsum("nij,nj->ni", turn, middle + moved[:, 3:])
    found = project_points(seen, bundle.params[rows], bundle.family[rows])
    by_middle = np.einsum("nij,njk->nik", found.by_point, turn)
    by_motion = np.concatenate([np.cross(seen[:, None], found.by_point), by_middle], 2) * share[:, None, None]
    by_pose = np.concatenate([np.cross(points[:, None], by_middle), by_middle], 2)
    by_point = np.einsum("nij,njk->nik", by_middle, R)
    return RowProjection(found.x, seen[:, 2], found.by_camera, by_pose, by_motion, by_point)


def move_to_middle_row(points: FloatArray, share: FloatArray, motion: FloatArray) -> FloatArray:
    """Return points (N, 3) of a camera's frame at the time of its middle row.

    Args:
        points: (N, 3) in the camera's frame at the time of their own rows.
        share: (N,) these rows.
        motion: (6,) of the photo, as in `project_rows`.
    """
    moved = share[:, None] * motion
    return np.asarray(Rotation.from_rotvec(moved[:, :3]).inv().apply(points) - moved[:, 3:], np.float64)
