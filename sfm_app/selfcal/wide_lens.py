"""Lenses of wide angle, found from rays before everything else."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera.models import camera_matrix, rays
from sfm_app.geometry.epipolar import FIRST, SECOND, decompose_essential, fit_rays, signed_distances, squared_distances
from sfm_app.geometry.least_squares import DampingRange, damped_step, inverse_of_positive, solve_each
from sfm_app.geometry.poses import POSE_DOF, retract, write_essential
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.types.arrays import FloatArray, IndexArray

# Lenses of two parameters: from points of a photo to directions, also behind the camera.
#
# Ours; the projections are the textbook's. A ray at the angle theta to the optical axis comes to lie at the radius,
# in focal lengths,
#
# r = tan(e theta) / e (e > 0), theta (e = 0), sin(-e theta) / -e (e < 0).
#
# e = 1 is a perspective lens, 1/2 stereographic, 0 equidistant, -1/2 equisolid, -1 orthographic. All have the same
# scale about the center, the focal length.

PERSPECTIVE, STEREOGRAPHIC, EQUIDISTANT, EQUISOLID = 1.0, 0.5, 0.0, -0.5
"""Exponents, by definition of the family."""
EQUIDISTANT_BELOW = 1e-6
"""Exponents nearer to 0 are taken as 0: the series agree to double precision."""
RADIUS_STEP = 1e-5
"""Step of the derivatives by finite differences, in longer sides: curvature and rounding in double precision cost about
1e-10 of them."""


@dataclass(frozen=True, slots=True)
class Fisheye:
    """A lens with one focal, in any unit of length."""

    focal: float
    exponent: float
    center: tuple[float, float] = (0.0, 0.0)

    def radius(self, theta: FloatArray) -> FloatArray:
        """Return the radius about the center of rays at angles `theta` (N,), in radians, to the optical axis."""
        e = self.exponent
        if abs(e) < EQUIDISTANT_BELOW:
            return np.asarray(self.focal * theta, np.float64)
        return np.asarray(self.focal * (np.tan(e * theta) / e if e > 0 else np.sin(-e * theta) / -e), np.float64)

    def angle(self, radius: FloatArray) -> FloatArray:
        """Return the angle to the optical axis, in radians; points beyond the image circle lie on it."""
        r, e = np.asarray(radius) / self.focal, self.exponent
        if abs(e) < EQUIDISTANT_BELOW:
            return np.asarray(np.minimum(r, np.pi), np.float64)
        angle = np.arctan(e * r) / e if e > 0 else np.arcsin(np.minimum(-e * r, 1.0)) / -e
        return np.asarray(np.minimum(angle, np.pi), np.float64)

    def rays(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) directions of length 1 of points (N, 2)."""
        about = points - np.array(self.center)
        radius = np.hypot(about[:, 0], about[:, 1])
        theta = self.angle(radius)
        along = np.divide(np.sin(theta), radius, out=np.full_like(radius, 1.0 / self.focal), where=radius > 0.0)
        return np.column_stack([about * along[:, None], np.cos(theta)])

    def project(self, rays: FloatArray) -> FloatArray:
        """Return (N, 2) points of rays (N, 3) of any length."""
        side = np.hypot(rays[:, 0], rays[:, 1])
        radius = self.radius(np.arctan2(side, rays[:, 2]))
        return rays[:, :2] * np.divide(radius, side, out=np.zeros_like(side), where=side > 0.0)[:, None] + self.center

    def field_deg(self, width: float) -> float:
        """Return the angle between the rays to both ends of a width about the center, in degrees.

        Args:
            width: in the units of the focal.
        """
        return float(2.0 * np.degrees(self.angle(np.array([0.5 * width]))[0]))


