"""The readout of a rolling shutter, by bundle adjustment of poses, points, cameras and one number for all photos.

Ours. Bundle adjustment without a shutter hides part of it in poses, points and lens, so that residuals alone do not
determine it. Here every photo moves while it is read: along the path through its neighbors, and by an offset of its
own, because a hand shakes between two photos. The usual size of offsets is estimated from the photos (MacKay 1992).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from sfm_app.bundle.lens_evidence import MISFIT
from sfm_app.bundle.lens_parts import LOG_ASPECT, LOG_FOCAL, LensPriors, step_cameras
from sfm_app.bundle.normal_equations import (
    BLOCK,
    POSE,
    REDUCTION,
    Bundle,
    Linearized,
    apply_step,
    free_pose_columns,
    linearize,
    loss,
    loss_scale,
    usable_mask,
)
from sfm_app.camera.projection import project_points
from sfm_app.camera.rows import CAMERA, FX, FY
from sfm_app.geometry.least_squares import inverse_of_positive
from sfm_app.numerical import MAD_TO_SIGMA
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

# Projection of points into photos whose rows are read one after the other. Ours; to first order in the motion of
# the camera, the model is that of Hedborg et al. 2012.
# While a photo is read, its camera keeps its velocity. A row is given by its share: from -1/2, the first row, to 1/2,
# the last row. The pose of a photo is that of its middle row.


class RowProjection(NamedTuple):
    """Projections through a rolling shutter, and their derivatives."""

    x: FloatArray
    """(N, 2) pixels."""
    depth: FloatArray
    """(N,) of the points before the camera, at the moment of their row."""
    by_camera: FloatArray
    by_pose: FloatArray
    by_motion: FloatArray
    by_point: FloatArray
    """(N, 2, k) derivatives by camera (12), pose (6) as of `normal_equations.project`, motion (6) and point (3)."""


def project_rows(bundle: Bundle, share: FloatArray, motion: FloatArray) -> RowProjection:
    """Project the points of all observations, each from the pose at the time of its row (N,).

    `motion` (I, 6) is the velocity of each photo, as in `PathVelocities`, times the readout; poses are of middle rows.
    """
    from scipy.spatial.transform import Rotation

    rows, R = bundle.camera[bundle.photo], bundle.R[bundle.photo]
    points = np.einsum("nij,nj->ni", R, bundle.X[bundle.point])
    middle, moves = points + bundle.t[bundle.photo], share[:, None] * motion[bundle.photo]
    rotation = Rotation.from_rotvec(moves[:, :3]).as_matrix()
    local = np.einsum("nij,nj->ni", rotation, middle + moves[:, 3:])
    projected = project_points(local, bundle.params[rows], bundle.family[rows])
    by_middle = np.einsum("nij,njk->nik", projected.by_point, rotation)
    by_motion = np.concatenate([np.cross(local[:, None], projected.by_point), by_middle], 2) * share[:, None, None]
    by_pose = np.concatenate([np.cross(points[:, None], by_middle), by_middle], 2)
    by_point = np.einsum("nij,njk->nik", by_middle, R)
    return RowProjection(projected.x, local[:, 2], projected.by_camera, by_pose, by_motion, by_point)


def move_to_middle_row(points: FloatArray, share: FloatArray, motion: FloatArray) -> FloatArray:
    """Return points (N, 3) of a camera's frame at the times of their rows (N,) as they are at its middle row."""
    from scipy.spatial.transform import Rotation

    moved = share[:, None] * motion
    return np.asarray(Rotation.from_rotvec(moved[:, :3]).inv().apply(points) - moved[:, 3:], np.float64)


# How a camera moves at the moment of each photo, from the poses of the photos before and after it. Ours.
# Polynomials are fitted to the poses of some consecutive photos, and differentiated (Savitzky and Golay 1964, with
# uneven steps). Cross-validation chooses the degree and the number of photos: where photos follow each other faster
# than a hand shakes, the path goes through all poses, else through their middle.

FITS = ((5, 3), (3, 1), (7, 3), (9, 3), (5, 1), (7, 1), (9, 1))
"""Photos in a window and degree of the polynomial; even degrees give the slopes of odd ones. Chosen by hand."""
VELOCITY = 6
"""Numbers of a velocity: a rotation vector, and the motion of a point at rest. By definition."""


