"""Zero curves: the roots of one pair's constraint, swept over a parameter (thesis 5.8.3).

With a and p of `selfcal.consensus`, thesis (5.25) is  2 tr((EE')^2) - tr(EE')^2 = (s1^2 - s2^2)^2 = a^2 - 4p. It is
never negative: with noise its zeros are isolated points, and the thesis's "zero curve" is the real part of a pair of
complex roots.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.selfcal.pairs import Pairs
from sfm_app.types.arrays import FloatArray

VANISHED = 1e-12
"""A polynomial is zero when it is this small beside the terms whose difference it is. Double precision leaves 1e-16;
the margin was chosen by hand (docs/algorithms/self-calibration.md)."""


def focal_polynomials(pairs: Pairs, fx: FloatArray, center: tuple[float, float]) -> FloatArray:
    """Return thesis (5.27): a^2 - 4p as a quartic in fy^2, for swept fx (S,) and a fixed center (u, v).

    Coefficients (P, S, 5), lowest power first; all zero where the constraint holds for any fy.
    """
    u, v = center
    C = np.array([[1.0, 0.0, u], [0.0, 1.0, v], [0.0, 0.0, 1.0]])
    G = (C.T @ pairs.F @ C) ** 2
    x = (fx**2)[None, :]
    one = np.ones_like(x)
    a = _stack(
        x**2 * _column(G[:, 0, 0]) + x * _column(G[:, 0, 2] + G[:, 2, 0]) + one * _column(G[:, 2, 2]),
        x * _column(G[:, 0, 1] + G[:, 1, 0]) + one * _column(G[:, 1, 2] + G[:, 2, 1]),
        one * _column(G[:, 1, 1]),
    )
    n1, n2 = (
        _stack(
            x * _column(e[:, 1] - v * e[:, 2]) ** 2,
            one * _column(e[:, 0] - u * e[:, 2]) ** 2 + x * _column(e[:, 2]) ** 2,
        )
        for e in (pairs.e1, pairs.e2)
    )
    return _constraint_polynomial(a, n1, n2, pairs.product)


def center_polynomials(pairs: Pairs, u: FloatArray, focal: tuple[float, float]) -> FloatArray:
    """Return thesis (5.28): a^2 - 4p as an octic in v, for swept u (S,) and fixed focals (fx, fy).

    Coefficients (P, S, 9), lowest power first; all zero where the constraint holds for any v.
    """
    x, y = focal[0] ** 2, focal[1] ** 2
    F = pairs.F[:, None, :, :]
    t = u[None, :]
    g13, g31 = F[..., 0, 2] + t * F[..., 0, 0], F[..., 2, 0] + t * F[..., 0, 0]
    g23, g32 = F[..., 1, 2] + t * F[..., 1, 0], F[..., 2, 1] + t * F[..., 0, 1]
    g33 = F[..., 2, 2] + t * (F[..., 0, 2] + F[..., 2, 0]) + t**2 * F[..., 0, 0]
    fixed = x * x * F[..., 0, 0] ** 2 + x * y * (F[..., 0, 1] ** 2 + F[..., 1, 0] ** 2) + y * y * F[..., 1, 1] ** 2
    zero = np.zeros_like(g33)
    a = _pad(_stack(fixed + zero), 5)
    for factor, low, slope in (
        (x, g13, F[..., 0, 1]),
        (x, g31, F[..., 1, 0]),
        (y, g23, F[..., 1, 1]),
        (y, g32, F[..., 1, 1]),
    ):
        line = _stack(low, slope + zero)
        a += factor * _pad(_multiply(line, line), 5)
    corner = _stack(g33, g23 + g32, F[..., 1, 1] + zero)
    a += _multiply(corner, corner)
    n1, n2 = (_epipole_polynomial(e[:, None, :], t, x, y) for e in (pairs.e1, pairs.e2))
    return _constraint_polynomial(a, n1, n2, pairs.product)


def _epipole_polynomial(e: FloatArray, t: FloatArray, x: float, y: float) -> FloatArray:
    """Return |adj(K) e|^2 as a quadratic in v."""
    fixed = y * (e[..., 0] - t * e[..., 2]) ** 2 + x * y * e[..., 2] ** 2
    one = np.ones_like(fixed)
    line = _stack(e[..., 1] * one, -e[..., 2] * one)
    return _pad(_stack(fixed), 3) + x * _multiply(line, line)


def _constraint_polynomial(a: FloatArray, n1: FloatArray, n2: FloatArray, product: FloatArray) -> FloatArray:
    square = _multiply(a, a)
    minors = 4.0 * (product**2)[:, None, None] * _multiply(n1, n2)
    difference = square - _pad(minors, square.shape[-1])
    size = np.max(np.abs(square), axis=-1, keepdims=True)
    vanished = np.max(np.abs(difference), axis=-1, keepdims=True) <= VANISHED * size
    return np.where(vanished, 0.0, difference)


def _column(values: FloatArray) -> FloatArray:
    return values[:, None]


def _stack(*coefficients: FloatArray) -> FloatArray:
    return np.stack(coefficients, axis=-1)


def _pad(polynomial: FloatArray, length: int) -> FloatArray:
    padded: FloatArray = np.zeros((*polynomial.shape[:-1], length))
    padded[..., : polynomial.shape[-1]] = polynomial
    return padded


def _multiply(p: FloatArray, q: FloatArray) -> FloatArray:
    product = np.zeros((*np.broadcast_shapes(p.shape[:-1], q.shape[:-1]), p.shape[-1] + q.shape[-1] - 1))
    for power in range(p.shape[-1]):
        product[..., power : power + q.shape[-1]] += p[..., power, None] * q
    return product


ComplexArray = NDArray[np.complex128]


def companion_roots(coefficients: FloatArray) -> ComplexArray:
    """Return all roots (..., n) of polynomials (..., n + 1), lowest power first: eigenvalues of companion matrices.

    A polynomial of lower degree has roots far out in place of the missing ones; one that vanishes has all roots 0.
    """
    vanished = np.all(coefficients == 0, axis=-1, keepdims=True)
    scaled = coefficients / np.where(vanished, 1.0, np.max(np.abs(coefficients), axis=-1, keepdims=True))
    smallest, lead = np.finfo(np.float64).eps, scaled[..., -1:]
    lead = np.where(np.abs(lead) < smallest, np.copysign(smallest, lead), lead)
    degree = coefficients.shape[-1] - 1
    companion = np.zeros((*coefficients.shape[:-1], degree, degree))
    companion[..., np.arange(1, degree), np.arange(degree - 1)] = 1.0
    companion[..., :, -1] = -scaled[..., :-1] / lead
    companion[vanished[..., 0]] = 0.0
    return np.linalg.eigvals(companion).astype(np.complex128)


ROOT_IS_ZERO = 1e-9
"""A real part below this, in image widths, counts as zero: such roots are spurious; by hand."""
MAX_OUT_OF_RANGE = 0.5
"""A curve with a larger share of samples out of range is degenerate (thesis 5.8.4, Eq. 5.35)."""


def focal_curves(pairs: Pairs, fx: FloatArray, center: tuple[float, float]) -> FloatArray:
    """Return Z^f of thesis (5.29), (5.31): (P, S) fy at every swept fx (S,), in the units of the pairs.

    It is 0 where no root has a non-zero real part, and not clipped to a range: `degeneracy` counts values out of range.
    """
    coefficients = focal_polynomials(pairs, fx, center)
    # the quartic is in fy^2: a negative fy^2 becomes an fy without real part, which the choice of the root skips
    roots = np.sqrt(companion_roots(coefficients))
    # the imaginary part is to be "approximately zero": roots in which it prevails form tails near fy = 0 on which all
    # curves agree, whatever the camera
    return _select_roots(np.where(np.abs(roots.imag) <= np.abs(roots.real), roots, 0.0))


def center_curves(pairs: Pairs, u: FloatArray, focal: tuple[float, float]) -> FloatArray:
    """Return Z^oc of thesis (5.30): (P, S) v at every swept u (S,); as `focal_curves`."""
    return _select_roots(companion_roots(center_polynomials(pairs, u, focal)))


def degeneracy(curves: FloatArray, upper: float) -> FloatArray:
    """Return the share of the samples of each curve (P, S) outside of (0, upper) (thesis 5.35)."""
    return np.asarray(np.mean((curves <= ROOT_IS_ZERO) | (curves >= upper), axis=1))


def usable_curves(curves: FloatArray, upper: float) -> FloatArray:
    """Return the curves that are not degenerate."""
    return curves[degeneracy(curves, upper) <= MAX_OUT_OF_RANGE]


def _select_roots(roots: ComplexArray) -> FloatArray:
    """Return, per sample, the real part of the root with non-zero real part and the smallest imaginary part."""
    imaginary = np.where(np.abs(roots.real) > ROOT_IS_ZERO, np.abs(roots.imag), np.inf)
    best = np.argmin(imaginary, axis=-1)[..., None]
    value = np.take_along_axis(roots.real, best, axis=-1)[..., 0]
    found = np.isfinite(np.take_along_axis(imaginary, best, axis=-1)[..., 0])
    return np.where(found, value, 0.0)
