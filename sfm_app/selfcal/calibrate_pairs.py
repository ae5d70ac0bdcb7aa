"""Fit cameras to the matches of pairs, with their uncertainty and the motions that leave the focal open.

Ours; the thesis calibrates from fundamental matrices alone. Cameras are adjusted from several starts, the parameters
that the evidence supports are freed, and the cameras are adjusted again. The jackknife over photos is Efron's (1982);
key pairs are a wish of thesis chapter 6; the degenerate motions are those of thesis 5.4 and Sturm (1999).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sfm_app.camera.models import ASPECT
from sfm_app.fundamental.refits import refine_sampson
from sfm_app.geometry.epipolar import essential_from_fundamental, relative_pose
from sfm_app.geometry.least_squares import lift_eigenvalues
from sfm_app.selfcal.adjustment import (
    ADJUSTMENT,
    CAMERA,
    ROBUST_SCALE,
    Information,
    Matches,
    Prior,
    State,
    adjust_cameras,
    pair_information,
    reweight,
    subsample_rows,
)
from sfm_app.selfcal.pairs import (
    CENTER_U,
    CENTER_V,
    KAPPA,
    LOG_ASPECT,
    LOG_FOCAL,
    parameters_from_calibration,
    sides_from_pixels,
    undistort_points,
)
from sfm_app.selfcal.priors import NAMES, CameraPriors, Evidence
from sfm_app.types import Calibration, CameraPairs, PairId
from sfm_app.types.arrays import BoolArray, FloatArray
from sfm_app.types.camera import named_correlations


class FITTING:
    """Rounds of the fit, and its uncertainty. Sections are those of docs/algorithms/zero-curves.md."""

    few_matches: int = 100
    """Matches per pair that choose its pose and adjust the cameras until these nearly converge; by hand."""
    all_matches: int = 300_000
    """Matches of all pairs together, but never fewer than that of a pair: those of 300 full pairs; by hand."""
    first_rounds: int = 8
    """Rounds before the fits of several starts are compared; by hand."""
    last_rounds: int = 12
    """Rounds with all matches; by hand."""
    evidence_rounds: int = 3
    """Most rounds of choosing the free parameters by the evidence and adjusting again; by hand."""
    jackknife_groups: int = 8
    """Groups of neighboring photos that are left out in turn. Section 4; by hand."""
    least_photos: int = 6
    """Photos below which a jackknife reflects missing pairs rather than errors. Section 4; by hand."""
    least_remaining_weight: float = 4.0
    """The same limit for the weight of the remaining pairs. Section 4; by hand."""
    model_error: tuple[float, ...] = (1e-3, 1e-3, 1e-3, 1e-3, 3e-3)
    """Standard deviations of errors that no lens model covers: of log f, u and v in longer sides, log a, and k1.
    Section 4; by hand."""
    least_key_weight: float = 0.5
    """Least weight of a key pair in the fit. Section 7; by hand."""
    least_rotation_deg: float = 3.0
    """Median rotation of pairs below which the axes count as parallel; by hand."""
    isosceles: float = 0.1
    """Largest median deviation, in cosines, of pairs whose axes meet at one distance from both cameras; by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Cameras adjusted to their matches."""

    matches: Matches
    state: State
    free: BoolArray
    """(C, 4) parameters that the evidence freed, see `priors`."""
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
        """(P,) factor of each pair's information; matches that share keypoints are not independent."""
        return np.asarray(
            self.matches.trust * self.state.weights / (self.state.scale * self.matches.redundancy), np.float64
        )

    @property
    def evidence(self) -> Evidence:
        """Joint likelihood of all pairs about the cameras."""
        H, g = self.matches.assemble(self.information, self.trust)
        return Evidence(self.state.thetas, H, g, float(np.sum(self.state.weights)), self.priors)

    def cost(self, sigma: float, scale: float) -> float:
        """Return the negative log-probability that ranks fits by a common sigma and scale, each pair's part bounded."""
        state = reweight(self.matches, replace(self.state, sigma=sigma))
        gains = pair_information(self.matches, state).gains / (scale * self.matches.redundancy)
        H = replace(self, state=state).evidence.H + np.diag(self.prior.precision.ravel())
        volume = 0.5 * float(np.linalg.slogdet(lift_eigenvalues(H))[1] - np.sum(np.log(self.prior.precision)))
        bounded = float(np.sum(gains / (1.0 + gains / ADJUSTMENT.quarter_weight_gain)))
        return bounded + self.prior.cost(state.thetas) + volume - self.priors.log_odds(self.free)


