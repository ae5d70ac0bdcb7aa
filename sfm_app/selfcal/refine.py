"""From first ideas of the cameras to what their matches say: adjust, ask what the evidence frees, adjust again."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.essential import essential_from_fundamental, relative_pose
from sfm_app.ransac.refit import refine_sampson
from sfm_app.selfcal.adjustment import (
    Information,
    Matches,
    Prior,
    State,
    adjusted,
    evenly,
    informed,
    objective,
    settled,
)
from sfm_app.selfcal.lens import CENTRE_U, CENTRE_V, LOG_ASPECT, LOG_FOCAL, straightened
from sfm_app.selfcal.priors import ASPECT, Usual, chosen

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

POSE_MATCHES = 100
"""Enough to tell which of the four poses of an E is the right one."""
CHOICES = 3
"""Times the evidence is asked again after an adjustment."""
NOT_SQUARE = 0.02
"""A first idea with a larger |log fy/fx| keeps its aspect free from the start."""
REFIT_REACH = 3.0
"""Scale of the robust refit of an F, in sigma."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Cameras adjusted to their matches."""

    matches: Matches
    state: State
    free: BoolArray
    """(C, 4) which parameters the evidence freed, see `priors`."""
    prior: Prior
    gain: float
    """Nats by which that choice beats leaving all as usual."""

    @property
    def information(self) -> Information:
        """What each pair says at the end."""
        return informed(self.matches, self.state)

    def system(self) -> tuple[FloatArray, FloatArray]:
        """(5C, 5C) Hessian and (5C,) negative gradient of what all pairs say, without the prior."""
        return self.matches.scattered(self.information, self.state.weights / self.state.scale)


def refined(matches: Matches, Fs: FloatArray, starts: Sequence[FloatArray], usual: Usual) -> Fit:
    """The best of the fits that begin at `starts`.

    Args:
        matches: inliers about the middle of the photos.
        Fs: (P, 3, 3) in the same frame and units; begin the poses.
        starts: (C, 5) each, first ideas of the cameras.
        usual: what is known before.
    """
    few = matches.thinned(POSE_MATCHES)
    begun = [_begun(few, Fs, thetas, usual) for thetas in starts]
    if len(begun) > 1:
        # compared with one sigma, or a wrong start would be lenient with itself
        sigma = min(state.sigma for state, _, _ in begun)
        costs = [objective(few, replace(state, sigma=sigma), prior) for state, prior, _ in begun]
        state, prior, free = begun[int(np.argmin(costs))]
    else:
        state, prior, free = begun[0]
    state = adjusted(matches, state, prior)
    gain = 0.0
    for _ in range(CHOICES):
        H, b = matches.scattered(informed(matches, state), state.weights / state.scale)
        again, gain = chosen(H, b, state.thetas, usual, free, float(np.sum(state.weights)))
        if np.array_equal(again, free):
            break
        free, prior = again, usual.prior(again, state.thetas)
        state = adjusted(matches, state, prior)
    return Fit(matches, state, free, prior, gain)


def straight_fundamentals(fit: Fit) -> FloatArray:
    """(P, 3, 3) F's of the photos as they were without a lens: refitted to the matches, free of any K."""
    thetas, cameras = fit.state.thetas, fit.matches.cameras
    found = np.empty((len(cameras), 3, 3))
    for pair, (first, second) in enumerate(cameras):
        x = fit.matches.of_pair(pair)
        views = (_straight(x[:, :2], thetas[first]), _straight(x[:, 2:], thetas[second]))
        inverses = [np.linalg.inv(camera_matrix_of(thetas[camera])) for camera in (first, second)]
        E = _essential(fit.state.poses[pair])
        start = inverses[1].T @ E @ inverses[0]
        found[pair] = refine_sampson(np.asfortranarray(np.hstack(views)), start, scale=REFIT_REACH * fit.state.sigma)
    return found


def camera_matrix_of(theta: FloatArray) -> FloatArray:
    """(3, 3) camera matrix of the parameters (5,), in their units about the middle."""
    f, half = np.exp(theta[LOG_FOCAL]), np.exp(0.5 * theta[LOG_ASPECT])
    return np.array([[f / half, 0.0, theta[CENTRE_U]], [0.0, f * half, theta[CENTRE_V]], [0.0, 0.0, 1.0]])


def _begun(few: Matches, Fs: FloatArray, thetas: FloatArray, usual: Usual) -> tuple[State, Prior, BoolArray]:
    free = np.ones((len(thetas), 4), np.bool_)
    free[:, ASPECT] = np.abs(thetas[:, LOG_ASPECT]) > NOT_SQUARE
    prior = usual.prior(free, thetas)
    state = State(thetas, _poses(few, Fs, thetas), np.ones(len(Fs)), few.least_sigma)
    return settled(few, replace(state, sigma=few.noise(state)), prior), prior, free


def _poses(few: Matches, Fs: FloatArray, thetas: FloatArray) -> FloatArray:
    poses = np.empty((len(Fs), 12))
    for pair, (first, second) in enumerate(few.cameras):
        K1, K2 = camera_matrix_of(thetas[first]), camera_matrix_of(thetas[second])
        x = evenly(few.of_pair(pair), POSE_MATCHES)
        rays = [
            (_straight(points, thetas[camera]) - K[:2, 2]) / K[[0, 1], [0, 1]]
            for points, camera, K in ((x[:, :2], first, K1), (x[:, 2:], second, K2))
        ]
        R, t, _, _ = relative_pose(essential_from_fundamental(Fs[pair], K1, K2), *rays)
        poses[pair] = np.concatenate([R.ravel(), t / np.linalg.norm(t)])
    return poses


def _essential(pose: FloatArray) -> FloatArray:
    R, t = pose[:9].reshape(3, 3), pose[9:]
    return np.asarray(np.cross(t, R, axisb=0, axisc=0), np.float64)


def _straight(points: FloatArray, theta: FloatArray) -> FloatArray:
    return np.asarray(straightened(np.ascontiguousarray(points), theta), np.float64)
