"""Normal equations of a bundle behind a rolling shutter: poses, motions, cameras and the readout, points eliminated.

Unlike in `normal_equations`, a dense matrix is filled point by point: with the motions there are twice as many unknowns
to a photo, for which sparse products take ten times as long.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.bundle_adjustment.elimination import POSE, free_pose_columns, whiten_points
from sfm_app.bundle_adjustment.lens_evidence import MISFIT
from sfm_app.bundle_adjustment.lens_parts import LOG_ASPECT, LOG_FOCAL, step_cameras
from sfm_app.bundle_adjustment.normal_equations import (
    DAMPING,
    USUAL_COUNT,
    USUAL_NOISE_PX,
    Bundle,
    apply_step,
    loss,
    usable_mask,
    weigh,
)
from sfm_app.bundle_adjustment.path_velocity import VELOCITY
from sfm_app.bundle_adjustment.rolling_shutter import project_rows
from sfm_app.geometry.lenses.projections import CAMERA, FX, FY
from sfm_app.geometry.spd_solve import inverse_of_positive
from sfm_app.jit import kernel

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


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

    @classmethod
    def motionless(cls, bundle: Bundle, share: FloatArray, readout: float) -> "ShutterBundle":
        """Return a bundle whose photos do not move.

        Args:
            bundle, share, readout: as in the class.
        """
        nothing = np.zeros((len(bundle.R), VELOCITY))
        return cls(bundle, share, readout, nothing, nothing)

    @property
    def motion(self) -> FloatArray:
        """(I, 6) of each photo during the readout."""
        return self.readout * self.velocity + self.offsets

    @property
    def unknowns(self) -> int:
        """Number of unknowns besides the points: poses, offsets, cameras with log focal and log aspect, readout."""
        return (POSE + VELOCITY) * len(self.bundle.R) + CAMERA * len(self.bundle.params) + 1


@dataclass(frozen=True, slots=True, eq=False)
class ShutterSystem:
    """Normal equations S x = g of the unknowns besides the points."""

    S: FloatArray
    g: FloatArray
    r: FloatArray
    """(N, 2) weighted residuals."""
    by_view: FloatArray
    """(N, 2, 25) weighted derivatives by pose, offset, camera and readout."""
    columns: IntArray
    """(N, 25) their unknowns."""
    by_point: FloatArray
    """(N, 2, 3) weighted derivatives by whitened points."""
    whiten: FloatArray
    """(P, 3, 3)"""
    photo: IntArray
    point: IntArray
    free: IntArray
    """Unknowns that change."""
    offsets: slice
    """Which unknowns are offsets."""
    spare: int
    """How many more measurements than poses and points there are."""


@dataclass(frozen=True, slots=True, eq=False)
class ShutterStep:
    """Solution of the normal equations."""

    views: FloatArray
    """(n,) change of the unknowns besides the points."""
    points: FloatArray
    """(P, 3)"""
    noise_px: float
    """Standard deviation of a coordinate."""
    deviation: float
    """Standard deviation of the readout."""
    offset_variances: FloatArray
    """(I, 6) of the offsets, without MISFIT."""


def linearize(
    model: ShutterBundle, precision: FloatArray, pull: FloatArray, scale_px: float, *, held: bool
) -> ShutterSystem:
    """Eliminate the points (Schur complement), in the Gauss-Newton approximation.

    Args:
        model: the bundle.
        precision: (n,) of the priors on the unknowns, in 1 / px^2 like the squared derivatives.
        pull: (n,) precisions times distances to the values that the priors expect.
        scale_px: as of `normal_equations.reduce`.
        held: whether the readout is known.
    """
    bundle, n = model.bundle, model.unknowns
    r, by_view, by_point = _weighted_derivatives(model, scale_px)
    whiten, rank = whiten_points(by_point, bundle.point, len(bundle.X))
    by_point = np.einsum("nki,nji->nkj", by_point, whiten[bundle.point])
    columns = _unknown_columns(model)
    half, g = np.zeros((n, n)), np.zeros(n)
    order = np.argsort(bundle.point, kind="stable")
    starts = np.searchsorted(bundle.point[order], np.arange(len(bundle.X) + 1))
    add_points((order, starts), columns, r, by_view, by_point, half, g)
    S = half + half.T - np.diag(np.diag(half)) + np.diag(precision + DAMPING)
    poses = free_pose_columns(bundle.R, bundle.t)
    free = np.concatenate([poses, np.arange(POSE * len(bundle.R), n - held)])
    spare = 2 * int(np.count_nonzero(r.any(axis=1))) - int(np.sum(rank)) - len(poses)
    offsets = slice(POSE * len(bundle.R), (POSE + VELOCITY) * len(bundle.R))
    return ShutterSystem(
        S, g + pull, r, by_view, columns, by_point, whiten, bundle.photo, bundle.point, free, offsets, spare
    )  # fmt: skip


def _unknown_columns(model: ShutterBundle) -> IntArray:
    """Return (N, 25) the unknowns that each observation depends on."""
    bundle, photos = model.bundle, len(model.bundle.R)
    camera = (POSE + VELOCITY) * photos + CAMERA * bundle.camera[bundle.photo]
    blocks = [
        POSE * bundle.photo[:, None] + np.arange(POSE),
        POSE * photos + VELOCITY * bundle.photo[:, None] + np.arange(VELOCITY),
        camera[:, None] + np.arange(CAMERA),
        np.full((len(bundle.x), 1), model.unknowns - 1),
    ]
    return np.hstack(blocks)


def _weighted_derivatives(model: ShutterBundle, scale_px: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return weighted residuals (N, 2), and derivatives by views (N, 2, 25) and points (N, 2, 3).

    Observations that are lost count nothing.
    """
    bundle = model.bundle
    with np.errstate(all="ignore"):
        seen = project_rows(bundle, model.share, model.motion)
        r = bundle.x - seen.x
        by_camera, params = seen.by_camera.copy(), bundle.params[bundle.camera[bundle.photo]]
        by_fx, by_fy = by_camera[:, :, FX] * params[:, FX, None], by_camera[:, :, FY] * params[:, FY, None]
        by_camera[:, :, LOG_FOCAL], by_camera[:, :, LOG_ASPECT] = by_fx + by_fy, 0.5 * (by_fy - by_fx)
        by_readout = np.einsum("nij,nj->ni", seen.by_motion, model.velocity[bundle.photo])[:, :, None]
        by_view = np.concatenate([seen.by_pose, seen.by_motion, by_camera, by_readout], 2)
    return weigh(r, by_view, seen.by_point, usable_mask(bundle, r, seen.depth), scale_px)[:3]


