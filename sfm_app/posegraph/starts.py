"""Initial relative poses of a fit, where F does not determine how far the camera has turned.

With a long lens, matches determine the directions of the epipolar lines, but hardly where they meet: the rotation
of E = K2' F K1 is then due to noise, and a fit that starts there ends in a wrong local minimum. But the lines of both
views determine everything except that turn, if camera 2 looks at what camera 1 looked at. So several turns are tried.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.epipolar import cross_matrix

FloatArray = NDArray[np.float64]

LEAST_PLANAR = 8
"""Least number of matches: a homography has eight parameters, a match determines two, and half should be redundant.
Counted."""
TURNS_DEG = (-55.0, -30.0, -12.0, 12.0, 30.0, 55.0)
"""Turns about the scene. On the 30 pairs of a long-lens orbit (dinoSparseRing, K given) these lead to the best pose
that 24 turns from -60 to 60 lead to; the choice rests on that set alone, and only adds starts elsewhere.
docs/algorithms.md, From K to relative poses."""


def planar_starts(used: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield up to four R and t that explain the matches if their points lie on one plane.

    Args:
        used: (N, 4) inliers as points of the plane z = 1, view 1 and view 2.
    """
    if len(used) < LEAST_PLANAR:
        return
    try:
        H, _ = cv2.findHomography(used[:, :2], used[:, 2:], 0)
    except cv2.error:
        return
    if H is None or not np.isfinite(H).all() or abs(np.linalg.det(H)) < 1e-12:
        return
    _, rotations, steps, _ = cv2.decomposeHomographyMat(H, np.eye(3))
    for R, t in zip(rotations, steps, strict=True):
        length = float(np.linalg.norm(t))
        if np.isfinite(R).all() and length > 1e-9:
            yield np.asarray(R, np.float64), np.asarray(t, np.float64).ravel() / length


def turned_starts(used: FloatArray, E: FloatArray) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield R and t of a camera that has turned about the middle of the scene, for every turn of `TURNS_DEG`.

    Args:
        used: (N, 4) inliers as points of the plane z = 1, view 1 and view 2.
        E: (3, 3) of any scale; only the directions of its epipolar lines through the middle are used.
    """
    if not len(used):  # panoramas that look away from each other
        return
    middles = np.median(used, axis=0)
    first, second = np.append(middles[:2], 1.0), np.append(middles[2:], 1.0)
    # near the middles g1 dx1 + g2 dx2 = 0: what moves along g1 in view 1 moves against g2 in view 2
    g1, g2 = (E.T @ second)[:2], (E @ first)[:2]
    lengths = np.hypot(*g1), np.hypot(*g2)
    if min(lengths) <= 1e-12 * max(*lengths, 1e-300):
        return
    roll = np.arctan2(-g2[1], -g2[0]) - np.arctan2(g1[1], g1[0])
    K = cross_matrix(np.append(g1 / lengths[0], 0.0))
    angles = np.radians(TURNS_DEG)[:, None, None]
    upright = np.array([[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]])
    turns = upright @ (np.eye(3) + np.sin(angles) * K + (1.0 - np.cos(angles)) * (K @ K))  # Rodrigues
    steps = lengths[1] / lengths[0] * second - turns @ first  # the middle of the scene stays in the middle
    for R, t, length in zip(turns, steps, np.linalg.norm(steps, axis=1), strict=True):
        if length > 1e-9:
            yield R, t / length
