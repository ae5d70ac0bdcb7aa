"""Scores of a walk without a true model: by the order of the photos, or by the poses of another camera beside it."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from benchmarks.common.metrics import Pose
from sfm_app.geometry.poses import Similarity, umeyama

LONG_STEPS = 5.0
"""A step of more than this many median steps is a jump."""
ROBUST_SCALE = 0.02
"""Scale of the robust loss on the offset camera's residuals: 2 cm, or a degree; the truth of a Kinect."""


class Order(NamedTuple):
    """How well the centers of a model follow the order of the photos; 1 is perfect."""

    axis: float
    """Rank correlation of the photos' order by name with their place along the main axis; for straight walks."""
    distance: float
    """Rank correlation of |i - j| with the distance between the centers i and j; for walks that bend, too."""
    jumps: int
    """Number of steps between consecutive photos that are much longer than the median."""


def order_scores(poses: Mapping[str, Pose]) -> Order | None:
    """Score the order of a model's photos; None with fewer than three, or where all centers coincide."""
    if len(poses) < 3:
        return None
    centers = _centers([poses[name] for name in sorted(poses)])
    if np.ptp(centers, axis=0).max() == 0:
        return None
    main = np.linalg.svd(centers - centers.mean(0), full_matrices=False)[2][0]
    i, j = np.triu_indices(len(centers), 1)
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    return Order(
        abs(float(spearmanr(np.arange(len(centers)), centers @ main).statistic)),
        float(spearmanr(j - i, np.linalg.norm(centers[i] - centers[j], axis=1)).statistic),
        int(np.count_nonzero(steps > LONG_STEPS * np.median(steps))),
    )


class Offset(NamedTuple):
    """Residuals between a model and the poses of a camera that was fixed beside ours."""

    center: NDArray[np.float64]
    """By photo, in units of the truth."""
    rotation_deg: NDArray[np.float64]
    shift: float
    """Distance between the two cameras, in units of the truth."""
    turn_deg: float
    """Angle between the two cameras."""
    world: Similarity
    """From the model to the world of the truth."""


def offset_errors(found: Mapping[str, Pose], truth: Mapping[str, Pose]) -> Offset | None:
    """Fit the similarity of the worlds and the offset of the cameras jointly and robustly; return the residuals.

    None with fewer than four photos, since three fit any offset.
    """
    names = sorted(set(found) & set(truth))
    if len(names) < 4:
        return None
    ours, true = [found[name] for name in names], [truth[name] for name in names]
    Ra, Rb = (np.array([pose[:, :3] for pose in poses]) for poses in (ours, true))
    Ca, Cb = _centers(ours), _centers(true)
    start = umeyama(Ca, Cb)

    def residuals(p: NDArray[np.float64]) -> NDArray[np.float64]:
        turn, world = Rotation.from_rotvec(p[:3]).as_matrix(), Rotation.from_rotvec(p[3:6]).as_matrix()
        turned = np.einsum("ij,njk,lk->nil", turn, Ra, world)
        rotation = Rotation.from_matrix(np.einsum("nij,nkj->nik", turned, Rb)).as_rotvec()
        beside = np.einsum("nji,j->ni", Rb, p[10:13])
        center = np.exp(p[6]) * np.einsum("ij,nj->ni", world, Ca) + p[7:10] + beside - Cb
        return np.concatenate([rotation.ravel(), center.ravel()])

    world = Rotation.from_matrix(start.R).as_rotvec()
    first = np.concatenate([np.zeros(3), world, [np.log(start.scale)], start.t, np.zeros(3)])
    fit = least_squares(residuals, first, loss="soft_l1", f_scale=ROBUST_SCALE)
    rotation, center = np.linalg.norm(residuals(fit.x).reshape(2, -1, 3), axis=2)
    return Offset(
        center,
        np.degrees(rotation),
        float(np.linalg.norm(fit.x[10:13])),
        float(np.degrees(np.linalg.norm(fit.x[:3]))),
        Similarity(float(np.exp(fit.x[6])), Rotation.from_rotvec(fit.x[3:6]).as_matrix(), fit.x[7:10]),
    )


def _centers(poses: Sequence[Pose]) -> NDArray[np.float64]:
    return np.array([-pose[:, :3].T @ pose[:, 3] for pose in poses])
