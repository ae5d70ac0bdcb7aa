"""Lenses of wide angle, found from matches alone, before everything else and up to more than 180 degrees. Ours.

With the right lens the rays of right matches satisfy q' F p = 0 for some F, whatever the poses; with a wrong one curved
epipolar lines leave matches outside. So the search counts for every lens of a grid how many matches the pairs keep with
it (by samples of eight, scored as in MSAC: Torr and Zisserman 2000), and refines the best one together with its center
and the relative poses. Where the lens bends much, its curvature alone determines the focal; the equal singular values
of E (thesis 5.2) determine it where it bends little.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sfm_app.camera import rows as families
from sfm_app.camera.projection import RAY, Fisheye, image_rays
from sfm_app.geometry import epipolar
from sfm_app.geometry.least_squares import damped_step, inverse_of_positive, solve_each
from sfm_app.geometry.poses import POSE_DOF, retract, write_nearby_essentials
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.selfcal.adjustment import DAMPING, ROBUST_SCALE, eliminate_poses
from sfm_app.types.arrays import FloatArray, IndexArray

# Lenses: from points of a photo to directions, also behind the camera.


LENS = 4
"""Parameters of a lens: log focal, exponent or radial term, center. By definition."""
STEP = 1e-6
"""Step of finite differences in parameters: curvature and rounding in double precision cost about 1e-6 of them."""
RAY_STEP = 1e-5
"""The same in points, in longer sides: errors of about 1e-10 of the derivatives in double precision."""


class SEARCH:
    """The grid of lenses, the pairs that vote, and the verdict."""

    exponents: tuple[float, ...] = (0.5, 0.0, -0.5)
    """Projections of the grid, by definition of the family: stereographic, equidistant, equisolid."""
    fields_deg: tuple[float, ...] = (60.0, 80.0, 100.0, 120.0, 140.0, 160.0, 180.0, 200.0)
    """Fields of view along the longer side for each projection; by hand."""
    most_pairs: int = 16
    """Most pairs that vote, evenly chosen; by hand."""
    most_matches: int = 500
    """Most matches of each; by hand."""
    samples: int = 150
    """Samples of eight matches of each; by hand."""
    refits: int = 3
    """Most refits to the inliers of the best sample; by hand."""
    least_inliers: int = 12
    """Inliers below which there is no refit: eight determine F; by hand."""
    least_matches: int = 60
    """Matches below which a pair does not vote; by hand."""
    least_pairs: int = 3
    """Pairs below which there is no answer; by hand."""
    threshold_px: float = 2.0
    """Largest distance of an inlier: a lens between two of the grid still keeps its matches; by hand."""
    least_support: float = 0.5
    """Share of its matches that a pair must keep with the best lens of the grid to take part in the refinement; by
    hand."""
    clear_gain: float = 0.05
    """Share of the matches that a fisheye must keep beyond a perspective lens; by hand."""
    first_fields_deg: tuple[float, ...] = (55.0, 80.0, 120.0, 170.0)
    """Fields of view of an equidistant lens in a first look; by hand."""
    first_pairs: int = 8
    """Most pairs of a first look; by hand."""
    first_matches: int = 300
    """Most matches of each; by hand."""
    first_gain: float = 0.02
    """Gain in a first look from which on all lenses of the grid are searched; by hand."""
    least_radial: float = -0.5
    """Least radial term that the perspective rival starts from; by hand."""
    angles: int = 100
    """Angles at which two lenses are compared; by hand."""
    widest_perspective: float = float(np.radians(75.0))
    """Half the field of view from which on no perspective lens compares, in radians; by hand."""
    largest_departure_px: float = 1.0
    """Departure from a fisheye up to which a perspective lens takes its place: features are accurate to half of it; by
    hand."""


@dataclass(frozen=True, slots=True)
class LensRefinementOptions:
    """Adjustment of a lens and the poses of its pairs."""

    center_sigma: float = 0.02
    """Prior standard deviation of the center from the middle, in longer sides; by hand."""
    rounds: int = 30
    """Most steps for each noise level; by hand."""
    converged: float = 1e-6
    """Largest change of a parameter that ends them; by hand."""
    most_log_focal: float = 10.0
    """Largest |log f|, f in longer sides: beyond it there is no lens, and soon an overflow; by hand."""
    misfit: float = 3.0
    """Ratio of the errors of a lens to those that the scatter between pairs explains: all pairs share what no lens of
    the family describes. Chosen on fountain-P11 through a fisheye (`benchmarks.lenses.warped`)."""
    noise_rounds: int = 3
    """Estimates of the noise from the distances; by hand."""
    least_sigma: float = 1e-4
    """Least standard deviation of a distance, in longer sides: matches without noise would have unbounded weight; by
    hand."""


REFINEMENT = LensRefinementOptions()


@dataclass(frozen=True, slots=True)
class RadialLens:
    """A perspective lens with one radial term, as COLMAP's SIMPLE_RADIAL, in any unit of length."""

    focal: float
    radial: float
    center: tuple[float, float] = (0.0, 0.0)

    def rays(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) directions of length 1 of points (N, 2)."""
        camera = np.array([self.focal, self.focal, *self.center, self.radial, *[0.0] * 7])
        directions = image_rays(points, camera, families.PERSPECTIVE)[:, RAY]
        return np.asarray(directions / np.linalg.norm(directions, axis=1, keepdims=True), np.float64)


@dataclass(frozen=True, slots=True)
class Equirectangular:
    """An equirectangular photo with the origin in its middle and a width of 1; its columns are longitudes."""

    def rays(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) directions of length 1 of points (N, 2)."""
        per_radian = 0.5 / np.pi
        return image_rays(points, np.array([per_radian, per_radian, *[0.0] * 10]), families.PANORAMA)[:, RAY]


