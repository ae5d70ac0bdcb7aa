"""Regression diagnostics of the fundamental matrix (thesis 3.3.4 and 4.7.2): leverages, Cook's distances, priors.

F is the unit vector f with A f = 0, where row i of the design matrix A is x2 (x) x1. Near a given f the unit vector
moves in the eight directions perpendicular to it, so that this is a regression with p = 8 parameters, and the hat
matrix is that of A restricted to them. The ninth direction, f itself, would divide by a number that only noise keeps
from zero.

Leverage and Cook's distance do not change when each view is shifted and scaled, because this maps the rows of A
linearly (and A f is small): one well-scaled frame (`points.Matches`) gives the same as Hartley's normalization.
"""

import numpy as np

from sfm_app.fundamental.scores import squared_distances
from sfm_app.fundamental.solvers import quadratic_forms, weighted_gram
from sfm_app.jit import kernel
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.types.arrays import BoolArray, FloatArray

PARAMETERS = 8
"""p of Eq. 3.16 and 4.17: directions perpendicular to the unit vector f."""
_LEAST_FREEDOM = 2.0**-52
"""Least 1 - h: the distance of 1 to the next number in double precision."""


def leverages(points: FloatArray, f: FloatArray, fitted: BoolArray) -> FloatArray:
    """Return the leverage h_ii of every match, in [0, 1], in a regression on the fitted and itself (thesis 3.11).

    For a fitted match (mask (N,)) this is the diagonal of the hat matrix. For any other match the textbook formula
    would exceed 1. Its leverage if it were fitted as well is g / (1 + g) with g = a_i' (A_in' A_in)^-1 a_i.
    """
    tangent = _tangent_basis(f)
    within = tangent.T @ weighted_gram(points, fitted.astype(np.float64)) @ tangent
    values, vectors = np.linalg.eigh(within)
    # directions that no fitted match constrains, up to rounding: matches along them have leverage 1
    floor = max(values[-1], 2.0**-1000) * 1e-14
    forms = quadratic_forms(points, tangent @ (vectors / np.sqrt(np.maximum(values, floor))))
    with np.errstate(divide="ignore"):  # a form may be 0, and inf in unconstrained directions
        return np.where(fitted, np.minimum(forms, 1.0), 1.0 / (1.0 + 1.0 / forms))


@kernel
def _tangent_basis(f: FloatArray) -> FloatArray:
    """Return (9, 8) orthonormal directions perpendicular to a unit vector: columns of a Householder reflection."""
    last = f[8] + 1.0 if f[8] >= 0.0 else f[8] - 1.0
    basis = np.zeros((9, PARAMETERS))
    for k in range(PARAMETERS):
        basis[k, k] = 1.0
        for j in range(9):
            basis[j, k] -= (f[j] if j < 8 else last) * f[k] / abs(last)
    return basis


@kernel
def studentized_residuals(residuals: FloatArray, leverage: FloatArray, fitted: BoolArray) -> FloatArray:
    """Divide residuals (N,) by their standard deviation (thesis 3.14, 3.15), from the fitted matches."""
    count, total, moment = 0, 0.0, 0.0
    for i in range(residuals.shape[0]):
        if fitted[i]:
            count += 1
            total += residuals[i]
    mean = total / max(count, 1)
    for i in range(residuals.shape[0]):
        if fitted[i]:
            moment += (residuals[i] - mean) ** 2
    variance = max(moment / max(count - PARAMETERS, 1), 1e-24)  # even perfect matches have rounded coordinates
    studentised = np.empty(residuals.shape[0])
    for i in range(residuals.shape[0]):
        studentised[i] = residuals[i] / np.sqrt(variance * max(1.0 - leverage[i], _LEAST_FREEDOM))
    return studentised


@kernel
def cook_distances(studentised: FloatArray, leverage: FloatArray) -> FloatArray:
    """Return how far the fit would move without each match (thesis 3.16, 4.17, where the square of d_i is missing)."""
    return studentised * studentised / PARAMETERS * (leverage / np.maximum(1.0 - leverage, _LEAST_FREEDOM))


@kernel
def priors(distances: FloatArray, sigma: float) -> FloatArray:
    """Return p(v_i) = exp(-D_i^2 / (2 sigma^2)), largest value 1 (thesis 4.7.3; the constant factor cancels)."""
    least, probable = np.inf, np.empty(distances.shape[0])
    for i in range(distances.shape[0]):
        least = min(least, distances[i])
    for i in range(distances.shape[0]):
        if sigma > 0.0:
            # minus the smallest exponent, so that the largest value is 1
            exponent = (distances[i] - least) / sigma * ((distances[i] + least) / sigma) / 2.0
            probable[i] = np.exp(-exponent) if exponent < 700.0 else 0.0
        else:
            probable[i] = 1.0 if distances[i] <= least else 0.0
    return probable


@kernel
def mad_sigma(distances: FloatArray) -> float:
    """Return the standard deviation about zero from the median absolute deviation (thesis 4.7.3)."""
    middle = distances.shape[0] // 2
    return float(MAD_TO_SIGMA * np.partition(np.abs(distances), middle)[middle]) if len(distances) else 0.0


def prior_validity(points: FloatArray, f: FloatArray, threshold: float, *, sigma_from_inliers: bool) -> FloatArray:
    """Return p(v_i) from the influence on f (thesis 4.7.2, 4.7.3); sigma is of the inliers, or of all matches."""
    squared = squared_distances(points, f)
    fitted = squared <= threshold * threshold
    leverage = leverages(points, f, fitted)
    distances = cook_distances(studentized_residuals(np.sqrt(squared), leverage, fitted), leverage)
    return priors(distances, mad_sigma(distances[fitted] if sigma_from_inliers else distances))