@dataclass(frozen=True, slots=True)
class RadialLens:
    """A perspective lens with one radial term, as COLMAP's SIMPLE_RADIAL, in any unit of length."""

    focal: float
    radial: float
    center: tuple[float, float] = (0.0, 0.0)

    def rays(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) directions of length 1 of points (N, 2)."""
        plane = rays(points, camera_matrix(self.focal, self.focal, *self.center), self.radial)
        found = np.column_stack([plane, np.ones(len(plane))])
        return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True), np.float64)


@dataclass(frozen=True, slots=True)
class WholeTurn:
    """An equirectangular photo with the origin in its middle and a width of 1; its columns are longitudes."""

    def rays(self, points: FloatArray) -> FloatArray:
        """Return (N, 3) directions of length 1 of points (N, 2)."""
        longitude, latitude = 2.0 * np.pi * np.asarray(points, np.float64).T
        level = np.cos(latitude)
        return np.column_stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)])


Lens = Fisheye | RadialLens


def bearings_through(lens: Lens | WholeTurn, matches: FloatArray) -> FloatArray:
    """Return (N, 18) bearing vectors of matches, with their derivatives by x and y: view 1, view 2.

    Args:
        lens: of both photos, in longer sides.
        matches: (N, 4) x1, y1, x2, y2 in the same unit.
    """
    return np.hstack([_rays_and_slopes(lens, matches[:, :2]), _rays_and_slopes(lens, matches[:, 2:])])


def _rays_and_slopes(lens: Lens | WholeTurn, points: FloatArray) -> FloatArray:
    here, right, down = lens.rays(points), np.array([RADIUS_STEP, 0.0]), np.array([0.0, RADIUS_STEP])
    return np.hstack(
        [here, (lens.rays(points + right) - here) / RADIUS_STEP, (lens.rays(points + down) - here) / RADIUS_STEP]
    )


# How many matches of a pair a lens explains, by samples of eight.
#
# Samples are scored by a truncated loss (MSAC, Torr and Zisserman 2000).

REFITS = 3
"""Refits to the inliers of the best sample. Chosen by hand; not measured on its own."""
MIN_INLIERS = 12
"""Fewer inliers are not refitted: eight determine F. Chosen by hand; not measured on its own."""


def search_rays(lines: FloatArray, samples: IndexArray, threshold: float) -> tuple[float, FloatArray]:
    """Return the support of the best F, in matches, and F (3, 3).

    A match counts 1 - d^2 / threshold^2, or nothing beyond the threshold.

    Args:
        lines: (N, 18) matches, as in `geometry.lenses.ray_epipolar`.
        samples: (S, 8) rows of them.
        threshold: largest distance of an inlier, in the unit of the photo, > 0.
    """
    p, q = lines[:, FIRST], lines[:, SECOND]
    Fs = fit_rays(p[samples], q[samples])
    supports = _supports(Fs, lines, threshold)
    best = int(np.argmax(supports))
    F, support = Fs[best], float(supports[best])
    for _ in range(REFITS):
        inliers = squared_distances(F[None], lines)[0] < threshold**2
        if np.count_nonzero(inliers) < MIN_INLIERS:
            break
        again = fit_rays(p[inliers], q[inliers])
        value = float(_supports(again[None], lines, threshold)[0])
        if value <= support:
            break
        F, support = again, value
    return support, F


def _supports(Fs: FloatArray, lines: FloatArray, threshold: float) -> FloatArray:
    return np.asarray(np.sum(1.0 - np.minimum(squared_distances(Fs, lines) / threshold**2, 1.0), axis=1), np.float64)


# A lens, its center and the relative poses of pairs adjusted to their matches at once.
#
# Ours, as `structureless_ba` does it for lenses with one radial term: every pair has its own pose, which is
# eliminated (Schur complement, Triggs and others 2000). Distances are Sampson's (thesis 4.2) in the photos,
# downweighted by the cost of Geman and McClure (1987).

LENS = 4
"""Parameters of a lens: log focal, exponent, center. Counted."""
ROBUST_SCALE = 3.0
"""Of Geman and McClure's cost, in sigma, as in `two_view_cost`. Chosen by hand; not measured on its own."""
CENTER_SIGMA = 0.02
"""Prior standard deviation of the center from the middle, in longer sides. Chosen by hand; not measured on its own."""
REFINEMENT_STEP = 1e-6
"""Step of the derivatives by finite differences: curvature and rounding in double precision cost about 1e-6 of them."""
MAX_ROUNDS = 30
"""Most steps for each noise level. Chosen by hand; not measured on its own."""
CONVERGED = 1e-6
"""Largest change of a parameter that ends them. Chosen by hand; not measured on its own."""
DAMPING = DampingRange(first=1e-4, least=1e-9, most=1e8)
"""Of Levenberg and Marquardt's steps, relative to the diagonal. Chosen by hand; not measured on their own."""
MOST_LOG_FOCAL = 10.0
"""Largest logarithm of a focal in longer sides, either way: beyond it there is no lens, and soon an overflow. Chosen by
hand; not measured on its own."""
MISFIT = 3.0
"""Ratio of the errors of a lens to those that the scatter between pairs explains: what no lens of the family shows is
alike in all pairs. Chosen on fountain-P11 through a fisheye, which needs 4.5 without it
(`python -m benchmarks.lenses.warped`); left out: Herz-Jesus-P8 needs 2, castle-P19 2 to 7, rendered folders up to 3."""
NOISE_ROUNDS = 3
"""Times the noise is estimated from the distances. Chosen by hand; not measured on its own."""
LEAST_SIGMA = 1e-4
"""Least standard deviation of a distance, in longer sides: matches without noise would weigh without bound. Chosen by
hand; not measured on its own."""