Lens = Fisheye | RadialLens
PERSPECTIVE = Fisheye(1.0, 1.0)
"""By definition a perspective lens; its focal does not matter to a fundamental matrix."""


def bearings_through(lens: Lens | Equirectangular, matches: FloatArray) -> FloatArray:
    """Return (N, 18) bearing vectors of matches (N, 4), with their derivatives by x and y: view 1, view 2."""
    return np.hstack([_rays_and_slopes(lens, matches[:, :2]), _rays_and_slopes(lens, matches[:, 2:])])


def _rays_and_slopes(lens: Lens | Equirectangular, points: FloatArray) -> FloatArray:
    here, right, down = lens.rays(points), np.array([RAY_STEP, 0.0]), np.array([0.0, RAY_STEP])
    return np.hstack(
        [here, (lens.rays(points + right) - here) / RAY_STEP, (lens.rays(points + down) - here) / RAY_STEP]
    )


def search_rays(lines: FloatArray, samples: IndexArray, threshold: float) -> tuple[float, FloatArray]:
    """Return the support of the best F by samples (S, 8), as in MSAC, and F, for bearing vectors (N, 18)."""
    p, q = lines[:, epipolar.FIRST], lines[:, epipolar.SECOND]
    Fs = epipolar.fit_rays(p[samples], q[samples])
    supports = _supports(Fs, lines, threshold)
    best = int(np.argmax(supports))
    F, support = Fs[best], float(supports[best])
    for _ in range(SEARCH.refits):
        inliers = epipolar.squared_distances(F[None], lines)[0] < threshold**2
        if np.count_nonzero(inliers) < SEARCH.least_inliers:
            break
        refit = epipolar.fit_rays(p[inliers], q[inliers])
        value = float(_supports(refit[None], lines, threshold)[0])
        if value <= support:
            break
        F, support = refit, value
    return support, F


def _supports(Fs: FloatArray, lines: FloatArray, threshold: float) -> FloatArray:
    return np.asarray(
        np.sum(1.0 - np.minimum(epipolar.squared_distances(Fs, lines) / threshold**2, 1.0), axis=1), np.float64
    )