def fit_cameras(matches: Matches, Fs: FloatArray, starts: Sequence[FloatArray], priors: CameraPriors) -> Fit:
    """Fit the cameras from all starts (C, 5), likely ones first, then with any pixels; return the best fit."""
    few = matches.subsample(FITTING.few_matches)
    matches = matches.subsample(max(FITTING.few_matches, FITTING.all_matches // max(len(Fs), 1)))
    best = _select_best([_fit_from_start(few, Fs, thetas, priors, square=True) for thetas in starts])
    others = [_fit_from_start(few, Fs, thetas, priors, square=False) for thetas in (best.state.thetas, starts[0])]
    fit = _select_best([best, *others])
    state = adjust_cameras(few, fit.state, fit.prior)
    fit = replace(fit, matches=matches, state=adjust_cameras(matches, state, fit.prior, FITTING.last_rounds))
    for _ in range(FITTING.evidence_rounds):
        free = fit.evidence.choose(fit.free)
        if np.array_equal(free, fit.free):
            break
        prior = priors.prior(free, fit.state.thetas)
        state = adjust_cameras(few, fit.state, prior)
        fit = Fit(matches, adjust_cameras(matches, state, prior, FITTING.last_rounds), free, prior, priors)
    held = fit.evidence.undetermined_parts(fit.free)
    prior = priors.prior(fit.free, fit.state.thetas, held)
    return replace(fit, prior=prior, held=held, state=adjust_cameras(matches, fit.state, prior, FITTING.last_rounds))


def extend_to_all_pairs(fit: Fit, matches: Matches, Fs: FloatArray) -> Fit:
    """Return the fit with a pose for every pair, including pairs that it was not adjusted to."""
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
    photos, zeros = np.unique(fit.matches.photos), np.zeros(fit.state.thetas.size)
    if len(photos) < FITTING.least_photos:
        return zeros
    groups = np.array_split(photos, min(FITTING.jackknife_groups, len(photos)))
    information, trust, steps = fit.information, fit.trust, []
    for group in groups:
        remaining = ~np.isin(fit.matches.photos, group).any(axis=1)
        if np.sum(fit.state.weights[remaining]) < FITTING.least_remaining_weight:
            return zeros
        H, g = fit.matches.assemble(information, np.where(remaining, trust, 0.0))
        precision, offset = fit.prior.precision.ravel(), (fit.prior.mean - fit.state.thetas).ravel()
        steps.append(np.linalg.solve(H + np.diag(precision), g + precision * offset))
    spread = np.array(steps) - np.mean(steps, axis=0)
    return np.asarray(np.sqrt((len(groups) - 1) / len(groups) * np.sum(spread**2, axis=0)), np.float64)


def undistorted_fundamentals(fit: Fit) -> FloatArray:
    """Return (P, 3, 3) F's of the undistorted photos, refitted to the matches without assuming a K."""
    thetas, cameras = fit.state.thetas, fit.matches.cameras
    Fs = np.empty((len(cameras), 3, 3))
    for pair, (first, second) in enumerate(cameras):
        x = fit.matches.pair_matches(pair)
        views = (undistort_points(x[:, :2], thetas[first]), undistort_points(x[:, 2:], thetas[second]))
        inverses = [np.linalg.inv(intrinsic_matrix(thetas[camera])) for camera in (first, second)]
        R, t = fit.state.poses[pair, :9].reshape(3, 3), fit.state.poses[pair, 9:]
        start = inverses[1].T @ np.cross(t, R, axisb=0, axisc=0) @ inverses[0]
        refit = refine_sampson(np.asfortranarray(np.hstack(views)), start, scale=ROBUST_SCALE * fit.state.sigma)
        Fs[pair] = refit if np.isfinite(refit).all() and refit.any() else start
    return Fs


def undistort_pairs(pairs: CameraPairs, camera: Calibration) -> CameraPairs:
    """Undistort the inliers and refit every F; return the pairs unchanged without a lens or without inliers."""
    if camera.radial == 0.0 or not pairs.inliers:
        return pairs
    side, middle = float(max(pairs.size)), np.array(pairs.size) / 2
    scale = 3.0 / side  # of the robust refit: 3 px
    theta = parameters_from_calibration(camera, side)
    to_sides = sides_from_pixels(pairs.size)
    back = np.linalg.inv(to_sides)
    Fs, inliers = np.empty_like(pairs.Fs), []
    for k, matches in enumerate(pairs.inliers):
        views = [undistort_points((np.asarray(matches)[:, i : i + 2] - middle) / side, theta) for i in (0, 2)]
        points = np.asfortranarray(np.hstack(views))
        Fs[k] = to_sides.T @ refine_sampson(points, back.T @ pairs.Fs[k] @ back, scale=scale) @ to_sides
        inliers.append(points * side + np.tile(middle, 2))
    return replace(pairs, Fs=Fs, inliers=tuple(inliers))


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
    state = adjust_cameras(few, replace(state, sigma=few.noise(state)), prior, FITTING.first_rounds)
    return Fit(few, state, free, prior, priors)


def _estimate_poses(few: Matches, Fs: FloatArray, thetas: FloatArray) -> FloatArray:
    poses = np.empty((len(Fs), 12))
    for pair, (first, second) in enumerate(few.cameras):
        K1, K2 = intrinsic_matrix(thetas[first]), intrinsic_matrix(thetas[second])
        x = subsample_rows(few.pair_matches(pair), FITTING.few_matches)
        rays = [
            (undistort_points(points, thetas[camera]) - K[:2, 2]) / K[[0, 1], [0, 1]]
            for points, camera, K in ((x[:, :2], first, K1), (x[:, 2:], second, K2))
        ]
        R, t = relative_pose(essential_from_fundamental(Fs[pair], K1, K2), *rays)
        poses[pair] = np.concatenate([R.ravel(), t / np.linalg.norm(t)])
    return poses


PARAMETER_NAMES = ("fx", "fy", "cx", "cy", "k1")


def covariance(fit: Fit, sides: FloatArray, *, resampled: bool = False) -> FloatArray:
    """Return the (5C, 5C) covariance over all choices, plus the model error; `resampled` widens it by the jackknife."""
    total = fit.evidence.covariance(fit.free)
    if resampled:
        deviations = np.sqrt(np.diag(total))
        wider = np.maximum(jackknife_deviations(fit) / deviations, 1.0)
        total = total * np.outer(wider, wider)
    floor = np.tile(FITTING.model_error, (len(sides), 1))
    floor[:, CENTER_U : CENTER_V + 1] *= sides[:, None]
    floor[:, KAPPA] /= np.exp(2.0 * fit.state.thetas[:, LOG_FOCAL])
    return np.asarray(total + np.diag(floor.ravel() ** 2), np.float64)


def camera_uncertainty(theta: FloatArray, cov: FloatArray, unit_px: float) -> dict[str, Any]:
    """Return `spread` and `correlations` of a `Calibration`: those of fx, fy, cx, cy in pixels and of k1."""
    focal, squared = float(np.exp(theta[LOG_FOCAL])) * unit_px, float(np.exp(2.0 * theta[LOG_FOCAL]))
    half = float(np.exp(0.5 * theta[LOG_ASPECT]))
    # rows: how fx, fy, cx, cy, k1 change with log f, u, v, log a, kappa
    slopes = np.zeros((CAMERA, CAMERA))
    slopes[0, [LOG_FOCAL, LOG_ASPECT]] = focal / half, -0.5 * focal / half
    slopes[1, [LOG_FOCAL, LOG_ASPECT]] = focal * half, 0.5 * focal * half
    slopes[2, CENTER_U] = slopes[3, CENTER_V] = unit_px
    slopes[4, [LOG_FOCAL, KAPPA]] = 2.0 * theta[KAPPA] * squared, squared
    in_px = slopes @ cov @ slopes.T
    deviations = np.sqrt(np.maximum(np.diag(in_px), 0.0))
    spread = dict(zip(PARAMETER_NAMES, deviations.tolist(), strict=True))
    return {"spread": spread, "correlations": named_correlations(PARAMETER_NAMES, in_px)}


def key_pairs(fit: Fit, photos: tuple[PairId, ...]) -> tuple[PairId, ...]:
    """Return those of the `photos` pairs that agree with the cameras, the most informative first."""
    if not photos:
        return ()
    own = np.tile(ADJUSTMENT.own_camera_sigmas, 2)
    gains = np.linalg.slogdet(lift_eigenvalues(np.eye(2 * CAMERA) + own[:, None] * fit.information.hessians * own))[1]
    scores = fit.state.weights * gains
    order = [pair for pair in np.argsort(-scores, kind="stable") if fit.state.weights[pair] >= FITTING.least_key_weight]
    return tuple(photos[pair] for pair in order)


def critical_motion(fit: Fit) -> str:
    """Return the motion of most pairs if it leaves the focal open: parallel axes or an orbit (Sturm 1999)."""
    R = fit.state.poses[:, :9].reshape(-1, 3, 3)
    if len(R) == 0:
        return ""
    rotation_deg = np.degrees(np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)))
    if np.median(rotation_deg) < FITTING.least_rotation_deg:
        return "the camera hardly turns between the photos (parallel axes)"
    baseline = -np.einsum("pij,pi->pj", R, fit.state.poses[:, 9:])
    second = R[:, 2]
    # in the frame of view 1, whose axis is z: both axes lean alike towards the baseline, and all three lie in a plane
    lean = np.abs(baseline[:, 2] + np.einsum("pi,pi->p", second, baseline))
    out_of_plane = np.abs(np.cross(second, baseline)[:, 2])
    if np.median(np.maximum(lean, out_of_plane)) < FITTING.isosceles:
        return "the cameras face one point from one distance (an orbit)"
    return ""
