"""Zero curves: the roots of one pair's constraint, swept over a parameter (thesis 5.8.3)."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.selfcal.constraints import centre_polynomials, focal_polynomials
from sfm_app.selfcal.inputs import FloatArray, Pairs

ROOT_IS_ZERO = 1e-9
"""A real part below this, in image widths, counts as zero: such roots are spurious."""
MAX_OUT_OF_RANGE = 0.5
"""A curve with a larger share of samples out of range is degenerate (thesis 5.35)."""


def companion_roots(coefficients: FloatArray) -> NDArray[np.complex128]:
    """All roots of real polynomials as the eigenvalues of their companion matrices (thesis 5.8.3).

    Args:
        coefficients: (..., n + 1), lowest power first.

    Returns:
        (..., n) roots; a polynomial of lower degree has roots far out in place of the missing ones, one that vanishes
        has all roots 0.
    """
    degree = coefficients.shape[-1] - 1
    size = np.max(np.abs(coefficients), axis=-1)
    vanished = size == 0
    scaled = coefficients / np.where(vanished, 1.0, size)[..., None]
    lead = scaled[..., -1]
    smallest = np.finfo(np.float64).eps
    lead = np.where(np.abs(lead) < smallest, np.copysign(smallest, lead), lead)
    companion = np.zeros((*coefficients.shape[:-1], degree, degree))
    companion[..., np.arange(1, degree), np.arange(degree - 1)] = 1.0
    companion[..., :, -1] = -scaled[..., :-1] / lead[..., None]
    companion[vanished] = 0.0
    return np.linalg.eigvals(companion).astype(np.complex128)


def focal_curves(pairs: Pairs, fx: FloatArray, centre: tuple[float, float]) -> FloatArray:
    """Z^f of thesis (5.29), (5.31): fy at every swept fx.

    Returns:
        (P, S) fy; 0 where no root has a non-zero real part. Not clipped to a range: `degeneracy` wants to see it.
    """
    coefficients = focal_polynomials(pairs, fx, centre)
    # the quartic is in fy^2: a negative fy^2 becomes an fy without real part, which the choice of the root passes over
    curves = np.empty(coefficients.shape[:2])
    for curve, row in zip(curves, coefficients, strict=True):
        curve[:] = _chosen(np.sqrt(companion_roots(row)))
    return curves


def centre_curves(pairs: Pairs, u: FloatArray, focal: tuple[float, float]) -> FloatArray:
    """Z^oc of thesis (5.30): v at every swept u; as `focal_curves`."""
    coefficients = centre_polynomials(pairs, u, focal)
    curves = np.empty(coefficients.shape[:2])
    for curve, row in zip(curves, coefficients, strict=True):
        curve[:] = _chosen(companion_roots(row))
    return curves


def degeneracy(curves: FloatArray, upper: float) -> FloatArray:
    """Thesis (5.35): per curve, the share of its samples that lie out of (0, upper)."""
    return np.asarray(np.mean((curves <= ROOT_IS_ZERO) | (curves >= upper), axis=1))


def usable(curves: FloatArray, upper: float) -> FloatArray:
    """The curves that are not degenerate."""
    return curves[degeneracy(curves, upper) <= MAX_OUT_OF_RANGE]


def _chosen(roots: NDArray[np.complex128]) -> FloatArray:
    """Per sample the real part of the root with non-zero real part and the smallest imaginary part."""
    imaginary = np.where(np.abs(roots.real) > ROOT_IS_ZERO, np.abs(roots.imag), np.inf)
    best = np.argmin(imaginary, axis=-1)[..., None]
    value = np.take_along_axis(roots.real, best, axis=-1)[..., 0]
    found = np.isfinite(np.take_along_axis(imaginary, best, axis=-1)[..., 0])
    return np.where(found, value, 0.0)
