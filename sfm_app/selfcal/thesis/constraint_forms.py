"""The forms of the Huang-Faugeras constraint (thesis 5.2.4, 5.2.5, 5.8.2): E = K'FK has two equal singular values.

Every form here is divided by the power of |E| that makes it free of the scale of F. With singular values s1 >= s2 >= 0
and 0 of E, and d = (s1^2 - s2^2) / (s1^2 + s2^2)::

    Frobenius form (5.9)     d
    polynomial (5.25)        d^2
    Trivedi (5.11)           three values whose sum is d^2

so that on matrices of rank 2 all vanish together with (5.8), (s1 - s2) / s2. The setting `calibration.constraint_form`
says which of them the least-squares calibrators minimize. (5.8) as it stands has a cone at the solution; `Halves` gives
what least squares needs: smooth equations that change sign there, two for every pair.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from sfm_app.settings import ConstraintForm
from sfm_app.types.arrays import FloatArray, IndexArray

_TINY = float(np.finfo(np.float64).tiny)
"""The smallest normal number in double precision; added to divisors, so that none is zero."""
LEAST_COMPLEMENT = 1e-6
"""(5.8) divides by s2; 1 - r is held above this, so that rank 1 gives a large number, not infinity; by hand."""


def essential(F: FloatArray, K: FloatArray) -> FloatArray:
    """Return (..., 3, 3) E = K'FK (thesis 5.7)."""
    return np.asarray(K.T @ F @ K)


def huang_faugeras(E: FloatArray) -> FloatArray:
    """Return (...,) the terms (s1 - s2) / s2 of thesis (5.8) for E (..., 3, 3); inf for rank 1."""
    s = np.linalg.svd(E, compute_uv=False)
    infinite = np.full(s.shape[:-1], np.inf)
    return np.asarray(np.divide(s[..., 0] - s[..., 1], s[..., 1], out=infinite, where=s[..., 1] > 0))


def frobenius_form(E: FloatArray) -> FloatArray:
    """Return (..., 9) the entries of (2 EE'E - tr(EE') E) / |E|^3, whose norm is thesis (5.9)."""
    S = E @ np.swapaxes(E, -1, -2)
    trace = np.trace(S, axis1=-2, axis2=-1)[..., None, None] + _TINY
    return np.asarray((2 * S @ E - trace * E) / trace**1.5).reshape(*E.shape[:-2], 9)


def polynomial_form(E: FloatArray) -> FloatArray:
    """Return (..., 1) 2 tr((EE')^2) / tr(EE')^2 - 1 of thesis (5.25), which touches zero and does not cross it."""
    S = E @ np.swapaxes(E, -1, -2)
    trace = np.trace(S, axis1=-2, axis2=-1) + _TINY
    return np.asarray(2 * np.sum(S * S, axis=(-2, -1)) / trace**2 - 1.0)[..., None]


def trivedi(E: FloatArray) -> FloatArray:
    """Return (..., 3) the terms 4 S_ij^2 - (tr S - 2 S_ii)(tr S - 2 S_jj) of thesis (5.11), over tr(S)^2, with S = EE'.

    For ij = 12, 13, 23: with i = j, which (5.11) does not exclude, the term is tr S (4 S_ii - tr S), and vanishes for
    no particular camera.
    """
    S = E @ np.swapaxes(E, -1, -2)
    trace = np.trace(S, axis1=-2, axis2=-1)[..., None] + _TINY
    rest = trace - 2 * np.diagonal(S, axis1=-2, axis2=-1)
    i, j = [0, 0, 1], [1, 2, 2]
    return np.asarray((4 * S[..., i, j] ** 2 - rest[..., i] * rest[..., j]) / trace**2)