@kernel
def add_points(
    rows: tuple[IntArray, IntArray], columns: IntArray, r: FloatArray, by_view: FloatArray, by_point: FloatArray,
    half: FloatArray, g: FloatArray,
) -> None:  # fmt: skip
    """Add J'J - A'A and J'r - A'b of all points, A and b being J and r projected onto the point.

    Args:
        rows: (N,) observations sorted by point, and (P + 1,) where those of each point begin.
        columns, r, by_view, by_point: as in `ShutterSystem`.
        half: (n, n) changed in place: each pair of unknowns in one of its two places.
        g: (n,) changed in place.
    """
    order, starts = rows
    width, n = columns.shape[1], len(g)
    A, b = np.zeros((3, n)), np.zeros(3)
    touched, seen = np.zeros(n, np.int64), np.zeros(n, np.bool_)
    for point in range(len(starts) - 1):
        count = 0
        b[:] = 0.0
        for place in range(starts[point], starts[point + 1]):
            k = order[place]
            u, v = by_point[k, 0], by_point[k, 1]
            for j in range(3):
                b[j] += u[j] * r[k, 0] + v[j] * r[k, 1]
            for one in range(width):
                column, x, y = columns[k, one], by_view[k, 0, one], by_view[k, 1, one]
                if not seen[column]:
                    seen[column], touched[count] = True, column
                    count += 1
                g[column] += x * r[k, 0] + y * r[k, 1]
                for j in range(3):
                    A[j, column] += u[j] * x + v[j] * y
                for two in range(one + 1):
                    half[column, columns[k, two]] += x * by_view[k, 0, two] + y * by_view[k, 1, two]
        for one in range(count):
            column = touched[one]
            x, y, z = A[0, column], A[1, column], A[2, column]
            g[column] -= x * b[0] + y * b[1] + z * b[2]
            for two in range(one + 1):
                other = touched[two]
                half[column, other] -= x * A[0, other] + y * A[1, other] + z * A[2, other]
        for one in range(count):
            seen[touched[one]] = False
            A[:, touched[one]] = 0.0


