"""Zero curves: the roots of one pair's constraint, swept over a parameter (thesis 5.8.3)."""

import numpy as np

from sfm_app.selfcal.constraints import center_polynomials, focal_polynomials
from sfm_app.selfcal.inputs import FloatArray, Pairs
from sfm_app.selfcal.thesis.roots import ComplexArray, swept_roots

ROOT_IS_ZERO = 1e-9
"""A real part below this, in image widths, counts as zero: such roots are spurious. Chosen by hand; halved and doubled
by `benchmarks.sensitivity`."""
MAX_OUT_OF_RANGE = 0.5
"""A curve with a larger share of samples out of range is degenerate (thesis 5.8.4, Eq. 5.35)."""


def focal_curves(pairs: Pairs, fx: FloatArray, center: tuple[float, float]) -> FloatArray:
    """Return Z^f of thesis (5.29), (5.31): fy at every swept fx.

    Args:
        pairs: P fundamental matrices.
        fx: (S,) swept values, in the units of the pairs.
        center: u, v in the same units.

    Returns:
        (P, S) fy; 0 where no root has a non-zero real part. Not clipped to a range: `degeneracy` counts values out of
        range.
    """
    coefficients = focal_polynomials(pairs, fx, center)
    # the quartic is in fy^2: a negative fy^2 becomes an fy without real part, which the choice of the root skips
    roots = np.sqrt(swept_roots(coefficients))
    # the imaginary part is to be "approximately zero": roots in which it prevails form tails near fy = 0 on which all
    # curves agree, whatever the camera
    return _select_roots(np.where(np.abs(roots.imag) <= np.abs(roots.real), roots, 0.0))


def center_curves(pairs: Pairs, u: FloatArray, focal: tuple[float, float]) -> FloatArray:
    """Return Z^oc of thesis (5.30): (P, S) v at every swept u; as `focal_curves`.

    Args:
        pairs: P fundamental matrices.
        u: (S,) swept values, in the units of the pairs.
        focal: fx, fy in the same units.
    """
    return _select_roots(swept_roots(center_polynomials(pairs, u, focal)))


def degeneracy(curves: FloatArray, upper: float) -> FloatArray:
    """Return the share of the samples of each curve that lie out of range (thesis 5.35).

    Args:
        curves: (P, S) values.
        upper: the range is (0, upper).
    """
    return np.asarray(np.mean((curves <= ROOT_IS_ZERO) | (curves >= upper), axis=1))


def usable_curves(curves: FloatArray, upper: float) -> FloatArray:
    """Return the curves that are not degenerate.

    Args:
        curves: (P, S) values.
        upper: end of their range, see `degeneracy`.
    """
    return curves[degeneracy(curves, upper) <= MAX_OUT_OF_RANGE]


def _select_roots(roots: ComplexArray) -> FloatArray:
    """Return, per sample, the real part of the root with non-zero real part and the smallest imaginary part."""
    imaginary = np.where(np.abs(roots.real) > ROOT_IS_ZERO, np.abs(roots.imag), np.inf)
    best = np.argmin(imaginary, axis=-1)[..., None]
    value = np.take_along_axis(roots.real, best, axis=-1)[..., 0]
    found = np.isfinite(np.take_along_axis(imaginary, best, axis=-1)[..., 0])
    return np.where(found, value, 0.0)
