"""An image pair in which an object moves by itself: two fundamental matrices in one set of matches (thesis 4.4.2)."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import ConfigError
from sfm_app.geometry.distances import sampson_distance
from sfm_app.geometry.epipolar import fundamental_from_pose
from sfm_app.synthetic.correspondences import FAR, MAX_SETUPS, NEAR, PairOptions, TwoViews, make_pair, random_rotation

FloatArray = NDArray[np.float64]

RADIUS = (0.1, 0.2)
"""Range of the radius of the moving object, in units of the distance to the middle of the scene."""
MAX_TURN_DEG, MAX_SHIFT = 30.0, 0.3
"""Largest turn of the object about its center and shift per axis between the two images."""
LEAST_DEPARTURE_PX = 5.0
"""Median Sampson distance of the object's exact matches to the geometry of the scene: an object that slides along its
epipolar lines does not count as moving."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoMotions:
    """Matches of a still scene, of an object that moves, and outliers, in random order."""

    pair: TwoViews
    """Ground truth of the still scene; the object's matches are outliers in `is_inlier`."""
    is_moving: NDArray[np.bool_]
    """(N,), whether a match lies on the object."""
    moving_F: FloatArray
    """(3, 3) fundamental matrix of the object: x2' F x1 = 0 for its exact points, Frobenius norm 1."""


def make_two_motions(options: PairOptions, moving: float, seed: int) -> TwoMotions:
    """Return a pair as from `make_pair`, with an object that has its own rigid motion.

    Args:
        options: the pair; `points` counts all matches and `outliers` is a share of all.
        moving: share of the matches on the object, in (0, 1), smaller than the still scene's share of inliers.
        seed: same seed, same pair.

    Raises:
        ConfigError: the scene would not be the dominant motion, or no such setup is found.
    """
    count = round(moving * options.points)
    if not 0 < count < options.points - count - round(options.outliers * options.points):
        raise ConfigError("two motions: the moving object needs a share above 0 and below that of the still inliers")
    still_count = options.points - count
    outliers = round(options.outliers * options.points) / still_count
    still = make_pair(replace(options, points=still_count, outliers=outliers), seed)
    rng = np.random.default_rng([seed, 442])
    exact1, exact2, moving_F = _moving_object(still, options, count, rng)
    order = rng.permutation(options.points)

    def join(of_scene: FloatArray, of_object: FloatArray) -> FloatArray:
        return np.concatenate([of_scene, of_object])[order]

    is_moving = order >= still_count
    noise = rng.normal(scale=options.sigma_px, size=(2, count, 2))
    pair = replace(
        still,
        x1=join(still.x1, exact1 + noise[0]),
        x2=join(still.x2, exact2 + noise[1]),
        exact_x1=join(still.exact_x1, exact1),
        exact_x2=join(still.exact_x2, exact2),
        is_inlier=np.append(still.is_inlier, np.zeros(count, np.bool_))[order],
    )
    return TwoMotions(pair, is_moving, moving_F)


def _moving_object(
    still: TwoViews, options: PairOptions, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return noise-free image points of a moving ball in both images, and its fundamental matrix."""
    size = np.array([options.width, options.height])
    for _ in range(MAX_SETUPS):
        pixel = np.append(rng.uniform(size=2) * size, 1.0)
        center = np.linalg.inv(still.K1) @ pixel * rng.uniform(NEAR, FAR)
        turn = random_rotation(rng, MAX_TURN_DEG)
        shift = rng.uniform(-MAX_SHIFT, MAX_SHIFT, 3)
        R, t = still.R @ turn, still.R @ (center + shift - turn @ center) + still.t
        directions = rng.normal(size=(8 * count, 3))
        radii = rng.uniform(*RADIUS) * rng.uniform(size=(8 * count, 1)) ** (1 / 3)
        X = center + radii * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        depths = np.stack([X[:, 2], (X @ R.T + t)[:, 2]])
        X = X[(depths > NEAR / 4).all(axis=0)]
        x1, x2 = _project(still.K1, X), _project(still.K2, X @ R.T + t)
        seen = np.flatnonzero(((x1 >= 0) & (x1 <= size) & (x2 >= 0) & (x2 <= size)).all(axis=1))[:count]
        if len(seen) < count:
            continue
        if np.median(sampson_distance(still.F, x1[seen], x2[seen])) >= LEAST_DEPARTURE_PX:
            return x1[seen], x2[seen], fundamental_from_pose(still.K1, still.K2, R, t)
    raise ConfigError("no moving object is seen in both images", hint="lower max_rotation_deg or max_baseline")


def _project(K: FloatArray, X: FloatArray) -> FloatArray:
    h = X @ K.T
    return np.asarray(h[:, :2] / h[:, 2:])
