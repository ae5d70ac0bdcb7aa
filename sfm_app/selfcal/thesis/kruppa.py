"""The Kruppa equations (thesis 5.2.3), their focal-only form (Sturm 2001), and a calibrator that minimizes them.

(5.5) states  F C F' ~ [e2] C [e2]'  with C = KK' and the epipole e2. In the basis of F's own singular vectors,
F = U diag(a, b) V', it shrinks to 2 x 2 matrices (Lourakis and Deriche 1999)::

    S B S ~ adj(A),    A = U'CU,    B = V'CV,    S = diag(a, b)

Six ratios (5.6), of which two are independent and any may be 0 / 0, become three:
a^2 B11 / A22 = -ab B12 / A12 = b^2 B22 / A11. They contain no epipole.
"""

import numpy as np

from sfm_app.selfcal.pairs import Pairs
from sfm_app.selfcal.thesis.constraint_forms import Halves
from sfm_app.selfcal.thesis.least_squares import fit_camera
from sfm_app.selfcal.thesis.verdict import CameraParameters, calibrate_with
from sfm_app.settings import CalibrationSettings
from sfm_app.types import Calibration, CameraPairs
from sfm_app.types.arrays import FloatArray

METHOD = "kruppa"
VANISHED = 1e-9
"""An equation whose coefficients are all this small beside 1 holds for any focal. Double precision leaves 1e-16; the
margin was chosen by hand."""


def calibrate(pairs: CameraPairs, options: CalibrationSettings, seed: int) -> Calibration:
    """Minimize the squared Kruppa equations of all pairs, from the median of their focal-only solutions."""
    del options, seed
    return calibrate_with(METHOD, pairs, _find_camera)


def _find_camera(pairs: Pairs, tall: float, evidence: dict[str, float]) -> CameraParameters:
    focals = pair_focals(pairs, (0.5, 0.5 * tall))
    known = focals[np.isfinite(focals)]
    evidence["focal_estimates"] = float(len(known))
    start = CameraParameters.initial(tall)
    if len(known):
        start = start._replace(fx=float(np.median(known)), fy=float(np.median(known)))
    return fit_camera(pairs, start, pairs.weights, kruppa_equations)


def kruppa_ratios(halves: Halves, cameras: FloatArray) -> FloatArray:
    """Return (..., 3) the ratios a^2 B11 / A22, -ab B12 / A12, b^2 B22 / A11: equal for the right K, NaN for 0 / 0.

    The leading axes of `halves` and of cameras (..., 4) of fx, fy, u, v broadcast.
    """
    left, right = _sides(halves, cameras)
    return np.asarray(np.divide(left, right, out=np.full(left.shape, np.nan), where=right != 0))


def kruppa_equations(halves: Halves, cameras: FloatArray) -> FloatArray:
    """Return (..., 3) the equations between the ratios, multiplied out and divided by the sizes of both sides.

    They are the cross product of unit vectors, two of them independent: the norm is the sine of the angle between the
    two sides of (5.5). The arguments are those of `kruppa_ratios`.
    """
    left, right = _sides(halves, cameras)
    units = (side / np.linalg.norm(side, axis=-1, keepdims=True) for side in (left, right))
    return np.asarray(np.cross(*units))


def _sides(halves: Halves, cameras: FloatArray) -> tuple[FloatArray, FloatArray]:
    A, B = halves.grams(cameras)
    a, b = halves.s[..., 0], halves.s[..., 1]
    return np.stack([a * a, a * b, b * b], axis=-1) * B, A[..., ::-1] * np.array([1.0, -1.0, 1.0])


def pair_focals(pairs: Pairs, center: tuple[float, float]) -> FloatArray:
    """Return (P,) focals of the pairs for square pixels and a known center (Sturm 2001), in the units of the pairs.

    The two equations with the off-diagonal entries are linear in f^2 once the trivial root f = 1 is divided out; they
    fail where the optical axes lie in one plane. The third is quadratic. Of the solutions of all, the one that
    satisfies all three best is returned; NaN where the equations hold for any focal, or for none.
    """
    to_center = np.array([[1.0, 0.0, center[0]], [0.0, 1.0, center[1]], [0.0, 0.0, 1.0]])
    centered = Halves.from_fundamentals(to_center.T @ pairs.F @ to_center)
    linear, quadratic = _focal_polynomials(centered)
    squares = np.column_stack([_common_root(linear), *_roots(quadratic).T])
    focals = np.sqrt(np.where(squares > 0, squares, np.nan))
    cameras = np.stack([focals, focals, np.zeros_like(focals), np.zeros_like(focals)], axis=-1)
    rows = np.arange(len(pairs))
    errors = np.linalg.norm(kruppa_equations(centered[rows[:, None]], cameras), axis=-1)
    return np.asarray(focals[rows, np.argmin(np.where(np.isfinite(errors), errors, np.inf), axis=1)])


def _common_root(linear: FloatArray) -> FloatArray:
    """Return (P,) least-squares roots of two lines each; NaN where both slopes vanish."""
    slopes, roots = linear[:, :, 1], np.full(len(linear), np.nan)
    known = np.max(np.abs(slopes), axis=1) > VANISHED
    roots[known] = -np.sum(linear[:, :, 0] * slopes, axis=1)[known] / np.sum(slopes**2, axis=1)[known]
    return roots


def _roots(quadratic: FloatArray) -> FloatArray:
    """Return (P, 2) real roots, NaN where there are fewer or the polynomial vanishes."""
    found = np.full((len(quadratic), 2), np.nan)
    for row, coefficients in zip(found, quadratic, strict=True):
        size = np.max(np.abs(coefficients))
        if size > VANISHED:
            # coefficients of the size of rounding would only add a root far out
            kept = np.where(np.abs(coefficients) > VANISHED * size, coefficients, 0.0)
            roots = np.polynomial.polynomial.polyroots(np.trim_zeros(kept, "b"))
            row[: len(roots)] = np.where(np.isreal(roots), roots.real, np.nan)
    return found


def _focal_polynomials(halves: Halves) -> tuple[FloatArray, FloatArray]:
    """Return (P, 2, 2) linear and (P, 3) quadratic equations in f^2, lowest power first.

    With C = diag(f^2, f^2, 1) and third entries p_i of u_i, q_i of v_i: A_ij = f^2 (delta_ij - p_i p_j) + p_i p_j.
    """
    a, b = halves.s[:, 0], halves.s[:, 1]
    (p1, p2), (q1, q2) = halves.U[:, :, 2].T, halves.V[:, :, 2].T
    common = a * p1 * q1 + b * p2 * q2
    first = [p2 * q1 * common, a * p1 * p2 * (1 - q1**2) + b * q1 * q2 * (1 - p2**2)]
    second = [p1 * q2 * common, a * q1 * q2 * (1 - p1**2) + b * p1 * p2 * (1 - q2**2)]
    quadratic = [
        (a * p1 * q1) ** 2 - (b * p2 * q2) ** 2,
        a**2 * (p1**2 + q1**2 - 2 * (p1 * q1) ** 2) - b**2 * (p2**2 + q2**2 - 2 * (p2 * q2) ** 2),
        a**2 * (1 - p1**2) * (1 - q1**2) - b**2 * (1 - p2**2) * (1 - q2**2),
    ]
    linear = np.stack([np.stack(equation, axis=-1) for equation in (first, second)], axis=1)
    return linear, np.stack(quadratic, axis=-1)