Family = type[Fisheye] | type[RadialLens]
Pair = tuple[FloatArray, FloatArray]
"""Matches (N, 4) and F (3, 3) of a pair."""
System = tuple[FloatArray, FloatArray]
"""Hessian and negative gradient of one pair, or of all pairs."""


class State(NamedTuple):
    """State of the adjustment."""

    parameters: FloatArray
    """(4,) log focal, exponent or radial term, center."""
    poses: tuple[FloatArray, ...]
    """(12,) of each pair, see `geometry.poses`."""
    family: Family = Fisheye

    @property
    def lens(self) -> Lens:
        """The lens, in longer sides."""
        return self.lens_at(self.parameters)

    def lens_at(self, parameters: FloatArray) -> Lens:
        """Return the lens of the same family with other parameters (4,)."""
        focal, shape, x, y = (float(value) for value in parameters)
        return self.family(float(np.exp(focal)), shape, (x, y))


class RefinedLens(NamedTuple):
    """A lens with the least robust cost, in longer sides."""

    state: State
    covariance: FloatArray
    """(4, 4) of its parameters."""
    sigma: float


def refine_lens(start: Lens, pairs: Sequence[Pair], sigma: float) -> RefinedLens:
    """Return the lens of the family of `start` with the least robust cost, with its covariance, in longer sides.

    As `adjustment` for lenses with one radial term: distances are Sampson's (thesis 4.2) in the photos, downweighted by
    the cost of Geman and McClure (1987), and the pose of every pair is eliminated. The covariance is the sandwich with
    pairs as clusters, times the squared misfit, for matches that share keypoints (`redundancy`).
    """
    matches = [x for x, _ in pairs]
    # any of the four poses of an essential matrix gives the same distances
    poses = tuple(np.concatenate([R.ravel(), t]) for R, t in (epipolar.decompose_essential(F)[0] for _, F in pairs))
    shape = start.exponent if isinstance(start, Fisheye) else start.radial
    state = State(np.array([np.log(start.focal), shape, *start.center]), poses, type(start))
    for _ in range(REFINEMENT.noise_rounds):
        state = _adjust(matches, state, sigma)
        distances = np.abs(np.concatenate(_distances(matches, state)))
        sigma = max(MAD_TO_SIGMA * float(np.median(distances)), REFINEMENT.least_sigma)
    hessians, scores, _, _ = eliminate_poses(*_normal_equations(matches, state, sigma), 0.0)
    inverse = inverse_of_positive(hessians.sum(axis=0) + np.diag(_prior_precision()))
    small_sample = len(pairs) / max(len(pairs) - LENS, 1)
    sandwich = small_sample * inverse @ (scores.T @ scores) @ inverse
    plain = redundancy(matches) * inverse
    wider = REFINEMENT.misfit * np.sqrt(np.maximum(np.diag(sandwich) / np.diag(plain), 1.0))
    return RefinedLens(state, np.asarray(plain * np.outer(wider, wider), np.float64), sigma)


def redundancy(matches: Sequence[FloatArray]) -> float:
    """Return matches over independent errors, >= 1: one keypoint in m photos gives m (m - 1) / 2 matches of 2 m - 3."""
    ends = np.concatenate([x[:, :2] for x in matches] + [x[:, 2:] for x in matches])
    each = len(ends) / max(len(np.unique(ends, axis=0)), 1)
    return max(1.0, 0.5 * each * (each + 1.0) / (2.0 * each - 1.0))


def _prior_precision() -> FloatArray:
    return np.array([0.0, 0.0, REFINEMENT.center_sigma**-2, REFINEMENT.center_sigma**-2])