@dataclass(frozen=True, slots=True, eq=False)
class Halves:
    """F = U S V' of rank 2, kept as its two non-zero singular values and their vectors; the epipoles are left out.

    K'U and K'V span the column and row space of E. With the Gram matrices A = U'KK'U = L L' and B = V'KK'V = N N', the
    singular values of E are those of the 2 x 2 matrix M = L'S N, and the Kruppa equations are relations of A, S and B.
    """

    U: FloatArray
    """(..., 2, 3) rows u1, u2."""
    V: FloatArray
    """(..., 2, 3) rows v1, v2."""
    s: FloatArray
    """(..., 2) singular values, falling."""

    @classmethod
    def from_fundamentals(cls, F: FloatArray) -> "Halves":
        """Return the factors (P, ...) of matrices (P, 3, 3) of rank 2, scaled to Frobenius norm 1."""
        U, s, Vt = np.linalg.svd(F)
        s = s[:, :2] / np.linalg.norm(s[:, :2], axis=1, keepdims=True)
        return cls(np.swapaxes(U, 1, 2)[:, :2], Vt[:, :2], s)

    def __getitem__(self, rows: IndexArray) -> "Halves":
        """Return the factors at the given indices, which may have any shape."""
        return Halves(self.U[rows], self.V[rows], self.s[rows])

    def grams(self, cameras: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the entries 11, 12, 22 of A and B, each (..., 3), for cameras (..., 4) of fx, fy, u, v."""
        return _gram(self.U, cameras), _gram(self.V, cameras)

    def essential(self, cameras: FloatArray) -> FloatArray:
        """Return (..., 3, 3) E = K'FK for cameras (..., 4) of fx, fy, u, v."""
        left, right = _transform_basis(self.U, cameras), _transform_basis(self.V, cameras)
        return np.asarray(np.swapaxes(left * self.s[..., None], -1, -2) @ right)


def equations(halves: Halves, cameras: FloatArray) -> FloatArray:
    """Return (..., 2) smooth equations of every pair whose norm is r = (s1 - s2) / (s1 + s2) of E.

    A 2 x 2 matrix is the sum of a similarity (a, -d; d, a) and a reflected one (b, c; c, -b); its singular values are
    the sum and the difference of their sizes. M has a positive determinant, so the similarity is the larger one, and
    the equations are (b, c) / |(a, d)|. The leading axes of `halves` and of cameras (..., 4) of fx, fy, u, v broadcast.
    """
    A, B = halves.grams(cameras)
    l11, l21, l22 = _cholesky(A)
    n11, n21, n22 = _cholesky(B)
    s1, s2 = halves.s[..., 0], halves.s[..., 1]
    m11, m12 = s1 * l11 * n11 + s2 * l21 * n21, s2 * l21 * n22
    m21, m22 = s2 * l22 * n21, s2 * l22 * n22
    size = np.hypot(m11 + m22, m21 - m12) + _TINY
    return np.stack([(m11 - m22) / size, (m12 + m21) / size], axis=-1)


def huang_faugeras_equations(halves: Halves, cameras: FloatArray) -> FloatArray:
    """Return `equations` (..., 2), scaled so that their norm is (s1 - s2) / s2 = 2 r / (1 - r), the term of (5.8)."""
    g = equations(halves, cameras)
    r = np.linalg.norm(g, axis=-1, keepdims=True)
    return np.asarray(2 * g / np.maximum(1.0 - r, LEAST_COMPLEMENT))


def _frobenius_equations(halves: Halves, cameras: FloatArray) -> FloatArray:
    """Return (..., 9) equations whose norm is the term of thesis (5.9)."""
    return frobenius_form(halves.essential(cameras))


def _trivedi_equations(halves: Halves, cameras: FloatArray) -> FloatArray:
    """Return (..., 3) the terms of thesis (5.11)."""
    return trivedi(halves.essential(cameras))


def _polynomial_equations(halves: Halves, cameras: FloatArray) -> FloatArray:
    """Return (..., 1) the term of thesis (5.25)."""
    return polynomial_form(halves.essential(cameras))


Equations = Callable[[Halves, FloatArray], FloatArray]
"""Halves (..., P) and cameras (..., 1, 4) in, (..., P, m) equations out."""

EQUATIONS: Mapping[ConstraintForm, Equations] = MappingProxyType(
    {
        "huang-faugeras": huang_faugeras_equations,
        "frobenius": _frobenius_equations,
        "trivedi": _trivedi_equations,
        "polynomial": _polynomial_equations,
    }
)
"""Equations whose squares are minimized, by the setting `calibration.constraint_form`."""


def _transform_basis(basis: FloatArray, cameras: FloatArray) -> FloatArray:
    """Return (..., 2, 3) rows K'b."""
    fx, fy, u, v = (cameras[..., column, None] for column in range(4))
    x, y, z = basis[..., 0], basis[..., 1], basis[..., 2]
    return np.stack([fx * x, fy * y, u * x + v * y + z], axis=-1)


def _gram(basis: FloatArray, cameras: FloatArray) -> FloatArray:
    fx, fy, u, v = (cameras[..., column, None] for column in range(4))
    x, y = fx * basis[..., 0], fy * basis[..., 1]
    z = u * basis[..., 0] + v * basis[..., 1] + basis[..., 2]
    squares = x * x + y * y + z * z
    mixed = x[..., 0] * x[..., 1] + y[..., 0] * y[..., 1] + z[..., 0] * z[..., 1]
    return np.stack([squares[..., 0], mixed, squares[..., 1]], axis=-1)


def _cholesky(gram: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    first = np.sqrt(gram[..., 0]) + _TINY
    below = gram[..., 1] / first
    return first, below, np.sqrt(np.maximum(gram[..., 2] - below**2, 0.0))
