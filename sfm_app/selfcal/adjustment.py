"""Bundle adjustment without points: cameras and relative poses of all pairs, adjusted jointly to their matches.

Ours. A pair has fifteen parameters: five of each camera (`pairs`), and five of its relative pose, which is eliminated
(Schur complement; Triggs and others 2000). The distance of a match is Sampson's (thesis 4.2) for rays, with E = [t]x R
of thesis (5.7), in pixels of the photo as it is, so that undistorting does not change the weight of a pixel::

    r = C / |dC/d(x1, y1, x2, y2)|,    C = q2' E q1,    q = ray of a pixel

Matches that fit badly are downweighted by the cost r^2 / (1 + r^2 / c^2) with c = 3 sigma (Geman and McClure 1987). So
is a pair with right matches but wrong geometry (repeated facades, another camera, a zoom), which pulls at the cameras
far harder than its noise explains, as by thesis (5.23) and (5.24) in Algorithm 3.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from sfm_app.camera.projection import BEARING, RADIUS
from sfm_app.fundamental.solvers import mirror
from sfm_app.geometry.least_squares import DampingRange, damped_step, solve_each, solve_positive
from sfm_app.geometry.poses import POSE_DOF, retract, sampson_of_rays, write_essential, write_nearby_essentials
from sfm_app.jit import kernel
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.selfcal.pairs import write_camera, write_ray
from sfm_app.types.arrays import FloatArray, IndexArray

CAMERA = 5
"""Parameters of one camera: log f, u, v, log a, kappa, by definition in `pairs`."""
PAIR = 2 * CAMERA + POSE_DOF
"""Parameters of a pair: two cameras and a pose, by definition."""
ROBUST_SCALE = 3.0
"""c of the robust cost, in sigma. docs/algorithms/zero-curves.md, 2; by hand."""
OVERFLOW_LIMIT = 1e60
"""Squared distances in sigma^2, or derivatives, above this are not finite; its square is, in double precision."""
_STEP = 1e-6
"""Step of finite differences in the parameters: curvature costs about 1e-6, rounding 1e-10; by hand."""


@dataclass(frozen=True, slots=True)
class AdjustmentOptions:
    """Weights of matches and pairs, and the end of the adjustment."""

    most_matches: int = 1000
    """Most matches of one pair; more are not independent, and would let one pair outvote all others. With 300, errors
    and deviations are half as large again (docs/algorithms/zero-curves.md, 2)."""
    quarter_weight_gain: float = 3.0
    """Log-likelihood gain from own cameras at which a pair's weight is a quarter. By definition of chi^2 with two
    degrees of freedom, noise alone gains as much once in twenty times: exp(-3)."""
    own_camera_sigmas: tuple[float, ...] = (0.3, 0.15, 0.15, 0.2, 0.2)
    """Standard deviations of a pair's own cameras from the common ones, in log f, u, v, log a, kappa; by hand."""
    least_sigma_px: float = 0.1
    """Least standard deviation of a distance: matches without noise would have unbounded weight; by hand."""
    few_photos: int = 5
    """Photos below which a camera absorbs unmodeled effects (a lens, a moving wall) into focal and center; by hand."""
    few_photos_trust: float = 0.25
    """Factor on the information of its pairs, as if their noise were twice as large; by hand."""
    rounds: int = 25
    """Most rounds of reweighting and stepping; by hand."""
    converged: float = 2e-5
    """Largest change of a camera's parameter that ends the rounds; by hand."""


ADJUSTMENT = AdjustmentOptions()
DAMPING = DampingRange(first=1e-4, least=1e-9, most=1e8)
"""Damping of Levenberg-Marquardt steps, relative to the diagonal; by hand."""


@kernel
def distances(
    matches: FloatArray, ends: IndexArray, thetas: FloatArray, cameras: IndexArray, poses: FloatArray
) -> FloatArray:
    """Return (M,) signed Sampson distances; pair k has the matches ends[k] to ends[k + 1] - 1."""
    E, first, second = np.empty((3, 3)), np.empty(5), np.empty(5)
    p, q = np.empty(BEARING + 1), np.empty(BEARING + 1)
    signed = np.empty(len(matches))
    for k in range(len(poses)):
        write_essential(poses[k], E)
        write_camera(thetas[cameras[k, 0]], first)
        write_camera(thetas[cameras[k, 1]], second)
        for i in range(ends[k], ends[k + 1]):
            write_ray(matches[i, 0], matches[i, 1], first, -1.0, p)
            write_ray(matches[i, 2], matches[i, 3], second, -1.0, q)
            signed[i] = sampson_of_rays(p, q, E)
    return signed


