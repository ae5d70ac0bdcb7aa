"""Critical motions leave the focal open: E = K'FK has equal singular values at any focal.

Sturm (1999); the degenerate motions of thesis 5.4. Recognizing them by the estimated poses is ours.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from sfm_app.fundamental.refits import refine_sampson
from sfm_app.geometry.epipolar import essential_from_fundamental, relative_pose
from sfm_app.geometry.least_squares import lift_eigenvalues
from sfm_app.selfcal.adjustment import (
    CAMERA,
    CONFLICT,
    OWN_CAMERA_SIGMAS,
    Information,
    Matches,
    Prior,
    State,
    adjust_cameras,
    pair_information,
    reweight,
    subsample_rows,
)
from sfm_app.selfcal.pairs import CENTER_U, CENTER_V, KAPPA, LOG_ASPECT, LOG_FOCAL, undistort_points
from sfm_app.selfcal.priors import ASPECT, NAMES, CameraPriors, Evidence
from sfm_app.types import PairId
from sfm_app.types.arrays import BoolArray, FloatArray
from sfm_app.types.camera import named_correlations

# Fit initial cameras to their matches: adjust, free the parameters that the evidence supports, adjust again.
#
# Ours; the thesis calibrates from fundamental matrices alone.

FEW_MATCHES = 100
"""Matches per pair until the cameras have nearly converged. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
FIRST_ROUNDS, LAST_ROUNDS = 8, 12
"""Rounds before starts are compared, and rounds with all matches. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
POSE_MATCHES = 30
"""Matches that decide which of the four poses of an E is right. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
EVIDENCE_ROUNDS = 3
"""Most rounds of choosing the free parameters by the evidence and adjusting again. Chosen by hand; halved and doubled
by `benchmarks.sensitivity`."""
JACKKNIFE_GROUPS = 8
"""Groups of neighboring photos that are left out in turn (docs/algorithms.md, Self-calibration, 4). Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""
LEAST_PHOTOS, LEAST_REMAINING_WEIGHT = 6, 4.0
"""Photos, and weight of the remaining pairs, below which a jackknife reflects the missing pairs rather than errors.
docs/algorithms.md, Self-calibration, 4. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
REFIT_SCALE = 3.0
"""Scale of the robust refit of an F, in sigma. As `two_view_cost.ROBUST_SCALE`. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Cameras adjusted to their matches."""

    matches: Matches
    state: State
    free: BoolArray
    """(C, 4) which parameters the evidence freed, see `camera_priors`."""
    prior: Prior
    priors: CameraPriors
    held: BoolArray | None = None
    """(C, 4) parameters that stay at their usual values because the pairs do not determine them."""

    def held_names(self, camera: int) -> tuple[str, ...]:
        """Return the names of the parameters that one camera holds at their usual values."""
        return tuple(name for place, name in enumerate(NAMES) if self.held is not None and self.held[camera, place])

    @property
    def information(self) -> Information:
        """Information of each pair about the cameras."""
        return pair_information(self.matches, self.state)

    @property
    def trust(self) -> FloatArray:
        """(P,) factor of each pair's information, reduced because matches that share keypoints are not independent."""
        return np.asarray(
            self.matches.trust * self.state.weights / (self.state.scale * self.matches.redundancy), np.float64
        )

    @property
    def evidence(self) -> Evidence:
        """Joint likelihood of all pairs about the cameras."""
        H, g = self.matches.assemble(self.information, self.trust)
        return Evidence(self.state.thetas, H, g, float(np.sum(self.state.weights)), self.priors)

    def cost(self, sigma: float, scale: float) -> float:
        """Return the negative log-probability that ranks fits from different starts, each pair's part bounded.

        Args:
            sigma: standard deviation of a distance, the same for all fits: its own larger one would favor a wrong fit.
            scale: scale of the disagreement, the same for all fits for that reason.
        """
        state = reweight(self.matches, replace(self.state, sigma=sigma))
        gains = pair_information(self.matches, state).gains / (scale * self.matches.redundancy)
        H = replace(self, state=state).evidence.H + np.diag(self.prior.precision.ravel())
        volume = 0.5 * float(np.linalg.slogdet(lift_eigenvalues(H))[1] - np.sum(np.log(self.prior.precision)))
        bounded = float(np.sum(gains / (1.0 + gains / CONFLICT)))
        return bounded + self.prior.cost(state.thetas) + volume - self.priors.log_odds(self.free)


