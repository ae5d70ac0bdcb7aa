"""The Huang-Faugeras constraint on one F: E = K'FK has two equal singular values (thesis 5.2.4, 5.8.2).

F has rank 2, so E has singular values s1 >= s2 and 0, and everything follows from two numbers without an SVD::

    a = tr(EE') = s1^2 + s2^2        the sum of the squared entries of E
    p = (s1 s2)^2                    the sum of the squared 2x2 minors of E

The minors of F form the matrix q e2 e1' (unit epipoles e1, e2, and q the product of F's singular values), those of a
product are the products of the minors, and the minors of K come from adj(K). Hence::

    p = q^2 |adj(K) e2|^2 |adj(K) e1|^2

Thesis (5.25) is then  2 tr((EE')^2) - tr(EE')^2 = (s1^2 - s2^2)^2 = a^2 - 4p. It is never negative: with noise its
zeros are isolated points, and the thesis's "zero curve" is the real part of a pair of complex roots.
"""

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.selfcal.pairs import Pairs
from sfm_app.types.arrays import FloatArray

VANISHED = 1e-12
"""A polynomial is zero when it is this small beside the terms whose difference it is. Double precision leaves 1e-16;
the margin was chosen by hand (docs/algorithms.md, The thesis's methods)."""


@kernel
def singular_value_ratio(pair: FloatArray, fx: float, fy: float, u: float, v: float) -> float:
    """Return r = (s1 - s2) / (s1 + s2) of E = K'FK, in [0, 1]; 0 where K satisfies the constraint.

    Unlike thesis (5.8) it is bounded, symmetric in the two views, and free of the scale of F. `pair` is a row (16,) of
    `Pairs.packed_rows`.
    """
    f11, f12, f13 = pair[0], pair[1], pair[2]
    f21, f22, f23 = pair[3], pair[4], pair[5]
    f31, f32, f33 = pair[6], pair[7], pair[8]
    g13, g23 = f11 * u + f12 * v + f13, f21 * u + f22 * v + f23
    g31, g32 = f11 * u + f21 * v + f31, f12 * u + f22 * v + f32
    g33 = f31 * u + f32 * v + f33 + u * g13 + v * g23
    x, y = fx * fx, fy * fy
    a = x * x * f11 * f11 + x * y * (f12 * f12 + f21 * f21) + y * y * f22 * f22
    a += x * (g13 * g13 + g31 * g31) + y * (g23 * g23 + g32 * g32) + g33 * g33
    n1 = y * (pair[9] - u * pair[11]) ** 2 + x * (pair[10] - v * pair[11]) ** 2 + x * y * pair[11] ** 2
    n2 = y * (pair[12] - u * pair[14]) ** 2 + x * (pair[13] - v * pair[14]) ** 2 + x * y * pair[14] ** 2
    twice = 2.0 * pair[15] * np.sqrt(n1 * n2)
    if not a + twice > 0.0:
        return 1.0
    # (s1 - s2)^2 / (s1 + s2)^2; rounding may push the numerator below zero
    return float(np.sqrt(max(a - twice, 0.0) / (a + twice)))


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
    padded: NDArray[np.float64] = np.zeros((*polynomial.shape[:-1], length))
    padded[..., : polynomial.shape[-1]] = polynomial
    return padded


def _multiply(p: FloatArray, q: FloatArray) -> FloatArray:
    product = np.zeros((*np.broadcast_shapes(p.shape[:-1], q.shape[:-1]), p.shape[-1] + q.shape[-1] - 1))
    for power in range(p.shape[-1]):
        product[..., power : power + q.shape[-1]] += p[..., power, None] * q
    return product