@dataclass(frozen=True, slots=True, eq=False)
class PathVelocities:
    """Velocities at the moments of some photos, per unit of time, from each of FITS."""

    values: FloatArray
    """(F, I, 6) rotation vector of the camera in its own axes, applied to R from the left; then the velocity of
    a point at rest in these axes, due to the motion of the camera's center."""
    errors: FloatArray
    """(F, I, 6) errors of left-out poses, in radians and units of length."""

    def select_most_predictive(self) -> IndexArray:
        """Return the fits (2,) of rotations and of translations that predict left-out poses best."""
        length = np.linalg.norm(self.errors.reshape(*self.errors.shape[:2], 2, 3), axis=3)
        return np.asarray(np.argmin(np.median(length, axis=1), axis=0), np.int64)

    def select(self, fits: IndexArray) -> FloatArray:
        """Return velocities (I, 6), rotations and translations each from their fit (2,)."""
        return np.concatenate([self.values[fits[0], :, :3], self.values[fits[1], :, 3:]], axis=1)

    def deviations(self) -> FloatArray:
        """Return (I, 6) rough standard deviations of the velocities: the difference of the two shortest fits."""
        off = (self.values[0] - self.values[1]).reshape(-1, 2, 3)
        usual = MAD_TO_SIGMA * np.median(np.abs(off), axis=(0, 2))
        return np.asarray(np.repeat(np.maximum(np.sqrt(np.mean(off**2, axis=2)), usual), 3, axis=1), np.float64)


def path_velocities(R: FloatArray, t: FloatArray, times: FloatArray) -> PathVelocities:
    """Return velocities of photos, nine or more, at distinct times; poses are camera from world."""
    order = np.argsort(times)
    back = np.argsort(order)
    fits = [_fit_windows(R[order], t[order], times[order], *fit) for fit in FITS]
    values, errors = (np.array(part)[:, back] for part in zip(*fits, strict=True))
    return PathVelocities(values, errors)