def fit_cameras(matches: Matches, Fs: FloatArray, starts: Sequence[FloatArray], priors: CameraPriors) -> Fit:
    """Fit the cameras from all starts, then with non-square pixels, and return the best fit.

    Args:
        matches: inliers, with the origin at the middle of each photo.
        Fs: (P, 3, 3) in the same frame and units; initialize the poses.
        starts: (C, 5) each, initial cameras, the most likely first.
        priors: prior knowledge about the cameras.
    """
    few = matches.subsample(FEW_MATCHES)
    best = _select_best([_fit_from_start(few, Fs, thetas, priors, square=True) for thetas in starts])
    others = [_fit_from_start(few, Fs, thetas, priors, square=False) for thetas in (best.state.thetas, starts[0])]
    fit = _select_best([best, *others])
    state = adjust_cameras(few, fit.state, fit.prior)
    fit = replace(fit, matches=matches, state=adjust_cameras(matches, state, fit.prior, LAST_ROUNDS))
    for _ in range(EVIDENCE_ROUNDS):
        free = fit.evidence.choose(fit.free)
        if np.array_equal(free, fit.free):
            break
        prior = priors.prior(free, fit.state.thetas)
        state = adjust_cameras(few, fit.state, prior)
        fit = Fit(matches, adjust_cameras(matches, state, prior, LAST_ROUNDS), free, prior, priors)
    held = fit.evidence.undetermined_parts(fit.free)
    prior = priors.prior(fit.free, fit.state.thetas, held)
    return replace(fit, prior=prior, held=held, state=adjust_cameras(matches, fit.state, prior, LAST_ROUNDS))


def extend_to_all_pairs(fit: Fit, matches: Matches, Fs: FloatArray) -> Fit:
    """Return the fit with a pose for every pair, including pairs that it was not adjusted to.

    Args:
        fit: cameras adjusted to some of the pairs.
        matches: inliers of all P pairs.
        Fs: (P, 3, 3) in the frame and units of the matches; initialize the poses.
    """
    if len(matches.cameras) == len(fit.matches.cameras):
        return fit
    state = replace(fit.state, poses=_estimate_poses(matches, Fs, fit.state.thetas), weights=np.ones(len(Fs)))
    return replace(fit, matches=matches, state=state)


def jackknife_deviations(fit: Fit) -> FloatArray:
    """Return (5C,) standard deviations of the cameras by a jackknife over the photos; 0 where the photos are too few.

    Consecutive photos form a group, because neighbors often share an error (blur, a rolling shutter, a repeated wall).
    With each group left out, the cameras take the step of the remaining pairs. The weights of the pairs stay fixed:
    otherwise wrong pairs would gain weight where right ones are left out.
    """
    photos, nothing = np.unique(fit.matches.photos), np.zeros(fit.state.thetas.size)
    if len(photos) < LEAST_PHOTOS:
        return nothing
    groups = np.array_split(photos, min(JACKKNIFE_GROUPS, len(photos)))
    information, trust, steps = fit.information, fit.trust, []
    for group in groups:
        left = ~np.isin(fit.matches.photos, group).any(axis=1)
        if np.sum(fit.state.weights[left]) < LEAST_REMAINING_WEIGHT:
            return nothing
        H, g = fit.matches.assemble(information, np.where(left, trust, 0.0))
        precision, away = fit.prior.precision.ravel(), (fit.prior.mean - fit.state.thetas).ravel()
        steps.append(np.linalg.solve(H + np.diag(precision), g + precision * away))
    spread = np.array(steps) - np.mean(steps, axis=0)
    return np.asarray(np.sqrt((len(groups) - 1) / len(groups) * np.sum(spread**2, axis=0)), np.float64)


