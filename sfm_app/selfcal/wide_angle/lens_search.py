"""The lens that most pairs agree on: focal, projection and center from matches alone, up to more than 180 degrees.

Ours. With the right lens the rays of right matches satisfy q' F p = 0 for some F, whatever the poses; with a wrong one
curved epipolar lines leave matches outside. So every lens of a grid is asked how many matches it lets the pairs keep,
and the best one is refined together with the center and the relative poses. Where the lens bends much, its curvature
alone determines the focal; the equal singular values of E (thesis 5.2) determine it where it bends little.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.selfcal.wide_angle.fisheye import (
    EQUIDISTANT,
    EQUISOLID,
    PERSPECTIVE,
    STEREOGRAPHIC,
    Fisheye,
    bearings_through,
)
from sfm_app.selfcal.wide_angle.lens_refinement import refine_lens
from sfm_app.selfcal.wide_angle.lens_support import search_rays

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
MIN_KEPT = 0.5
"""Share of its matches that a pair must keep with the best lens of the grid to take part in the refinement. Chosen by
hand; not measured on its own."""
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


def find_lens(matches: Sequence[FloatArray], size: tuple[int, int], seed: int = 0) -> LensEstimate | None:
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

    def search(lens: Fisheye) -> list[tuple[float, FloatArray]]:
        return [search_rays(bearings_through(lens, x), s, threshold) for x, s in zip(thinned, samples, strict=True)]

    def support(found: list[tuple[float, FloatArray]]) -> float:
        return sum(count for count, _ in found) / total

    grid = [_lens_of(field, exponent) for exponent in EXPONENTS for field in FIELDS_DEG]
    searches = [search(lens) for lens in grid]
    first = int(np.argmax([support(found) for found in searches]))
    best, found = grid[first], searches[first]
    kept = [(x, F) for x, (count, F) in zip(thinned, found, strict=True) if count >= MIN_KEPT * len(x)]
    if len(kept) < MIN_PAIRS:
        return None
    parameters, covariance = refine_lens(best, kept, THRESHOLD_PX / side)
    unit = np.array([1.0, 1.0, side, side])
    center = side * parameters[2] + size[0] / 2.0, side * parameters[3] + size[1] / 2.0
    scaled = covariance * np.outer(unit, unit)
    return LensEstimate(
        Fisheye(float(np.exp(parameters[0])) * side, float(parameters[1]), (float(center[0]), float(center[1]))),
        tuple(map(tuple, scaled.tolist())), support(found), support(search(Fisheye(1.0, PERSPECTIVE))), len(thinned),
    )  # fmt: skip


def _lens_of(field_deg: float, exponent: float) -> Fisheye:
    """Return the lens of a projection that sees so much along the longer side, which is 1."""
    return Fisheye(0.5 / float(Fisheye(1.0, exponent).radius(np.radians(field_deg / 2.0))), exponent)
