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
    Lens,
    RadialLens,
    WholeTurn,
    bearings_through,
)
from sfm_app.selfcal.wide_angle.lens_refinement import Pair, RefinedLens, pair_costs, refine_lens
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
FIRST_FIELDS_DEG, FIRST_PAIRS, FIRST_MATCHES, FIRST_GAIN = (55.0, 80.0, 120.0, 170.0), 8, 300, 0.02
"""A first look: fields of view of an equidistant lens, pairs, matches of each, and the gain from which on all lenses
are asked. Chosen by hand; not measured on their own."""
LEAST_RADIAL = -0.5
"""Radial term of the perspective rival to start from, at least. Chosen by hand; not measured on its own."""
ANGLES, WIDEST_PERSPECTIVE = 100, np.radians(75.0)
"""Angles of the comparison, and the half field of view from which on no perspective lens compares. Chosen by hand; not
measured on their own."""
LARGEST_SIDEWAYS_PX = 1.0
"""Largest distance in pixels, at the best focal and radial term, between a fisheye and a perspective lens that take its
place. Chosen by hand: features are accurate to half of it; not measured on its own."""


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
    size: tuple[int, int]
    """(width, height) of the photos."""
    log_odds: float = np.inf
    """By how much its robust cost is below that of the best perspective lens with one radial term, without the pair
    that says so most: repeated things can bring a pair to favor any lens."""

    @property
    def is_fisheye(self) -> bool:
        """Whether a fisheye explains clearly more than any perspective lens, and no radial term could replace it."""
        clear = self.support - self.perspective_support > CLEAR_GAIN and self.log_odds > 0.0
        return clear and self.sideways_px() > LARGEST_SIDEWAYS_PX

    def sideways_px(self) -> float:
        """Return by how many pixels the best perspective lens with one radial term departs from it; inf if none can."""
        found = _fit_radial(self.lens, 0.5 * float(np.hypot(*self.size)))
        return found[2] if found is not None else float("inf")

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
    side = float(max(size))
    given = _prepare(matches, size, np.random.default_rng(seed), MAX_PAIRS, MAX_MATCHES)
    if given is None:
        return None
    grid = [_lens_of(field, exponent) for exponent in EXPONENTS for field in FIELDS_DEG]
    searches = [given.search(lens) for lens in grid]
    first = int(np.argmax([given.support(found) for found in searches]))
    best, found = grid[first], searches[first]
    kept, Fs = given.select(found)
    if len(Fs) < MIN_PAIRS:
        return None
    refined = refine_lens(best, kept.with_matrices(Fs), given.threshold)
    parameters, covariance = refined.parameters, refined.covariance
    rival = _radial_rival(best, size)
    ahead = _log_odds(refined, rival, kept, Fs) if rival is not None else np.inf
    unit = np.array([1.0, 1.0, side, side])
    center = side * parameters[2] + size[0] / 2.0, side * parameters[3] + size[1] / 2.0
    scaled = covariance * np.outer(unit, unit)
    return LensEstimate(
        Fisheye(float(np.exp(parameters[0])) * side, float(parameters[1]), (float(center[0]), float(center[1]))),
        tuple(map(tuple, scaled.tolist())), given.support(found),
        given.support(given.search(Fisheye(1.0, PERSPECTIVE))), len(given.matches), size,
        ahead,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _Given:
    """Matches (N, 4) of some pairs in longer sides about the middle, and samples (S, 8) of each."""

    matches: tuple[FloatArray, ...]
    samples: tuple[NDArray[np.int64], ...]
    threshold: float

    def search(self, lens: Lens | WholeTurn) -> list[tuple[float, FloatArray]]:
        both = zip(self.matches, self.samples, strict=True)
        return [search_rays(bearings_through(lens, x), rows, self.threshold) for x, rows in both]

    def select(self, found: list[tuple[float, FloatArray]]) -> tuple["_Given", list[FloatArray]]:
        """Return the pairs that keep enough of their matches in a search, and their fundamental matrices."""
        rows = [k for k, (count, _) in enumerate(found) if count >= MIN_KEPT * len(self.matches[k])]
        matches, samples = tuple(self.matches[k] for k in rows), tuple(self.samples[k] for k in rows)
        return _Given(matches, samples, self.threshold), [found[k][1] for k in rows]

    def with_matrices(self, Fs: Sequence[FloatArray]) -> list[Pair]:
        return list(zip(self.matches, Fs, strict=True))

    def support(self, found: list[tuple[float, FloatArray]]) -> float:
        return sum(count for count, _ in found) / float(sum(map(len, self.matches)))


def _prepare(
    matches: Sequence[FloatArray], size: tuple[int, int], rng: np.random.Generator, most_pairs: int, most_matches: int
) -> _Given | None:
    side, middle = float(max(size)), np.tile(np.array(size) / 2.0, 2)
    usable = [(np.asarray(x, np.float64) - middle) / side for x in matches if len(x) >= MIN_MATCHES]
    if len(usable) < MIN_PAIRS:
        return None
    chosen = np.linspace(0, len(usable) - 1, min(len(usable), most_pairs)).astype(np.int64)
    thinned = [x[rng.permutation(len(x))[:most_matches]] for x in (usable[k] for k in chosen)]
    return _Given(tuple(thinned), tuple(rng.integers(0, len(x), (SAMPLES, 8)) for x in thinned), THRESHOLD_PX / side)


def needs_fisheye(matches: Sequence[FloatArray], size: tuple[int, int], seed: int = 0) -> bool:
    """Return whether a first look at a few pairs shows that some fisheye explains more than any perspective lens.

    Args:
        matches, size, seed: as for `find_lens`.
    """
    given = _prepare(matches, size, np.random.default_rng(seed), FIRST_PAIRS, FIRST_MATCHES)
    if given is None:
        return False
    fields = [_lens_of(field, EQUIDISTANT) for field in FIRST_FIELDS_DEG]
    supports = [given.support(given.search(lens)) for lens in (Fisheye(1.0, PERSPECTIVE), *fields)]
    return max(supports[1:]) - supports[0] > FIRST_GAIN


def shows_whole_turn(matches: Sequence[FloatArray], size: tuple[int, int], seed: int = 0) -> bool:
    """Return whether photos are panoramas: as such, a few pairs keep clearly more matches than with any other lens.

    Args:
        matches, size, seed: as for `find_lens`.
    """
    given = _prepare(matches, size, np.random.default_rng(seed), FIRST_PAIRS, FIRST_MATCHES)
    if given is None or size[0] != 2 * size[1]:
        return False
    others = (_lens_of(field, EQUIDISTANT) for field in FIRST_FIELDS_DEG)
    rivals = [given.support(given.search(lens)) for lens in (Fisheye(1.0, PERSPECTIVE), *others)]
    return given.support(given.search(WholeTurn())) - max(rivals) > CLEAR_GAIN


def _log_odds(refined: RefinedLens, rival: RadialLens, kept: _Given, Fs: Sequence[FloatArray]) -> float:
    """Return by how much less a lens costs than a perspective rival, without the pair in which it gains most.

    Args:
        refined: the lens.
        rival: to start from; it begins as wide as the lens did, with these matrices and with its own.
        kept: the pairs.
        Fs: their fundamental matrices, which suit the lens.
    """
    starts = Fs, [F for _, F in kept.search(rival)]
    others = (refine_lens(rival, kept.with_matrices(start), kept.threshold).state for start in starts)
    costs = min((pair_costs(kept.matches, state, refined.sigma) for state in others), key=np.sum)
    ahead = costs - pair_costs(kept.matches, refined.state, refined.sigma)
    return float(np.sum(ahead) - np.max(ahead))


def _radial_rival(lens: Fisheye, size: tuple[int, int]) -> RadialLens | None:
    """Return the perspective lens with one radial term next to a fisheye in longer sides; None where none compares."""
    found = _fit_radial(lens, 0.5 * float(np.hypot(*size)) / max(size))
    return RadialLens(found[0], max(found[1], LEAST_RADIAL)) if found is not None else None


def _fit_radial(lens: Fisheye, reach: float) -> tuple[float, float, float] | None:
    """Return focal, radial term and largest departure of the perspective lens nearest to a fisheye up to a radius."""
    theta = np.linspace(0.0, float(lens.angle(np.array([reach]))[0]), ANGLES)[1:]
    if theta[-1] >= WIDEST_PERSPECTIVE:
        return None
    plain, radius = np.tan(theta), lens.radius(theta)
    terms, *_ = np.linalg.lstsq(np.column_stack([plain, plain**3]), radius, rcond=None)
    departure = float(np.max(np.abs(terms[0] * plain + terms[1] * plain**3 - radius)))
    return float(terms[0]), float(terms[1] / terms[0]), departure


def _lens_of(field_deg: float, exponent: float) -> Fisheye:
    """Return the lens of a projection that sees so much along the longer side, which is 1."""
    return Fisheye(0.5 / float(Fisheye(1.0, exponent).radius(np.radians(field_deg / 2.0))), exponent)