def undistorted_fundamentals(fit: Fit) -> FloatArray:
    """Return (P, 3, 3) F's of the undistorted photos, refitted to the matches without assuming a K."""
    thetas, cameras = fit.state.thetas, fit.matches.cameras
    found = np.empty((len(cameras), 3, 3))
    for pair, (first, second) in enumerate(cameras):
        x = fit.matches.pair_matches(pair)
        views = (undistort_points(x[:, :2], thetas[first]), undistort_points(x[:, 2:], thetas[second]))
        inverses = [np.linalg.inv(intrinsic_matrix(thetas[camera])) for camera in (first, second)]
        E = _essential_matrix(fit.state.poses[pair])
        start = inverses[1].T @ E @ inverses[0]
        refit = refine_sampson(np.asfortranarray(np.hstack(views)), start, scale=REFIT_SCALE * fit.state.sigma)
        found[pair] = refit if np.isfinite(refit).all() and refit.any() else start
    return found


def intrinsic_matrix(theta: FloatArray) -> FloatArray:
    """Return the (3, 3) camera matrix of the parameters (5,), in their units from the middle of the photo."""
    f, half = np.exp(theta[LOG_FOCAL]), np.exp(0.5 * theta[LOG_ASPECT])
    return np.array([[f / half, 0.0, theta[CENTER_U]], [0.0, f * half, theta[CENTER_V]], [0.0, 0.0, 1.0]])


def _select_best(fits: Sequence[Fit]) -> Fit:
    sigma, scale = (min(getattr(fit.state, name) for fit in fits) for name in ("sigma", "scale"))
    return min(fits, key=lambda fit: fit.cost(sigma, scale))


def _fit_from_start(few: Matches, Fs: FloatArray, thetas: FloatArray, priors: CameraPriors, *, square: bool) -> Fit:
    free = np.ones((len(thetas), len(NAMES)), np.bool_)
    free[:, ASPECT] = not square
    prior = priors.prior(free, thetas)
    state = State(thetas, _estimate_poses(few, Fs, thetas), np.ones(len(Fs)), few.least_sigma)
    state = adjust_cameras(few, replace(state, sigma=few.noise(state)), prior, FIRST_ROUNDS)
    return Fit(few, state, free, prior, priors)


def _estimate_poses(few: Matches, Fs: FloatArray, thetas: FloatArray) -> FloatArray:
    poses = np.empty((len(Fs), 12))
    for pair, (first, second) in enumerate(few.cameras):
        K1, K2 = intrinsic_matrix(thetas[first]), intrinsic_matrix(thetas[second])
        x = subsample_rows(few.pair_matches(pair), POSE_MATCHES)
        rays = [
            (undistort_points(points, thetas[camera]) - K[:2, 2]) / K[[0, 1], [0, 1]]
            for points, camera, K in ((x[:, :2], first, K1), (x[:, 2:], second, K2))
        ]
        R, t, _, _ = relative_pose(essential_from_fundamental(Fs[pair], K1, K2), *rays)
        poses[pair] = np.concatenate([R.ravel(), t / np.linalg.norm(t)])
    return poses


def _essential_matrix(pose: FloatArray) -> FloatArray:
    R, t = pose[:9].reshape(3, 3), pose[9:]
    return np.asarray(np.cross(t, R, axisb=0, axisc=0), np.float64)


# Uncertainty of a fit: covariances, standard deviations in pixels, and the most informative pairs.
#
# Ours; leaving out photos is the jackknife (Efron 1982). Key pairs are what chapter 6 of the thesis asks for.

PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "k1")
MODEL_ERROR = np.array([1e-3, 1e-3, 1e-3, 1e-3, 3e-3])
"""Standard deviations of errors that no lens model covers: of log f, u and v in longer sides, log a, and k1.
docs/algorithms.md, Self-calibration, 4. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
LEAST_KEY_WEIGHT = 0.5
"""A pair with a smaller weight in the fit is no key pair. docs/algorithms.md, Self-calibration, 7. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""


def covariance(fit: Fit, sides: FloatArray, *, resampled: bool = False) -> FloatArray:
    """Return the (5C, 5C) covariance of all parameters over all choices of free ones, plus the model error.

    Args:
        fit: cameras adjusted to matches.
        sides: (C,) longer sides of the photos.
        resampled: widen it where leaving photos out moves the cameras further than it predicts.
    """
    found = fit.evidence.covariance(fit.free)
    if resampled:
        deviations = np.sqrt(np.diag(found))
        wider = np.maximum(jackknife_deviations(fit) / deviations, 1.0)
        found = found * np.outer(wider, wider)
    floor = np.tile(MODEL_ERROR, (len(sides), 1))
    floor[:, CENTER_U : CENTER_V + 1] *= sides[:, None]
    floor[:, KAPPA] /= np.exp(2.0 * fit.state.thetas[:, LOG_FOCAL])
    return np.asarray(found + np.diag(floor.ravel() ** 2), np.float64)