def _fit_windows(
    R: FloatArray, t: FloatArray, times: FloatArray, count: int, degree: int
) -> tuple[FloatArray, FloatArray]:
    """Return velocities (I, 6) of photos sorted by time, and the errors (I, 6) of left-out poses."""
    from scipy.spatial.transform import Rotation

    places = np.arange(len(times))
    first = np.clip(places - count // 2, 0, len(times) - count)
    window = first[:, None] + np.arange(count)
    relative = np.einsum("iwjk,ilk->iwjl", R[window], R)
    rotations = Rotation.from_matrix(relative.reshape(-1, 3, 3)).as_rotvec().reshape(-1, count, 3)
    centers = -np.einsum("nji,nj->ni", R, t)
    translations = -np.einsum("ijk,iwk->iwj", R, centers[window] - centers[:, None])
    value, slope = local_fit_weights(times[window] - times[:, None], degree)
    poses = np.concatenate([rotations, translations], axis=2)  # 0 at the photo itself
    own = value[places, places - first]
    error = np.einsum("iw,iwj->ij", value, poses) / np.maximum(1.0 - own, np.finfo(float).eps)[:, None]
    return np.einsum("iw,iwj->ij", slope, poses), error


def local_fit_weights(offsets: FloatArray, degree: int) -> tuple[FloatArray, FloatArray]:
    """Return weights (I, k) of the value and the derivative at 0 of a polynomial fit to k distinct times."""
    unit = np.abs(offsets).max(axis=1)
    powers = (offsets / unit[:, None])[:, :, None] ** np.arange(degree + 1)
    solution = np.linalg.pinv(powers)
    return np.asarray(solution[:, 0]), np.asarray(solution[:, 1] / unit[:, None])


# Normal equations of a bundle behind a rolling shutter: poses, offsets, cameras and the readout, points eliminated.


@dataclass(frozen=True, slots=True, eq=False)
class ShutterBundle:
    """A bundle whose photos a rolling shutter took."""

    bundle: Bundle
    """Its poses are those of the middle rows."""
    share: FloatArray
    """(N,) row of each observation, from -1/2 to 1/2 in the order of reading."""
    readout: float
    """Time from the first row to the last."""
    velocity: FloatArray
    """(I, 6) of the path, as in `PathVelocities`."""
    offsets: FloatArray
    """(I, 6) motion during the readout beyond that of the path."""

    @property
    def motion(self) -> FloatArray:
        """(I, 6) of each photo during the readout."""
        return self.readout * self.velocity + self.offsets

    @property
    def unknowns(self) -> int:
        """Number of unknowns besides the points: poses, offsets, cameras with log focal and log aspect, readout.

        The readout is the first of a block (`BLOCK`); the rest of the block is unused.
        """
        return (POSE + VELOCITY) * len(self.bundle.R) + CAMERA * len(self.bundle.params) + BLOCK


@dataclass(frozen=True, slots=True, eq=False)
class ShutterStep:
    """Solution of the normal equations."""

    views: FloatArray
    """(n,) change of the unknowns besides the points."""
    points: FloatArray
    """(P, 3)"""
    noise_px: float
    deviation: float
    """Standard deviation of the readout."""
    offset_variances: FloatArray
    """(I, 6) of the offsets, without MISFIT."""


def shutter_step(
    model: ShutterBundle, precision: FloatArray, pull: FloatArray, scale_px: float, *, held: bool
) -> ShutterStep:
    """Return a step of Gauss and Newton; the deviation is at least that of the sandwich estimator, photos as clusters.

    `precision` (n,) is of the priors on the unknowns, in 1 / px^2; `pull` (n,) is precisions times distances to their
    means; `held` tells whether the readout is known.
    """
    bundle, photos = model.bundle, len(model.bundle.R)
    with np.errstate(all="ignore"):
        projected = project_rows(bundle, model.share, model.motion)
        r = bundle.x - projected.x
        by_camera, params = projected.by_camera.copy(), bundle.params[bundle.camera[bundle.photo]]
        by_fx, by_fy = by_camera[:, :, FX] * params[:, FX, None], by_camera[:, :, FY] * params[:, FY, None]
        by_camera[:, :, LOG_FOCAL], by_camera[:, :, LOG_ASPECT] = by_fx + by_fy, 0.5 * (by_fy - by_fx)
        by_readout = np.zeros((len(r), 2, BLOCK))
        by_readout[:, :, 0] = np.einsum("nij,nj->ni", projected.by_motion, model.velocity[bundle.photo])
        by_view = np.concatenate([projected.by_pose, projected.by_motion, by_camera, by_readout], 2)
    first, last = 2 * photos + CAMERA // BLOCK * bundle.camera[bundle.photo], model.unknowns // BLOCK - 1
    blocks = np.column_stack([bundle.photo, photos + bundle.photo, first, first + 1, np.full(len(r), last)])
    derivatives = r, by_view, projected.by_point
    observed = linearize(bundle, derivatives, blocks, model.unknowns, scale_px, projected.depth)
    return _solve(model, observed, precision, pull, held=held)


def _solve(
    model: ShutterBundle, observed: Linearized, precision: FloatArray, pull: FloatArray, *, held: bool
) -> ShutterStep:
    bundle, n, photos = model.bundle, model.unknowns, len(model.bundle.R)
    poses, offsets = free_pose_columns(bundle.R, bundle.t), slice(POSE * photos, (POSE + VELOCITY) * photos)
    free = np.concatenate([poses, np.arange(offsets.start, n - BLOCK + (not held))])
    S = observed.eliminate_points().toarray() + np.diag(precision + REDUCTION.damping)
    g = observed.by_view.T @ observed.drop_points(observed.r) + pull
    inverse = inverse_of_positive(S[np.ix_(free, free)])
    views, influence, variances = np.zeros(n), np.zeros(n), np.zeros(n)
    views[free] = np.einsum("ij,j->i", inverse, g[free])
    variances[free] = np.diag(inverse)
    if not held:
        influence[free] = inverse[:, -1]
    rest = observed.r - observed.by_view @ views
    residue, influences = observed.drop_points(rest), observed.drop_points(observed.by_view @ influence)
    redundancy = max(2 * observed.used - int(np.sum(observed.rank)) - len(poses), 0) + REDUCTION.usual_count
    squares = observed.tails * np.sum(residue**2) + REDUCTION.usual_count * REDUCTION.usual_noise_px**2
    noise2 = float(squares / redundancy)
    by_photo = np.bincount(bundle.photo, np.sum((influences * residue).reshape(-1, 2), axis=1))
    deviation = MISFIT * np.sqrt(max(noise2 * variances[n - BLOCK], float(np.sum(by_photo**2))))
    return ShutterStep(
        views,
        observed.unwhiten(observed.by_point.T @ rest),
        float(np.sqrt(noise2)),
        float(deviation),
        noise2 * variances[offsets].reshape(-1, VELOCITY),
    )


def apply_shutter_step(model: ShutterBundle, step: ShutterStep, share: float) -> ShutterBundle:
    """Return the model after a share, in (0, 1], of a step."""
    bundle = model.bundle
    poses, offsets, cameras = np.split(share * step.views[:-BLOCK], np.cumsum([POSE, VELOCITY]) * len(bundle.R))
    params = step_cameras(bundle.params, cameras.reshape(-1, CAMERA))
    return replace(
        model,
        bundle=apply_step(bundle, params, poses.reshape(-1, POSE), share * step.points),
        readout=model.readout + share * float(step.views[-BLOCK]),
        offsets=model.offsets + offsets.reshape(-1, VELOCITY),
    )


def shutter_cost(model: ShutterBundle, scale_px: float) -> float:
    """Return half the sum of the loss of `normal_equations.reduce`, in squared pixels."""
    return loss(*_residuals(model), scale_px)


def _residuals(model: ShutterBundle) -> tuple[FloatArray, BoolArray]:
    """Return observed less predicted positions (N, 2) in pixels, and the mask (N,) of the usable ones."""
    with np.errstate(all="ignore"):
        projected = project_rows(model.bundle, model.share, model.motion)
        r = model.bundle.x - projected.x
    return r, usable_mask(model.bundle, r, projected.depth)


class OPTIONS:
    """Limits of the adjustment of the readout."""

    steps: int = 12
    """Most Gauss-Newton steps; three to six are usual (`python -m benchmarks.videos.shutter`)."""
    converged: float = 1e-4
    """Relative decrease of the cost below which the steps end (`python -m benchmarks.videos.shutter`)."""
    halvings: int = 3
    """Most halvings of a step that raises the cost. Chosen by hand."""
    least_readout: float = 1e-5
    """Least readout for the size of offsets, which is not 0, as a share of the time between photos. Chosen by hand."""
    shake: tuple[float, float] = (0.2, 5.0)
    """Range of the size of offsets, in deviations of the path's velocities times readout. Above it, offsets of all
    photos together bend the scene, and no readout is found (`python -m benchmarks.videos.shutter`)."""
    least_measured: float = 3.0
    """Number of offsets that the photos must determine before their size changes. Chosen by hand."""
    shake_converged: float = 1.1
    """Factor by which the size of offsets may still change when the steps end. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Times of the observations of a bundle."""

    times: FloatArray
    """(I,) distinct times of the middle rows of photos."""
    share: FloatArray
    """(N,) row of each observation, from -1/2 to 1/2 in the order of reading."""


@dataclass(frozen=True, slots=True, eq=False)
class ReadoutEstimate:
    """The readout, and the model that goes with it."""

    readout: float
    """Time from the first row to the last, in the unit of the photos' times; negative if the last row is read first."""
    deviation: float
    """Its standard deviation; 0 where it was known."""
    bundle: Bundle
    """Poses are those of the middle rows."""
    motion: FloatArray
    """(I, 6) of each photo during the readout: velocity as in `PathVelocities`, times readout."""
    shake: FloatArray
    """(2,) size of the offsets of turns and moves, in deviations of the path's velocities times readout."""


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Constants of the adjustment."""

    rows: Rows
    fits: IndexArray
    """(2,) of turns and moves, see `PathVelocities`."""
    priors: LensPriors
    precision: FloatArray
    """(C, 12) of the priors on the cameras."""
    held: bool
    """Whether the readout is known."""


def estimate_readout(
    bundle: Bundle, rows: Rows, priors: LensPriors, freed: BoolArray,
    start: ReadoutEstimate | None = None, *, known: float | None = None,
) -> ReadoutEstimate:  # fmt: skip
    """Adjust poses, points, cameras and the readout together; with a known readout, only poses and points.

    The bundle of nine or more photos is adjusted for a global shutter. `freed` (C, 8) are the parts of the cameras with
    the wide prior; `start` is an earlier estimate for the same photos.
    """
    fits = path_velocities(bundle.R, bundle.t, rows.times).select_most_predictive()
    problem = _Problem(rows, fits, priors, priors.precision(freed), known is not None)
    readout, shake = (start.readout, start.shake) if start else (0.0, np.ones(2))
    still = np.zeros((len(bundle.R), VELOCITY))
    model = ShutterBundle(bundle, rows.share, readout if known is None else known, still, still)
    model = _follow_path(model, problem)
    noise_px = REDUCTION.usual_noise_px
    for _ in range(OPTIONS.steps):
        expected, scale_px = _expected_offsets(model, problem, shake), loss_scale(*_residuals(model))
        terms = _prior_terms(model, expected, problem, noise_px)
        step = shutter_step(model, *terms, scale_px, held=problem.held)
        noise_px = step.noise_px
        costs = partial(_cost, expected=expected, problem=problem, noise_px=noise_px, scale_px=scale_px)
        before = costs(model)
        model, after = _take_step(model, step, problem, costs)
        last, shake = shake, _update_shake(model.offsets / expected, step.offset_variances / expected**2, shake)
        if after >= (1.0 - OPTIONS.converged) * before and np.abs(np.log(shake / last)).max() < np.log(
            OPTIONS.shake_converged
        ):
            break
    return ReadoutEstimate(model.readout, step.deviation, model.bundle, model.motion, shake)


def _follow_path(model: ShutterBundle, problem: _Problem) -> ShutterBundle:
    path = path_velocities(model.bundle.R, model.bundle.t, problem.rows.times)
    return replace(model, velocity=path.select(problem.fits))


def _expected_offsets(model: ShutterBundle, problem: _Problem, shake: FloatArray) -> FloatArray:
    """Return standard deviations (I, 6) of the offsets; changing ones would enlarge the readout."""
    times = problem.rows.times
    path = path_velocities(model.bundle.R, model.bundle.t, times)
    readout = max(abs(model.readout), OPTIONS.least_readout * float(np.median(np.diff(np.sort(times)))))
    return np.asarray(readout * path.deviations() * np.repeat(shake, 3), np.float64)


def _update_shake(offsets: FloatArray, variances: FloatArray, shake: FloatArray) -> FloatArray:
    """Return the size of offsets (2,) from those that the photos determine; (I, 6) are in expected deviations."""
    measured = np.sum(1.0 - np.minimum(variances, 1.0).reshape(-1, 2, 3), axis=(0, 2))
    squares = np.sum(offsets.reshape(-1, 2, 3) ** 2, axis=(0, 2))
    factor = np.sqrt(squares / np.maximum(measured, OPTIONS.least_measured))
    return np.clip(np.where(measured < OPTIONS.least_measured, 1.0, factor) * shake, *OPTIONS.shake)


def _prior_terms(
    model: ShutterBundle, expected: FloatArray, problem: _Problem, noise_px: float
) -> tuple[FloatArray, FloatArray]:
    """Return precisions (n,) of the priors, in 1 / px^2, and precisions times distances to the prior means."""
    poses, offsets = np.zeros(POSE * len(model.bundle.R)), problem.priors.prior_offsets(model.bundle.params)
    precision = np.concatenate([poses, expected.ravel() ** -2.0, problem.precision.ravel(), np.zeros(BLOCK)])
    distance = np.concatenate([poses, -model.offsets.ravel(), offsets.ravel(), np.zeros(BLOCK)])
    return noise_px**2 * precision, noise_px**2 * precision * distance


def _take_step(
    model: ShutterBundle, step: ShutterStep, problem: _Problem, costs: Callable[[ShutterBundle], float]
) -> tuple[ShutterBundle, float]:
    """Return the model after the step, or after the part of it that lowers the cost, and its cost."""
    before = costs(model)
    for k in range(OPTIONS.halvings + 1):
        candidate = _follow_path(apply_shutter_step(model, step, 0.5**k), problem)
        after = costs(candidate)
        if after < before:
            return candidate, after
    return model, before


def _cost(model: ShutterBundle, expected: FloatArray, problem: _Problem, noise_px: float, scale_px: float) -> float:
    """Return half the sum of the loss and of the squares of the priors, in squared pixels."""
    offsets = problem.priors.prior_offsets(model.bundle.params)
    squares = np.sum((model.offsets / expected) ** 2) + np.sum(problem.precision * offsets**2)
    return shutter_cost(model, scale_px) + 0.5 * noise_px**2 * float(squares)
