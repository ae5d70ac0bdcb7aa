"""The lens that most pairs agree on: focal, projection and center from matches alone, up to more than 180 degrees.

Ours. With the right lens the rays of right matches satisfy q' F p = 0 for some F, whatever the poses; with a wrong one
curved epipolar lines leave matches outside. So every lens of a grid is asked how many matches it lets the pairs keep,
and the best one is refined together with the center. Where the lens bends much, its curvature alone determines the
focal; the equal singular values of E (thesis 5.2) help where it bends little.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from sfm_app.geometry.spd_solve import inverse_of_positive
from sfm_app.selfcal.wide_angle.fisheye import EQUIDISTANT, EQUISOLID, PERSPECTIVE, STEREOGRAPHIC, Fisheye
from sfm_app.selfcal.wide_angle.ray_fundamental import fit_rays, make_ray_pair, search_rays, squared_distances

FloatArray = NDArray[np.float64]

EXPONENTS = (STEREOGRAPHIC, EQUIDISTANT, EQUISOLID)
FIELDS_DEG = (60.0, 80.0, 100.0, 120.0, 140.0, 160.0, 180.0, 200.0)
"""Fields of view along the longer side that are tried with each projection. Chosen by hand; not measured on their
own."""
MAX_PAIRS, MAX_MATCHES, SAMPLES = 16, 500, 150
"""Pairs that are asked, evenly chosen; matches of each; samples of eight of them. Chosen by hand; not measured on
their own."""
MIN_MATCHES, MIN_PAIRS = 60, 3
"""Pairs with fewer matches are not asked, and fewer pairs not believed. Chosen by hand; not measured on their own."""
THRESHOLD_PX = 2.0
"""Of an inlier in the grid: a lens between two of the grid still keeps its matches. Chosen by hand; not measured on its
own."""
SIGMA_PX = 0.7
"""Standard deviation of a distance in the refinement. Chosen by hand; not measured on its own."""
ROBUST_SCALE = 3.0
"""Of Geman and McClure's cost (1987), in sigma, as in `two_view_cost`. Chosen by hand; not measured on its own."""
RATIO_SIGMA, RATIO_LIMIT = 0.02, 3.0
"""Standard deviation of (s1 - s2) / (s1 + s2) of E, and where a pair counts no more. Chosen by hand; not measured on
their own."""
CENTER_SIGMA = 0.02
"""Prior standard deviation of the center from the middle, in longer sides. Chosen by hand; not measured on its own."""
MIN_KEPT = 0.5
"""Share of its matches that a pair must keep with the best lens of the grid to take part in the refinement. Chosen by
hand; not measured on its own."""
FIRST_STEPS = (0.1, 0.15, 0.01, 0.01)
"""Size of the first simplex in log focal, exponent and center. Chosen by hand; not measured on their own."""
MOST_STEPS = 300
"""Of Nelder and Mead's simplex (1965). Chosen by hand; not measured on its own."""
SLOPE_STEP = 2e-3
"""Step of the derivatives for the standard deviations. Chosen by hand; not measured on its own."""
CLEAR_GAIN = 0.05
"""Share of the matches that a fisheye must let the pairs keep beyond a perspective lens. Chosen by hand; not measured
on its own."""


@dataclass(frozen=True, slots=True)
class LensEstimate:
    """The lens of photos of one size."""

    lens: Fisheye
    """In pixels."""
    covariance: tuple[tuple[float, ...], ...]
    """(4, 4) of log focal, exponent, and center in pixels."""
    support: float
    """Share of the matches that the pairs keep with the best fisheye of the grid."""
    perspective_support: float
    """The same with a perspective lens, whatever its focal."""
    pairs: int
    """Number of pairs that were asked."""

    @property
    def is_fisheye(self) -> bool:
        """Whether a fisheye explains clearly more than any perspective lens."""
        return self.support - self.perspective_support > CLEAR_GAIN

    def radius_deviation_px(self, theta: FloatArray) -> FloatArray:
        """Return (N,) standard deviations of the radius at angles (N,) to the optical axis, in pixels."""
        e, step = self.lens.exponent, 1e-4
        by_exponent = (Fisheye(self.lens.focal, e + step).radius(theta) - self.lens.radius(theta)) / step
        J = np.column_stack([self.lens.radius(theta), by_exponent])
        return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", J, np.array(self.covariance)[:2, :2], J)), np.float64)