@kernel
def pair_costs(
    matches: FloatArray, ends: IndexArray, thetas: FloatArray, cameras: IndexArray, poses: FloatArray, sigma: float
) -> FloatArray:
    """Return (P,) half the sum of the robust squared distances of each pair, in sigma^2; arguments as `distances`."""
    signed = distances(matches, ends, thetas, cameras, poses)
    costs = np.zeros(len(poses))
    for k in range(len(poses)):
        for i in range(ends[k], ends[k + 1]):
            r2 = (signed[i] / sigma) ** 2
            costs[k] += 0.5 * r2 / (1.0 + r2 / ROBUST_SCALE**2) if r2 < OVERFLOW_LIMIT else 0.5 * ROBUST_SCALE**2
    return costs


@kernel
def pair_systems(
    matches: FloatArray, ends: IndexArray, thetas: FloatArray, cameras: IndexArray, poses: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Return the Gauss-Newton systems (P, 15, 15) and (P, 15) of all pairs over camera 1, camera 2 and pose.

    Where both views are of one camera, all of its entries are in the first five rows and columns.
    """
    A, b = np.zeros((len(poses), PAIR, PAIR)), np.zeros((len(poses), PAIR))
    # derivatives are finite differences: index 0 is unchanged, 1 to 5 have one parameter moved
    lenses, Es = np.empty((2, 1 + CAMERA, 5)), np.empty((1 + POSE_DOF, 3, 3))
    rays, J = np.empty((2, 1 + CAMERA, BEARING + 1)), np.empty(PAIR)
    for k in range(len(poses)):
        shared = cameras[k, 0] == cameras[k, 1]
        J[:] = 0.0
        write_nearby_essentials(poses[k], _STEP, Es)
        for view in range(2):
            _write_cameras(thetas[cameras[k, view]], lenses[view])
        for i in range(ends[k], ends[k + 1]):
            for view in range(2):
                _write_rays(matches[i, 2 * view], matches[i, 2 * view + 1], lenses[view], rays[view])
            r = _write_derivatives(rays, Es, sigma, shared, J)
            if _is_finite(r, J):
                _add_match(A[k], b[k], J, r, (1.0 + r * r / ROBUST_SCALE**2) ** -2)
        mirror(A[k])
    return A, b


@kernel
def _write_cameras(theta: FloatArray, lenses: FloatArray) -> None:
    """Write the camera of the parameters (5,), and with each of them a step away, into `lenses` (6, 5)."""
    trial = theta.copy()
    write_camera(trial, lenses[0])
    for j in range(CAMERA):
        value = trial[j]
        trial[j] = value + _STEP
        write_camera(trial, lenses[1 + j])
        trial[j] = value


@kernel
def _write_rays(x: float, y: float, lenses: FloatArray, rays: FloatArray) -> None:
    """Write the ray of a pixel through each of `lenses` (6, 5) into `rays` (6, 10); the first starts the others."""
    guess = -1.0
    for j in range(1 + CAMERA):
        write_ray(x, y, lenses[j], guess, rays[j])
        guess = rays[0, RADIUS]


@kernel
def _write_derivatives(rays: FloatArray, Es: FloatArray, sigma: float, shared: bool, J: FloatArray) -> float:
    """Return the distance r of one match in sigma, and write its derivatives to `J` (15,); `shared` is one camera."""
    r = sampson_of_rays(rays[0, 0], rays[1, 0], Es[0]) / sigma
    for j in range(CAMERA):
        if shared:
            J[j] = (sampson_of_rays(rays[0, 1 + j], rays[1, 1 + j], Es[0]) / sigma - r) / _STEP
        else:
            J[j] = (sampson_of_rays(rays[0, 1 + j], rays[1, 0], Es[0]) / sigma - r) / _STEP
            J[CAMERA + j] = (sampson_of_rays(rays[0, 0], rays[1, 1 + j], Es[0]) / sigma - r) / _STEP
    for j in range(POSE_DOF):
        J[2 * CAMERA + j] = (sampson_of_rays(rays[0, 0], rays[1, 0], Es[1 + j]) / sigma - r) / _STEP
    return float(r)


@kernel
def _is_finite(r: float, J: FloatArray) -> bool:
    """Return whether a distance and its derivatives are finite; at an epipole the gradient vanishes."""
    total = r * r
    for j in range(PAIR):
        total += abs(J[j])
    return bool(total < OVERFLOW_LIMIT)


@kernel
def _add_match(A: FloatArray, b: FloatArray, J: FloatArray, r: float, weight: float) -> None:
    """Add one match: weight J'J to the lower triangle of A, -weight J'r to b."""
    for i in range(PAIR):
        scaled = weight * J[i]
        b[i] -= scaled * r
        for j in range(i + 1):
            A[i, j] += scaled * J[j]


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Independent normal priors on the parameters of all cameras."""

    mean: FloatArray
    """(C, 5)."""
    precision: FloatArray
    """(C, 5), 1 / variance, > 0."""

    def cost(self, thetas: FloatArray) -> float:
        """Return negative log-density, without its constant."""
        return 0.5 * float(np.sum(self.precision * (thetas - self.mean) ** 2))


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """State of the adjustment."""

    thetas: FloatArray
    """(C, 5) parameters of the cameras, see `pairs`."""
    poses: FloatArray
    """(P, 12), see `geometry.poses.write_essential`."""
    weights: FloatArray
    """(P,) in [0, 1]: how well a pair agrees with the others."""
    sigma: float
    """Standard deviation of a Sampson distance."""
    scale: float = 1.0
    """How many times larger the gains from own cameras are than noise explains, >= 1; `conflict` in the evidence."""


@dataclass(frozen=True, slots=True, eq=False)
class Information:
    """Information of each pair about the cameras, with its pose eliminated."""

    hessians: FloatArray
    """(P, 10, 10) of camera 1 and camera 2; where both are the same camera, all in the first five rows and columns."""
    gradients: FloatArray
    """(P, 10) negative gradients."""
    gains: FloatArray
    """(P,) log-likelihood that a pair would gain from cameras of its own."""


class Matches:
    """Inliers of all pairs, concatenated, at most `most` of a pair.

    `inliers` (N, 4) are from the middle of each photo, in longer sides of the largest photo: `unit_px`. `cameras` and
    `photos` (P, 2) are numbers; there are `count` cameras.
    """

    def __init__(
        self, inliers: Sequence[FloatArray], cameras: IndexArray, photos: IndexArray, unit_px: float,
        most: int = ADJUSTMENT.most_matches, count: int = 1,
    ) -> None:  # fmt: skip
        # points outside of the photos are no matches, and would overflow
        inside = [subsample_rows(x[np.all(np.abs(x) <= 1.0, axis=1)], most) for x in inliers]
        self.unit_px = unit_px
        self.points = np.ascontiguousarray(np.concatenate([*inside, np.empty((0, 4))]))
        self.ends = np.concatenate([[0], np.cumsum([len(x) for x in inside])]).astype(np.int64)
        self.cameras = np.ascontiguousarray(cameras, dtype=np.int64)
        self.photos = np.asarray(photos, dtype=np.int64)
        self.count = count
        self.least_sigma = ADJUSTMENT.least_sigma_px / unit_px
        photo_counts = [len(np.unique(self.photos[self.cameras == camera])) for camera in range(count)]
        few = np.array(photo_counts, np.int64) < ADJUSTMENT.few_photos
        self.trust = np.where(few[self.cameras].any(axis=1), ADJUSTMENT.few_photos_trust, 1.0)

    @cached_property
    def redundancy(self) -> float:
        """Matches per error, >= 1: one keypoint in m photos gives m (m - 1) / 2 matches, but 2 m - 3 errors."""
        if len(self.points) == 0:
            return 1.0
        photos = self.photos.repeat(np.diff(self.ends), axis=0)
        views = [np.column_stack([photos[:, view], self.points[:, 2 * view : 2 * view + 2]]) for view in range(2)]
        keypoints = np.concatenate(views)
        keypoints = keypoints[np.lexsort(keypoints.T)]
        each = 2 * len(self.points) / (1 + np.count_nonzero((keypoints[1:] != keypoints[:-1]).any(axis=1)))
        return max(1.0, 0.5 * each * (each + 1.0) / (2.0 * each - 1.0))

    def pair_matches(self, pair: int) -> FloatArray:
        """Return the matches (N, 4) of one pair."""
        return self.points[self.ends[pair] : self.ends[pair + 1]]

    def select(self, pairs: IndexArray) -> "Matches":
        """Return the matches of the given pairs only."""
        if len(pairs) == len(self.cameras):
            return self
        inliers = [self.pair_matches(pair) for pair in pairs]
        return Matches(inliers, self.cameras[pairs], self.photos[pairs], self.unit_px, count=self.count)

    def subsample(self, most: int) -> "Matches":
        """Return at most `most` matches of each pair, evenly chosen."""
        inliers = [self.pair_matches(pair) for pair in range(len(self.cameras))]
        return Matches(inliers, self.cameras, self.photos, self.unit_px, most, self.count)

    def costs(self, state: State) -> FloatArray:
        """Return (P,) robust costs of the pairs."""
        return np.asarray(
            pair_costs(self.points, self.ends, state.thetas, self.cameras, state.poses, state.sigma), np.float64
        )

    def noise(self, state: State) -> float:
        """Return the standard deviation of distances in agreeing pairs; a pose absorbs five degrees of freedom."""
        counts = np.diff(self.ends)
        residuals = np.abs(distances(self.points, self.ends, state.thetas, self.cameras, state.poses))
        residuals *= np.repeat(np.sqrt(counts / np.maximum(counts - POSE_DOF, 1)), counts)
        agreeing = np.repeat(state.weights > 0.5, counts)
        return max(MAD_TO_SIGMA * float(np.median(residuals[agreeing])) if agreeing.any() else 0.0, self.least_sigma)

    def assemble(self, information: Information, factors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Sum the information of the pairs, times (P,) factors, into (5C, 5C) and (5C,) over all cameras."""
        rows = (CAMERA * self.cameras[:, :, None] + np.arange(CAMERA)).reshape(-1, 2 * CAMERA)
        H, b = np.zeros((CAMERA * self.count,) * 2), np.zeros(CAMERA * self.count)
        np.add.at(H, (rows[:, :, None], rows[:, None, :]), factors[:, None, None] * information.hessians)
        np.add.at(b, rows, factors[:, None] * information.gradients)
        return H, b


def subsample_rows(rows: FloatArray, most: int) -> FloatArray:
    """Return at most `most` rows, evenly chosen."""
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(np.int64)]


def adjust_cameras(matches: Matches, state: State, prior: Prior, rounds: int = ADJUSTMENT.rounds) -> State:
    """Adjust cameras and poses: reweight the pairs and take Levenberg-Marquardt steps until the cameras converge."""
    damping = DAMPING.first
    for _ in range(rounds):
        system = _normal_equations(matches, state)
        state = _weigh_pairs(state, system)
        trial, damping = _take_step(matches, state, prior, system, damping)
        change = np.max(np.abs(trial.thetas - state.thetas), initial=0.0)
        state = replace(trial, sigma=matches.noise(trial))
        if change < ADJUSTMENT.converged:
            break
    return reweight(matches, state)


def reweight(matches: Matches, state: State) -> State:
    """Return the state with new weights of the pairs and their scale."""
    return _weigh_pairs(state, _normal_equations(matches, state))


def pair_information(matches: Matches, state: State) -> Information:
    """Eliminate the poses and return the information of each pair about the cameras."""
    return _reduce_to_cameras(_normal_equations(matches, state))


def _normal_equations(matches: Matches, state: State) -> tuple[FloatArray, FloatArray]:
    return pair_systems(matches.points, matches.ends, state.thetas, matches.cameras, state.poses, state.sigma)


def _reduce_to_cameras(system: tuple[FloatArray, FloatArray]) -> Information:
    """Return the information of the pairs about their cameras, and the gains g = b' H^-1 b / 2 (see `_weigh_pairs`)."""
    H, b, _, _ = eliminate_poses(*system, 0.0)
    own = np.diag(np.tile(np.array(ADJUSTMENT.own_camera_sigmas) ** -2.0, 2))
    gains = 0.5 * np.einsum("pi,pi->p", b, solve_each(H + own, b[..., None])[..., 0])
    return Information(H, b, gains)


def _weigh_pairs(state: State, system: tuple[FloatArray, FloatArray]) -> State:
    """Weigh every pair by the log-likelihood g that it would gain from cameras of its own::

        g = b' H^-1 b / 2,      w = (1 + g / (3 s))^-2,      s = max(1, lower quartile of all g / 0.288)

    H and b are the pair's Hessian and negative gradient in its cameras, the poses eliminated, with the prior
    `own_camera_sigmas`. With noise alone, g is half of a chi^2 variable of two degrees of freedom, whose lower quartile
    is 0.288 = -ln(3/4). w is the derivative of Geman and McClure's cost (1987) g / (1 + g / (3 s)): iteratively
    reweighted least squares.
    """
    gains = _reduce_to_cameras(system).gains
    scale = max(1.0, float(np.quantile(gains, 0.25)) / 0.288) if len(gains) else 1.0
    return replace(state, weights=(1.0 + gains / (ADJUSTMENT.quarter_weight_gain * scale)) ** -2, scale=scale)


def eliminate_poses(A: FloatArray, b: FloatArray, damping: float) -> tuple[FloatArray, ...]:
    """Eliminate the poses, the last unknowns, from the systems of all pairs (`pair_systems`) by the Schur complement::

        A = | U   W |     (U - W V^-1 W') d_cameras = b_cameras - W V^-1 b_pose
            | W'  V |

    The damping of V is relative to its diagonal. Return the reduced Hessians (P, n, n) and gradients (P, n) of the n
    parameters of cameras, and for back substitution V^-1 W' (P, 5, n) and V^-1 b_pose (P, 5).
    """
    n = b.shape[1] - POSE_DOF
    V = A[:, n:, n:].copy()
    diagonal = np.arange(V.shape[-1])
    # few or degenerate matches leave a pose undetermined: the damping must not vanish beside the largest entry
    least = 1e-9 + 1e-12 * np.max(V[:, diagonal, diagonal], axis=1, keepdims=True)
    V[:, diagonal, diagonal] += damping * V[:, diagonal, diagonal] + least
    solved = np.linalg.solve(V, np.concatenate([A[:, n:, :n], b[:, n:, None]], axis=2))
    pose_by_cameras, pose_alone = np.split(solved, [n], axis=2)
    W = A[:, :n, n:]
    return A[:, :n, :n] - W @ pose_by_cameras, b[:, :n] - (W @ pose_alone)[..., 0], pose_by_cameras, pose_alone[..., 0]


def _take_step(
    matches: Matches, state: State, prior: Prior, system: tuple[FloatArray, FloatArray], damping: float
) -> tuple[State, float]:
    """Take one step that lowers the cost, damped as far as needed; return the state and the next damping."""
    factors = matches.trust * state.weights / state.scale
    cost = float(factors @ matches.costs(state)) + prior.cost(state.thetas)

    def attempt(damping: float) -> State | None:
        # cameras from all pairs and the prior, then each pose from its pair
        hessians, gradients, pose_by_cameras, pose_alone = eliminate_poses(*system, damping)
        H, g = matches.assemble(Information(hessians, gradients, np.empty(0)), factors)
        H += np.diag(prior.precision.ravel())
        g += (prior.precision * (prior.mean - state.thetas)).ravel()
        step = solve_positive(H + damping * np.diag(np.diag(H)), g[:, None]).reshape(-1, CAMERA)
        of_pairs = step[matches.cameras].reshape(-1, 2 * CAMERA)
        pose_steps = pose_alone - (pose_by_cameras @ of_pairs[..., None])[..., 0]
        poses = np.array([retract(*moved) for moved in zip(state.poses, pose_steps, strict=True)]).reshape(-1, 12)
        trial = replace(state, thetas=state.thetas + step, poses=poses)
        return trial if float(factors @ matches.costs(trial)) + prior.cost(trial.thetas) <= cost else None

    better, damping = damped_step(attempt, damping, DAMPING)
    return better or state, damping
