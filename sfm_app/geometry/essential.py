"""Essential matrices and the relative poses that they encode."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangulation import triangulate

Array = NDArray[np.float64]


def essential_from_fundamental(F: Array, K1: Array, K2: Array) -> Array:
    """Return the essential matrix nearest to K2' F K1 (thesis Eq. 5.7; Eq. 2.30 inverts K by misprint).

    Args:
        F: (3, 3), any scale, x2' F x1 = 0 in pixels.
        K1: (3, 3) camera matrix of view 1.
        K2: (3, 3) camera matrix of view 2.

    Returns:
        (3, 3) with singular values (1, 1, 0).
    """
    return nearest_essential(K2.T @ F @ K1)


def nearest_essential(E: Array) -> Array:
    """Return the essential matrix nearest to E (3, 3), with singular values (1, 1, 0).

    Noise makes the singular values of E unequal; in the nearest essential matrix in the Frobenius norm their mean
    replaces both, and the third is 0 (Hartley & Zisserman, 2nd ed., section 11.7.3). Its scale is then set to 1.
    """
    U, _, Vt = np.linalg.svd(E)
    nearest: Array = U @ np.diag([1.0, 1.0, 0.0]) @ Vt
    return nearest


def decompose_essential(E: Array) -> list[tuple[Array, Array]]:
    """Return the four poses (R, t) of view 2 from view 1 that E allows (thesis Eq. 2.32 with corrected signs).

    The thesis's U W V' is a rotation only if det(U) det(V) = 1, which an SVD does not guarantee, so both are
    made rotations first. t has length 1; the scale is not observable.
    """
    U, _, Vt = np.linalg.svd(E)
    U = U * np.sign(np.linalg.det(U))
    Vt = Vt * np.sign(np.linalg.det(Vt))
    W = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    t = U[:, 2]
    return [(R, sign * t) for R in (U @ W @ Vt, U @ W.T @ Vt) for sign in (1.0, -1.0)]


def relative_pose(E: Array, x1: Array, x2: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
    """Choose the one of the four poses of E with most points in front of both cameras.

    Args:
        E: (3, 3) essential matrix.
        x1: (N, 2) normalized image points of view 1, that is (K1^-1 x)_1,2.
        x2: (N, 2) partners in view 2.

    Returns:
        R (3, 3) and t (3,) of view 2 from view 1; X (N, 3) points in the frame of view 1; in_front (N,) whether a point
        lies in front of both cameras.
    """
    found = []
    for R, t in decompose_essential(E):
        X = triangulate(np.eye(3, 4), np.column_stack([R, t]), x1, x2)
        known = np.isfinite(X[:, 2])
        with np.errstate(invalid="ignore"):  # some BLAS warn of points at infinity, others do not
            in_front = known & (X[:, 2] > 0) & ((X @ R.T + t)[:, 2] > 0)
        found.append((int(np.count_nonzero(in_front)), R, t, X, in_front))
    _, R, t, X, in_front = max(found, key=lambda pose: pose[0])
    return R, t, X, in_front