Family = type[Fisheye] | type[RadialLens]
Pair = tuple[FloatArray, FloatArray]
"""Matches (N, 4) and F (3, 3) of a pair."""


class State(NamedTuple):
    """Where the adjustment stands."""

    parameters: FloatArray
    """(4,) log focal, exponent or radial term, center."""
    poses: tuple[FloatArray, ...]
    """(12,) of each pair, see `pose_manifold`."""
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
    """A lens with the least robust cost."""

    parameters: FloatArray
    """(4,) log focal, exponent or radial term, center, in longer sides."""
    covariance: FloatArray
    """(4, 4)"""
    state: State
    sigma: float
    """Standard deviation of a distance, in longer sides."""


class System(NamedTuple):
    """Normal equations of one pair."""

    H: FloatArray
    """(4, 4) in the lens, the pose eliminated."""
    g: FloatArray
    """(4,) negative gradient."""
    pose_by_lens: FloatArray
    """(5, 4): the step of the pose less this much of the step of the lens."""
    pose_alone: FloatArray
    """(5,)"""


def refine_lens(start: Lens, pairs: Sequence[Pair], sigma: float) -> RefinedLens:
    """Return the lens of the family of `start` with the least robust cost, with its covariance.

    The covariance is the sandwich with pairs as clusters, times MISFIT squared; matches of one keypoint in several
    pairs count as what they are worth.

    Args:
        start: in longer sides of the photos, the center in the middle.
        pairs: matches and first F of each.
        sigma: first standard deviation of a distance, in longer sides.
    """
    matches = [x for x, _ in pairs]
    poses = tuple(_pose_of(F) for _, F in pairs)
    shape = start.exponent if isinstance(start, Fisheye) else start.radial
    state = State(np.array([np.log(start.focal), shape, *start.center]), poses, type(start))
    for _ in range(NOISE_ROUNDS):
        state = _adjust(matches, state, sigma)
        sigma = _noise(matches, state)
    systems = _systems(matches, state, sigma)
    H = sum((system.H for system in systems), np.diag([0.0, 0.0, CENTER_SIGMA**-2, CENTER_SIGMA**-2]))
    inverse = inverse_of_positive(H)
    scores = np.array([system.g for system in systems])
    few = len(pairs) / max(len(pairs) - LENS, 1)
    sandwich = few * inverse @ (scores.T @ scores) @ inverse
    plain = redundancy(matches) * inverse
    wider = MISFIT * np.sqrt(np.maximum(np.diag(sandwich) / np.diag(plain), 1.0))
    return RefinedLens(state.parameters, np.asarray(plain * np.outer(wider, wider), np.float64), state, sigma)


def redundancy(matches: Sequence[FloatArray]) -> float:
    """Return matches over independent errors, >= 1: one keypoint in m photos gives m (m - 1) / 2 matches of 2 m - 3.

    Args:
        matches: (N, 4) of each pair.
    """
    ends = np.concatenate([x[:, :2] for x in matches] + [x[:, 2:] for x in matches])
    each = len(ends) / max(len(np.unique(ends, axis=0)), 1)
    return max(1.0, 0.5 * each * (each + 1.0) / (2.0 * each - 1.0))


def _adjust(matches: Sequence[FloatArray], state: State, sigma: float) -> State:
    damping = DAMPING.first
    for _ in range(MAX_ROUNDS):
        systems, cost = _systems(matches, state, sigma), robust_cost(matches, state, sigma)

        def attempt(tried: float, begin: State = state, systems: list[System] = systems) -> State | None:
            trial = _step(begin, systems, tried)
            if abs(trial.parameters[0]) > MOST_LOG_FOCAL:
                return None
            return trial if robust_cost(matches, trial, sigma) < cost else None  # noqa: B023 -- called in this round

        found, damping = damped_step(attempt, damping, DAMPING)
        if found is None:
            break
        change = np.max(np.abs(found.parameters - state.parameters))
        state = found
        if change < CONVERGED:
            break
    return state


