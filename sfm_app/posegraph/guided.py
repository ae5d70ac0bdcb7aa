"""Poses re-estimated with the rotation known from other pairs, so that only the direction of translation is sought.

F of few matches on a facade also fits mismatches that lie right by accident. With the rotation known from loops of
other pairs, two matches determine the direction, and the matches that then agree are of the scene.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sfm_app.geometry.lenses.ray_epipolar import FIRST, SECOND
from sfm_app.posegraph.pair_pose import Pair, is_in_front
from sfm_app.posegraph.refine import pose_distances, refine_pose
from sfm_app.types import RelativePose

FloatArray = NDArray[np.float64]

SAMPLES = 200
"""Samples of two matches, each of which gives a direction (docs/algorithms.md, From K to relative poses). Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
MIN_KEPT_SHARE = 0.9
"""A pose whose rotation diverges is accepted with the rotation of the other pairs, if that keeps this share of its
inliers: a long lens does not determine how far the camera has turned. docs/algorithms.md, From K to relative poses.
Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
HELD_ROUNDS, HELD_SIGMA = 8, 0.2
"""Rounds of reweighted least squares with fixed rotation, and the scale of the loss in thresholds. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""
NEAR_THRESHOLDS = 3.0
"""With the rotation of the other pairs, matches within this many thresholds are used. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
LEAST_IN_FRONT, MOST_TURN_DEG = 0.95, 2.0
"""A guided pose is accepted if at least this share of its inliers lies in front of both cameras and its rotation
changed by at most this angle. On the photo sets with truth none of the pairs found so was wrong (docs/algorithms.md,
From K to relative poses)."""


def guided_pose(pair: Pair, R: FloatArray, min_inliers: int, seed: int) -> RelativePose | None:
    """Estimate the pose of a pair whose rotation is known; None if its matches do not confirm it.

    Args:
        pair: matches and cameras.
        R: (3, 3) rotation of view 2 from view 1, known from the other pairs.
        min_inliers: least number of inliers of a pose.
        seed: seed of the sampling.
    """
    if len(pair.lines) < min_inliers:
        return None
    t = sample_direction(pair, R, np.random.default_rng(seed))
    if t is None:
        return None
    near = pose_distances(pair.lines, R, t) <= NEAR_THRESHOLDS * pair.max_error_px
    if np.count_nonzero(near) < min_inliers:
        return None
    turned, moved = refine_pose(pair.lines[near], R, t)
    inliers = pair.inliers(turned, moved)
    if np.count_nonzero(inliers) < min_inliers:
        return None
    if np.degrees(Rotation.from_matrix(R.T @ turned).magnitude()) > MOST_TURN_DEG:
        free = np.count_nonzero(inliers)
        turned, moved = R, refine_direction(pair, R, t)
        inliers = pair.inliers(turned, moved)
        if np.count_nonzero(inliers) < max(min_inliers, MIN_KEPT_SHARE * free):
            return None
    found = pair.pose(turned, moved, inliers, guided=True)
    return found if found.in_front >= LEAST_IN_FRONT and found.kind != "rotation" else None


def _epipolar_normals(pair: Pair, R: FloatArray) -> FloatArray:
    """Return (N, 3), for each match the vector that the translation is perpendicular to, given R."""
    return np.asarray(np.cross(pair.lines[:, FIRST] @ R.T, pair.lines[:, SECOND]), np.float64)


def refine_direction(pair: Pair, R: FloatArray, t: FloatArray) -> FloatArray:
    """Refine the direction of translation (3,) by robust least squares of the distances, with R fixed.

    Args:
        pair: matches and cameras.
        R: (3, 3) rotation of view 2 from view 1; it is kept fixed.
        t: (3,) unit vector to start from.
    """
    normals = _epipolar_normals(pair, R)
    best = t
    for _ in range(HELD_ROUNDS):
        distances = pose_distances(pair.lines, R, best) / (HELD_SIGMA * pair.max_error_px)
        algebraic = np.abs(np.einsum("ni,i->n", normals, best))
        # Sampson's distance is the algebraic one over its gradient, which hardly changes with t
        gradients = np.where(distances > 0, algebraic / np.maximum(distances, 1e-12), 1.0)
        weights = 1.0 / (np.maximum(gradients, 1e-12) ** 2 * (1.0 + distances**2))
        _, axes = np.linalg.eigh(np.einsum("n,ni,nj->ij", weights, normals, normals))
        best = axes[:, 0] * np.sign(axes[:, 0] @ t or 1.0)
    return np.asarray(best, np.float64)


def sample_direction(pair: Pair, R: FloatArray, rng: np.random.Generator) -> FloatArray | None:
    """Estimate the direction of translation (3,) that most matches agree with, given R.

    It is the best of `SAMPLES` directions from two matches each; None if no sample gives one.

    Args:
        pair: matches and cameras.
        R: (3, 3) rotation of view 2 from view 1; it is kept fixed.
        rng: draws the samples; its state moves on.
    """
    normals = _epipolar_normals(pair, R)
    picks = rng.integers(len(normals), size=(SAMPLES, 2))
    found = np.cross(normals[picks[:, 0]], normals[picks[:, 1]])
    lengths = np.linalg.norm(found, axis=1)
    best, lowest = None, np.inf
    for t in found[lengths > 1e-12] / lengths[lengths > 1e-12, None]:
        distances = pose_distances(pair.lines, R, t) / pair.max_error_px
        cost = float(np.sum(distances**2 / (1.0 + distances**2)))
        if cost < lowest:
            best, lowest = np.asarray(t, np.float64), cost
    if best is None:
        return None
    # t and -t have the same epipolar lines
    front, behind = (np.count_nonzero(is_in_front(pair.lines, R, sign * best)) for sign in (1.0, -1.0))
    return best if front >= behind else -best
