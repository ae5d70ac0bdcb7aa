"""A lens, its center and the relative poses of pairs adjusted to their matches at once.

Ours, as `structureless_ba` does it for lenses with one radial term: every pair has its own pose, which is eliminated
(Schur complement, Triggs and others 2000). Distances are Sampson's (thesis 4.2) in the photos, downweighted by the cost
of Geman and McClure (1987).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.damping import DampingRange, damped_step
from sfm_app.geometry.essential import decompose_essential
from sfm_app.geometry.lenses.ray_epipolar import signed_distances
from sfm_app.geometry.pose_manifold import POSE_DOF, retract, write_essential
from sfm_app.geometry.spd_solve import inverse_of_positive, solve_each
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.selfcal.wide_angle.fisheye import Fisheye, Lens, RadialLens, bearings_through

FloatArray = NDArray[np.float64]

LENS = 4
"""Parameters of a lens: log focal, exponent, center. Counted."""
ROBUST_SCALE = 3.0
"""Of Geman and McClure's cost, in sigma, as in `two_view_cost`. Chosen by hand; not measured on its own."""
CENTER_SIGMA = 0.02
"""Prior standard deviation of the center from the middle, in longer sides. Chosen by hand; not measured on its own."""
STEP = 1e-6
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
    lenses = [state.lens, *(state.lens_at(state.parameters + STEP * axis) for axis in np.eye(LENS))]
    return [_system(x, lenses, pose, sigma) for x, pose in zip(matches, state.poses, strict=True)]


def _system(x: FloatArray, lenses: list[Lens], pose: FloatArray, sigma: float) -> System:
    """Return the normal equations of a pair; the first lens is where it stands, the others are a step away."""
    (lens, *moved), E = lenses, _essential(pose)
    pair = bearings_through(lens, x)
    r = signed_distances(E, pair)
    by_lens = [signed_distances(E, bearings_through(other, x)) - r for other in moved]
    by_pose = [signed_distances(_essential(retract(pose, STEP * axis)), pair) - r for axis in np.eye(POSE_DOF)]
    J, r = np.column_stack(by_lens + by_pose) / (STEP * sigma), r / sigma
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