def _adjust(matches: Sequence[FloatArray], state: State, sigma: float) -> State:
    damping = DAMPING.first
    for _ in range(REFINEMENT.rounds):
        system, cost = _normal_equations(matches, state, sigma), robust_cost(matches, state, sigma)

        def attempt(damping: float, begin: State = state, system: System = system) -> State | None:
            trial = _step(begin, system, damping)
            if abs(trial.parameters[0]) > REFINEMENT.most_log_focal:
                return None
            return trial if robust_cost(matches, trial, sigma) < cost else None  # noqa: B023 -- called in this round

        better, damping = damped_step(attempt, damping, DAMPING)
        if better is None:
            break
        change = np.max(np.abs(better.parameters - state.parameters))
        state = better
        if change < REFINEMENT.converged:
            break
    return state


def _step(state: State, system: System, damping: float) -> State:
    """Return the state after one damped step: the lens by all pairs and the prior, then each pose by its pair."""
    prior = _prior_precision()
    hessians, gradients, pose_by_lens, pose_alone = eliminate_poses(*system, 0.0)
    H, g = hessians.sum(axis=0) + np.diag(prior), gradients.sum(axis=0) - prior * state.parameters
    step = solve_each(H + damping * np.diag(np.diag(H)), g[:, None])[:, 0]
    moved = zip(state.poses, pose_alone - pose_by_lens @ step, strict=True)
    poses = tuple(np.asarray(retract(pose, of_pose), np.float64) for pose, of_pose in moved)
    return State(state.parameters + step, poses, state.family)


def _normal_equations(matches: Sequence[FloatArray], state: State, sigma: float) -> System:
    """Return the Gauss-Newton systems (P, 9, 9) and (P, 9) of all pairs over the lens and the pose."""
    lenses = [state.lens, *(state.lens_at(state.parameters + STEP * axis) for axis in np.eye(LENS))]
    systems = [_pair_system(x, lenses, pose, sigma) for x, pose in zip(matches, state.poses, strict=True)]
    return np.array([A for A, _ in systems]), np.array([b for _, b in systems])


def _pair_system(x: FloatArray, lenses: list[Lens], pose: FloatArray, sigma: float) -> System:
    Es = np.empty((1 + POSE_DOF, 3, 3))
    write_nearby_essentials(pose, STEP, Es)
    (lens, *steps), (E, *turned) = lenses, Es
    pair = bearings_through(lens, x)
    r = epipolar.signed_distances(E, pair)
    by_lens = [epipolar.signed_distances(E, bearings_through(other, x)) - r for other in steps]
    by_pose = [epipolar.signed_distances(other, pair) - r for other in turned]
    J, r = np.column_stack(by_lens + by_pose) / (STEP * sigma), r / sigma
    weights = (1.0 + (r / ROBUST_SCALE) ** 2) ** -2
    return (J * weights[:, None]).T @ J, -J.T @ (weights * r)


def robust_cost(matches: Sequence[FloatArray], state: State, sigma: float) -> float:
    """Return half the robust squared distances in sigma^2, plus the prior's cost."""
    prior = 0.5 * float(np.sum((state.parameters[2:] / REFINEMENT.center_sigma) ** 2))
    return float(np.sum(pair_costs(matches, state, sigma))) + prior


def pair_costs(matches: Sequence[FloatArray], state: State, sigma: float) -> FloatArray:
    """Return (P,) half the robust squared distances of each pair, in sigma^2."""
    squared = [(r / sigma) ** 2 for r in _distances(matches, state)]
    return np.array([0.5 * float(np.sum(d / (1.0 + d / ROBUST_SCALE**2))) for d in squared], np.float64)