def estimate_lens(matches: Sequence[FloatArray], size: tuple[int, int], seed: int = 0) -> LensEstimate | None:
    """Find the lens of photos of one size from the raw matches of their pairs; None where too few pairs have matches.

    Args:
        matches: per pair (N, 4) x1, y1, x2, y2 in pixels; wrong ones among them are expected.
        size: (width, height) of the photos.
        seed: of the samples.
    """
    side, rng = float(max(size)), np.random.default_rng(seed)
    middle = np.tile(np.array(size) / 2.0, 2)
    usable = [(np.asarray(x, np.float64) - middle) / side for x in matches if len(x) >= MIN_MATCHES]
    if len(usable) < MIN_PAIRS:
        return None
    chosen = np.linspace(0, len(usable) - 1, min(len(usable), MAX_PAIRS)).astype(np.int64)
    thinned = [x[rng.permutation(len(x))[:MAX_MATCHES]] for x in (usable[k] for k in chosen)]
    samples = [rng.integers(0, len(x), (SAMPLES, 8)) for x in thinned]
    threshold, total = THRESHOLD_PX / side, float(sum(map(len, thinned)))

    def support(lens: Fisheye) -> float:
        found = (search_rays(make_ray_pair(lens, x), s, threshold)[0] for x, s in zip(thinned, samples, strict=True))
        return sum(found) / total

    grid = [_lens_of(field, exponent) for exponent in EXPONENTS for field in FIELDS_DEG]
    supports = [support(lens) for lens in grid]
    best = grid[int(np.argmax(supports))]
    found = [search_rays(make_ray_pair(best, x), s, threshold) for x, s in zip(thinned, samples, strict=True)]
    kept = [(x, F) for x, (count, F) in zip(thinned, found, strict=True) if count >= MIN_KEPT * len(x)]
    perspective = support(Fisheye(1.0, PERSPECTIVE))
    if len(kept) < MIN_PAIRS:
        return None
    parameters, covariance = _refine(best, kept, SIGMA_PX / side)
    unit = np.array([1.0, 1.0, side, side])
    center = side * parameters[2] + size[0] / 2.0, side * parameters[3] + size[1] / 2.0
    scaled = covariance * np.outer(unit, unit)
    return LensEstimate(
        Fisheye(float(np.exp(parameters[0])) * side, float(parameters[1]), (float(center[0]), float(center[1]))),
        tuple(map(tuple, scaled.tolist())), max(supports), perspective, len(thinned),
    )  # fmt: skip


def _lens_of(field_deg: float, exponent: float) -> Fisheye:
    """Return the lens of a projection that sees so much along the longer side, which is 1."""
    return Fisheye(0.5 / float(Fisheye(1.0, exponent).radius(np.radians(field_deg / 2.0))), exponent)


def _refine(
    start: Fisheye, pairs: Sequence[tuple[FloatArray, FloatArray]], sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Return log focal, exponent and center (4,) with the least robust cost, and their covariance (4, 4).

    The covariance is the sandwich with pairs as clusters, about the prior on the center.
    """
    first = np.array([np.log(start.focal), start.exponent, 0.0, 0.0])

    def costs(parameters: FloatArray) -> FloatArray:
        lens = Fisheye(float(np.exp(parameters[0])), float(parameters[1]), (float(parameters[2]), float(parameters[3])))
        return np.array([_pair_cost(lens, x, F, sigma) for x, F in pairs])

    def total(parameters: FloatArray) -> float:
        return float(np.sum(costs(parameters)) + 0.5 * np.sum((parameters[2:] / CENTER_SIGMA) ** 2))

    simplex = np.vstack([first, first + np.diag(FIRST_STEPS)])
    options = {"initial_simplex": simplex, "maxfev": MOST_STEPS, "xatol": 1e-5, "fatol": 1e-3}
    best = np.asarray(minimize(total, first, method="Nelder-Mead", options=options).x, np.float64)
    steps = np.diag(SLOPE_STEP * np.array([1.0, 1.0, 0.2, 0.2]))
    size = np.diag(steps)
    ahead, behind, here = [costs(best + s) for s in steps], [costs(best - s) for s in steps], costs(best)
    scores = (np.array(ahead) - np.array(behind)) / (2.0 * size[:, None])
    curvature = np.empty((4, 4))
    for i in range(4):
        for j in range(i, 4):
            both = costs(best + steps[i] + steps[j]) - ahead[i] - ahead[j] + here
            mirrored = costs(best - steps[i] - steps[j]) - behind[i] - behind[j] + here
            curvature[i, j] = curvature[j, i] = float(np.sum(both + mirrored)) / (2.0 * size[i] * size[j])
    curvature[[2, 3], [2, 3]] += CENTER_SIGMA**-2
    inverse = inverse_of_positive(curvature)
    return best, np.asarray(inverse @ (scores @ scores.T) @ inverse, np.float64)


def _pair_cost(lens: Fisheye, matches: FloatArray, F: FloatArray, sigma: float) -> float:
    """Return half the robust squared distances of a pair in sigma^2, with F refitted, and what E adds."""
    pair = make_ray_pair(lens, matches)
    p, q = pair.first[0], pair.second[0]
    for _ in range(2):
        algebraic = np.einsum("ni,ij,nj->n", q, F, p) ** 2
        squared = squared_distances(F[None], pair)[0]
        slopes = algebraic / np.maximum(squared, 1e-300)
        F = fit_rays(p, q, (1.0 + squared / (ROBUST_SCALE * sigma) ** 2) ** -2 / np.maximum(slopes, 1e-300))
    squared = squared_distances(F[None], pair)[0] / sigma**2
    s1, s2, _ = np.linalg.svd(F, compute_uv=False)
    ratio = min((s1 - s2) / (s1 + s2) / RATIO_SIGMA, RATIO_LIMIT)
    return 0.5 * float(np.sum(squared / (1.0 + squared / ROBUST_SCALE**2))) + 0.5 * float(ratio) ** 2