def solve_step(system: ShutterSystem) -> ShutterStep:
    """Return the step; the deviation is at least that of the sandwich estimator with photos as clusters."""
    n, free = len(system.g), system.free
    inverse = inverse_of_positive(system.S[np.ix_(free, free)])
    views, influence, variances = np.zeros(n), np.zeros(n), np.zeros(n)
    views[free] = np.einsum("ij,j->i", inverse, system.g[free])
    variances[free] = np.diag(inverse)
    if free[-1] == n - 1:
        influence[free] = inverse[:, -1]
    points, left = _back_substitute(system, views, system.r)
    _, influences = _back_substitute(system, -influence, np.zeros_like(system.r))
    noise2 = float((np.sum(left**2) + USUAL_COUNT * USUAL_NOISE_PX**2) / (max(system.spare, 0) + USUAL_COUNT))
    by_photo = np.bincount(system.photo, np.sum(influences * left, axis=1))
    deviation = MISFIT * np.sqrt(max(noise2 * variances[-1], float(np.sum(by_photo**2))))
    offsets = noise2 * variances[system.offsets].reshape(-1, VELOCITY)
    moved = np.einsum("pji,pj->pi", system.whiten, points)
    return ShutterStep(views, moved, float(np.sqrt(noise2)), float(deviation), offsets)


def _back_substitute(system: ShutterSystem, views: FloatArray, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the best step of the whitened points (P, 3) after one of the views, and what it leaves of r (N, 2)."""
    left = r - np.einsum("nij,nj->ni", system.by_view, views[system.columns])
    along = np.einsum("nij,ni->nj", system.by_point, left)
    sums = [np.bincount(system.point, along[:, j], len(system.whiten)) for j in range(3)]
    points = np.array(sums, np.float64).T
    return points, left - np.einsum("nij,nj->ni", system.by_point, points[system.point])


def apply_shutter_step(model: ShutterBundle, step: ShutterStep, share: float) -> ShutterBundle:
    """Return the model after a share of a step.

    Args:
        model: not changed in place.
        step: from `solve_step`.
        share: in (0, 1].
    """
    bundle = model.bundle
    poses, offsets, cameras = np.split(share * step.views[:-1], np.cumsum([POSE, VELOCITY]) * len(bundle.R))
    params = step_cameras(bundle.params, cameras.reshape(-1, CAMERA))
    return replace(
        model,
        bundle=apply_step(bundle, params, poses.reshape(-1, POSE), share * step.points),
        readout=model.readout + share * float(step.views[-1]),
        offsets=model.offsets + offsets.reshape(-1, VELOCITY),
    )


def shutter_cost(model: ShutterBundle, scale_px: float) -> float:
    """Return half the sum of the loss of `normal_equations.reduce`, in squared pixels.

    Args:
        model: the bundle.
        scale_px: s of the loss, in pixels, > 0.
    """
    with np.errstate(all="ignore"):
        seen = project_rows(model.bundle, model.share, model.motion)
        r = model.bundle.x - seen.x
    return loss(r, usable_mask(model.bundle, r, seen.depth), scale_px)