def _distances(matches: Sequence[FloatArray], state: State) -> list[FloatArray]:
    lens = state.lens
    Es = [epipolar.cross_matrix(pose[9:]) @ pose[:9].reshape(3, 3) for pose in state.poses]
    return [epipolar.signed_distances(E, bearings_through(lens, x)) for E, x in zip(Es, matches, strict=True)]


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
    size: tuple[int, int]
    log_odds: float = np.inf
    """Robust cost of the best perspective lens with one radial term minus its own, without the pair that favors it
    most: repeated structure can make a pair favor any lens."""

    @property
    def is_fisheye(self) -> bool:
        """Whether a fisheye explains clearly more than any perspective lens, and no radial term could replace it."""
        clear = self.support - self.perspective_support > SEARCH.clear_gain and self.log_odds > 0.0
        radial = _fit_radial(self.lens, 0.5 * float(np.hypot(*self.size)))
        return clear and (radial is None or radial[2] > SEARCH.largest_departure_px)

    def radius_deviation_px(self, theta: FloatArray) -> FloatArray:
        """Return (N,) standard deviations of the radius at angles (N,) to the optical axis, in pixels."""
        e, step = self.lens.exponent, 1e-4
        by_exponent = (Fisheye(self.lens.focal, e + step).radius(theta) - self.lens.radius(theta)) / step
        J = np.column_stack([self.lens.radius(theta), by_exponent])
        return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", J, np.array(self.covariance)[:2, :2], J)), np.float64)