class Uncertainty(NamedTuple):
    """How far the parameters of a camera may be off, and which of them are off together; as in `Calibration`."""

    spread: dict[str, float]
    correlations: dict[str, float]


def camera_uncertainty(theta: FloatArray, cov: FloatArray, unit_px: float) -> Uncertainty:
    """Return the standard deviations of fx, fy, cx, cy in pixels and of k1, and their correlations.

    Args:
        theta: (5,) parameters of the camera.
        cov: (5, 5) their covariance.
        unit_px: pixels per unit of theta.
    """
    focal, squared = float(np.exp(theta[LOG_FOCAL])) * unit_px, float(np.exp(2.0 * theta[LOG_FOCAL]))
    half = float(np.exp(0.5 * theta[LOG_ASPECT]))
    # rows: how fx, fy, cx, cy, k1 change with log f, u, v, log a, kappa
    slopes = np.zeros((CAMERA, CAMERA))
    slopes[0, [LOG_FOCAL, LOG_ASPECT]] = focal / half, -0.5 * focal / half
    slopes[1, [LOG_FOCAL, LOG_ASPECT]] = focal * half, 0.5 * focal * half
    slopes[2, CENTER_U] = slopes[3, CENTER_V] = unit_px
    slopes[4, [LOG_FOCAL, KAPPA]] = 2.0 * theta[KAPPA] * squared, squared
    found = slopes @ cov @ slopes.T
    deviations = np.sqrt(np.maximum(np.diag(found), 0.0))
    return Uncertainty(
        dict(zip(PARAMETER_NAMES, deviations.tolist(), strict=True)), named_correlations(PARAMETER_NAMES, found)
    )


def key_pairs(fit: Fit, photos: tuple[PairId, ...]) -> tuple[PairId, ...]:
    """Return the pairs that agree with the cameras, the most informative first.

    Their views differ in more than position.

    Args:
        fit: cameras adjusted to P pairs.
        photos: (P,) the two photos of each; may be empty.
    """
    if not photos:
        return ()
    alone = np.tile(OWN_CAMERA_SIGMAS, 2)
    news = np.linalg.slogdet(lift_eigenvalues(np.eye(2 * CAMERA) + alone[:, None] * fit.information.hessians * alone))[
        1
    ]
    worth = fit.state.weights * news
    order = [pair for pair in np.argsort(-worth, kind="stable") if fit.state.weights[pair] >= LEAST_KEY_WEIGHT]
    return tuple(photos[pair] for pair in order)


LEAST_ROTATION_DEG = 3.0
"""Median rotation of pairs below which the axes count as parallel. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
ISOSCELES = 0.1
"""Largest median deviation, in cosines, of pairs whose axes meet at one distance from both cameras. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""


def critical_motion(fit: Fit) -> str:
    """Return the critical motion of most pairs in words for the user; empty where there is none.

    Parallel axes, and axes that meet at one distance from both cameras (an isosceles triangle, as on an orbit), are the
    two for which one pair does not constrain the focal (Sturm 1999).
    """
    R = fit.state.poses[:, :9].reshape(-1, 3, 3)
    if len(R) == 0:
        return ""
    turned = np.degrees(np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)))
    if np.median(turned) < LEAST_ROTATION_DEG:
        return "the camera hardly turned between the photos (parallel axes)"
    baseline = -np.einsum("pij,pi->pj", R, fit.state.poses[:, 9:])
    second = R[:, 2]
    # in the frame of view 1, whose axis is z: both axes lean alike towards the baseline, and all three lie in a plane
    lean = np.abs(baseline[:, 2] + np.einsum("pi,pi->p", second, baseline))
    out_of_plane = np.abs(np.cross(second, baseline)[:, 2])
    if np.median(np.maximum(lean, out_of_plane)) < ISOSCELES:
        return "the photos look at one point from one distance (an orbit)"
    return ""