def _step(state: State, systems: list[System], damping: float) -> State:
    """Return the state after one damped step: the lens by all pairs and the prior, then each pose by its pair."""
    prior = np.array([0.0, 0.0, CENTER_SIGMA**-2, CENTER_SIGMA**-2])
    H = sum((system.H for system in systems), np.diag(prior))
    g = sum((system.g for system in systems), -prior * state.parameters)
    step = solve_each(H + damping * np.diag(np.diag(H)), g[:, None])[:, 0]
    poses = tuple(
        np.asarray(retract(pose, system.pose_alone - system.pose_by_lens @ step), np.float64)
        for pose, system in zip(state.poses, systems, strict=True)
    )
    return State(state.parameters + step, poses, state.family)


def _systems(matches: Sequence[FloatArray], state: State, sigma: float) -> list[System]:
    """Return the normal equations of every pair, with derivatives by finite differences."""
    lenses = [state.lens, *(state.lens_at(state.parameters + REFINEMENT_STEP * axis) for axis in np.eye(LENS))]
    return [_system(x, lenses, pose, sigma) for x, pose in zip(matches, state.poses, strict=True)]


def _system(x: FloatArray, lenses: list[Lens], pose: FloatArray, sigma: float) -> System:
    """Return the normal equations of a pair; the first lens is where it stands, the others are a step away."""
    (lens, *moved), E = lenses, _essential(pose)
    pair = bearings_through(lens, x)
    r = signed_distances(E, pair)
    by_lens = [signed_distances(E, bearings_through(other, x)) - r for other in moved]
    by_pose = [
        signed_distances(_essential(retract(pose, REFINEMENT_STEP * axis)), pair) - r for axis in np.eye(POSE_DOF)
    ]
    J, r = np.column_stack(by_lens + by_pose) / (REFINEMENT_STEP * sigma), r / sigma
    weights = (1.0 + (r / ROBUST_SCALE) ** 2) ** -2
    H, g = (J * weights[:, None]).T @ J, -J.T @ (weights * r)
    U, W, V = H[:LENS, :LENS], H[:LENS, LENS:], H[LENS:, LENS:]
    solved = np.linalg.solve(V + 1e-9 * np.trace(V) * np.eye(POSE_DOF), np.column_stack([W.T, g[LENS:]]))
    by, alone = solved[:, :LENS], solved[:, LENS]
    return System(U - W @ by, g[:LENS] - W @ alone, by, alone)


def robust_cost(matches: Sequence[FloatArray], state: State, sigma: float) -> float:
    """Return half the robust squared distances in sigma^2, and the prior's.

    Args:
        matches: (N, 4) of each pair, in longer sides.
        state: the lens and the pose of each pair.
        sigma: standard deviation of a distance.
    """
    prior = 0.5 * float(np.sum((state.parameters[2:] / CENTER_SIGMA) ** 2))
    return float(np.sum(pair_costs(matches, state, sigma))) + prior


def pair_costs(matches: Sequence[FloatArray], state: State, sigma: float) -> FloatArray:
    """Return half the robust squared distances of each pair (P,), in sigma^2.

    Args:
        matches, state, sigma: as for `robust_cost`.
    """
    squared = [(r / sigma) ** 2 for r in _distances(matches, state)]
    return np.array([0.5 * float(np.sum(d / (1.0 + d / ROBUST_SCALE**2))) for d in squared], np.float64)


def _noise(matches: Sequence[FloatArray], state: State) -> float:
    """Return the standard deviation of a distance, from the median of all."""
    distances = np.abs(np.concatenate(_distances(matches, state)))
    return max(MAD_TO_SIGMA * float(np.median(distances)), LEAST_SIGMA)


def _distances(matches: Sequence[FloatArray], state: State) -> list[FloatArray]:
    lens = state.lens
    pairs = zip(matches, state.poses, strict=True)
    return [signed_distances(_essential(pose), bearings_through(lens, x)) for x, pose in pairs]


def _pose_of(F: FloatArray) -> FloatArray:
    """Return a pose (12,) of the essential matrix nearest to F (3, 3); any of the four gives the same distances."""
    R, t = decompose_essential(F)[0]
    return np.concatenate([R.ravel(), t])


def _essential(pose: FloatArray) -> FloatArray:
    E = np.empty((3, 3))
    write_essential(pose, E)
    return E


# The lens that most pairs agree on: focal, projection and center from matches alone, up to more than 180 degrees.
#
# Ours. With the right lens the rays of right matches satisfy q' F p = 0 for some F, whatever the poses; with a
# wrong one curved epipolar lines leave matches outside. So every lens of a grid is asked how many matches it lets
# the pairs keep, and the best one is refined together with the center and the relative poses. Where the lens bends
# much, its curvature alone determines the focal; the equal singular values of E (thesis 5.2) determine it where it
# bends little.

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