def find_lens(matches: Sequence[FloatArray], size: tuple[int, int], seed: int = 0) -> LensEstimate | None:
    """Find the lens of photos of one size from the raw matches (N, 4) px of their pairs; None for too few."""
    side = float(max(size))
    pairs = _sample(matches, size, np.random.default_rng(seed), SEARCH.most_pairs, SEARCH.most_matches)
    if pairs is None:
        return None
    grid = [_lens_of(field, exponent) for exponent in SEARCH.exponents for field in SEARCH.fields_deg]
    searches = [pairs.search(lens) for lens in grid]
    first = int(np.argmax([pairs.support(search) for search in searches]))
    best, search = grid[first], searches[first]
    selected, Fs = pairs.select(search)
    if len(Fs) < SEARCH.least_pairs:
        return None
    refined = refine_lens(best, list(zip(selected.matches, Fs, strict=True)), pairs.threshold)
    (log_focal, exponent, u, v), unit = refined.state.parameters, np.array([1.0, 1.0, side, side])
    radial = _fit_radial(best, 0.5 * float(np.hypot(*size)) / side)
    rival = RadialLens(radial[0], max(radial[1], SEARCH.least_radial)) if radial is not None else None
    return LensEstimate(
        lens=Fisheye(
            float(np.exp(log_focal)) * side, float(exponent),
            (float(side * u + size[0] / 2.0), float(side * v + size[1] / 2.0)),
        ),
        covariance=tuple(map(tuple, (refined.covariance * np.outer(unit, unit)).tolist())),
        support=pairs.support(search),
        perspective_support=pairs.support(pairs.search(PERSPECTIVE)),
        pairs=len(pairs.matches),
        size=size,
        log_odds=_log_odds(refined, rival, selected, Fs) if rival is not None else np.inf,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class _SampledPairs:
    """Matches (N, 4) of some pairs in longer sides from the middle, and samples (S, 8) of each."""

    matches: tuple[FloatArray, ...]
    samples: tuple[IndexArray, ...]
    threshold: float

    def search(self, lens: Lens | Equirectangular) -> list[tuple[float, FloatArray]]:
        both = zip(self.matches, self.samples, strict=True)
        return [search_rays(bearings_through(lens, x), rows, self.threshold) for x, rows in both]

    def select(self, searches: list[tuple[float, FloatArray]]) -> tuple["_SampledPairs", list[FloatArray]]:
        """Return the pairs that keep enough of their matches in a search, and their fundamental matrices."""
        rows = [k for k, (count, _) in enumerate(searches) if count >= SEARCH.least_support * len(self.matches[k])]
        matches, samples = tuple(self.matches[k] for k in rows), tuple(self.samples[k] for k in rows)
        return _SampledPairs(matches, samples, self.threshold), [searches[k][1] for k in rows]

    def support(self, searches: list[tuple[float, FloatArray]]) -> float:
        return sum(count for count, _ in searches) / float(sum(map(len, self.matches)))


def _sample(
    matches: Sequence[FloatArray], size: tuple[int, int], rng: np.random.Generator, most_pairs: int, most_matches: int
) -> _SampledPairs | None:
    side, middle = float(max(size)), np.tile(np.array(size) / 2.0, 2)
    usable = [(np.asarray(x, np.float64) - middle) / side for x in matches if len(x) >= SEARCH.least_matches]
    if len(usable) < SEARCH.least_pairs:
        return None
    chosen = np.linspace(0, len(usable) - 1, min(len(usable), most_pairs)).astype(np.int64)
    thinned = [x[rng.permutation(len(x))[:most_matches]] for x in (usable[k] for k in chosen)]
    return _SampledPairs(
        tuple(thinned), tuple(rng.integers(0, len(x), (SEARCH.samples, 8)) for x in thinned), SEARCH.threshold_px / side
    )


def needs_fisheye(matches: Sequence[FloatArray], size: tuple[int, int], seed: int = 0) -> bool:
    """Return whether some fisheye explains more matches of a few pairs than any perspective lens; as `find_lens`."""
    look = _first_look(matches, size, seed)
    return look is not None and max(look[1][1:]) - look[1][0] > SEARCH.first_gain


def shows_panoramas(matches: Sequence[FloatArray], size: tuple[int, int], seed: int = 0) -> bool:
    """Return whether photos are panoramas: as such, a few pairs keep clearly more matches than with any other lens."""
    look = _first_look(matches, size, seed) if size[0] == 2 * size[1] else None
    return look is not None and look[0].support(look[0].search(Equirectangular())) - max(look[1]) > SEARCH.clear_gain


def _first_look(
    matches: Sequence[FloatArray], size: tuple[int, int], seed: int
) -> tuple[_SampledPairs, list[float]] | None:
    """Return a few pairs, and their supports for a perspective lens and fisheyes; None where too few have matches."""
    pairs = _sample(matches, size, np.random.default_rng(seed), SEARCH.first_pairs, SEARCH.first_matches)
    if pairs is None:
        return None
    lenses = (PERSPECTIVE, *(_lens_of(field, 0.0) for field in SEARCH.first_fields_deg))
    return pairs, [pairs.support(pairs.search(lens)) for lens in lenses]


def _log_odds(refined: RefinedLens, rival: RadialLens, pairs: _SampledPairs, Fs: Sequence[FloatArray]) -> float:
    """Return by how much less a lens costs than a rival, which starts twice, without the pair that gains most."""
    starts = Fs, [F for _, F in pairs.search(rival)]
    rivals = (
        refine_lens(rival, list(zip(pairs.matches, start, strict=True)), pairs.threshold).state for start in starts
    )
    costs = min((pair_costs(pairs.matches, state, refined.sigma) for state in rivals), key=np.sum)
    gains = costs - pair_costs(pairs.matches, refined.state, refined.sigma)
    return float(np.sum(gains) - np.max(gains))


def _fit_radial(lens: Fisheye, reach: float) -> tuple[float, float, float] | None:
    """Return focal, radial term and largest departure of the perspective lens nearest to a fisheye up to a radius."""
    theta = np.linspace(0.0, float(lens.angle(np.array([reach]))[0]), SEARCH.angles)[1:]
    if theta[-1] >= SEARCH.widest_perspective:
        return None
    plain, radius = np.tan(theta), lens.radius(theta)
    curves = np.column_stack([plain, plain**3])
    terms, *_ = np.linalg.lstsq(curves, radius, rcond=None)
    departure = float(np.max(np.abs(curves @ terms - radius)))
    return float(terms[0]), float(terms[1] / terms[0]), departure


def _lens_of(field_deg: float, exponent: float) -> Fisheye:
    """Return the lens of a projection with a field of view along the longer side, which is 1."""
    return Fisheye(0.5 / float(Fisheye(1.0, exponent).radius(np.radians(field_deg / 2.0))), exponent)
