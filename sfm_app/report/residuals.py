"""Residuals of matches over the photo, through the calibrated lens and before bundle adjustment.

The signed Sampson distance of a match is linear in what its two pixels are off: d = a1 . v1 + a2 . v2, with a1 and a2
the gradient of the epipolar constraint by the pixels of the two photos, of length 1 together. Where all photos share a
camera, the part of v that does not depend on the match is what the lens model lacks. It is found for every cell of the
photo, from all matches together. What moves the whole photo alike is not seen: relative poses absorb it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from sfm_app.geometry.lenses.bearings import bearings
from sfm_app.geometry.lenses.ray_epipolar import FIRST, SECOND, fit_rays, gradients
from sfm_app.geometry.spd_solve import inverse_of_positive
from sfm_app.types import Calibration, CameraPairs
from sfm_app.types.calibration import PERSPECTIVE

FloatArray = NDArray[np.float64]

CELLS = 14
"""Cells along the longer side of the photo. Chosen by hand."""
FEWEST = 12
"""Least number of keypoints in a cell that is shown. Chosen by hand."""
USUAL_PX, LEAST_NOISE_PX = 0.3, 0.02
"""Standard deviation of what a lens model lacks before the matches are seen, and the least noise of a distance. The
first keeps shifts and turns small that the relative poses absorb. Chosen by hand; not measured on their own."""
REFITS = 3
"""Fits of the epipolar geometry through a lens with distortion, with weights from the fit before. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class EpipolarResiduals:
    """Residuals of N matches of photos by one camera."""

    x: FloatArray
    """(2, N, 2) pixels in photo 1 and photo 2."""
    along: FloatArray
    """(2, N, 2) a1 and a2: how far the distance grows by each pixel coordinate."""
    distances_px: FloatArray
    """(N,) signed Sampson distances."""
    repeats: float = 1.0
    """In how many pairs a photo takes part: so often may the error of one keypoint count."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualGrid:
    """Residuals by cell of the photo, rows from the top."""

    shift_px: FloatArray
    """(R, C, 2) by how much keypoints lie off on average, right and down; NaN where there are few."""
    clear: NDArray[np.bool_]
    """(R, C) whether this exceeds two standard deviations."""
    size_px: FloatArray
    """(R, C) median absolute distance of the matches; NaN where there are few."""


def epipolar_residuals(pairs: CameraPairs, camera: Calibration) -> EpipolarResiduals:
    """Return the residuals of all inliers.

    Args:
        pairs: of this camera; their matrices are of pixels for a perspective camera, else of rays.
        camera: any projection.
    """
    x, along, distances = [np.zeros((2, 0, 2))], [np.zeros((2, 0, 2))], [np.zeros(0)]
    matched = ((F, np.asarray(x, np.float64)) for F, x in zip(pairs.Fs, pairs.inliers, strict=False) if len(x))
    for F, match in matched:
        points = match[:, :2], match[:, 2:]
        lines = np.hstack([bearings(one, camera) for one in points])
        E = _matrix_of_rays(F, lines, camera)
        length = gradients(E, lines)
        line2, line1 = lines[:, FIRST] @ E.T, lines[:, SECOND] @ E
        slopes1 = np.einsum("nki,ni->nk", lines[:, 3:9].reshape(-1, 2, 3), line1)
        slopes2 = np.einsum("nki,ni->nk", lines[:, 12:18].reshape(-1, 2, 3), line2)
        x.append(np.stack(points))
        along.append(np.stack([slopes1, slopes2]) / length[:, None])
        distances.append(np.einsum("ni,ni->n", lines[:, SECOND], line2) / length)
    photos = {photo for pair in pairs.photos for photo in pair}
    repeats = max(2.0 * len(pairs.photos) / len(photos), 1.0) if photos else 1.0
    return EpipolarResiduals(np.concatenate(x, 1), np.concatenate(along, 1), np.concatenate(distances), repeats)


def residual_grid(found: EpipolarResiduals, size: tuple[int, int]) -> ResidualGrid:
    """Return the residuals by cell.

    Args:
        found: the residuals.
        size: (width, height) of the photos in pixels.
    """
    side = max(size) / CELLS
    columns, rows = (max(1, round(length / side)) for length in size)
    count = rows * columns
    places = np.clip(found.x / np.array(size) * [columns, rows], 0, [columns - 1, rows - 1]).astype(np.int64)
    cells = places[..., 1] * columns + places[..., 0]
    many = np.bincount(cells.ravel(), minlength=count).reshape(rows, columns) >= FEWEST
    sizes = _medians(np.abs(found.distances_px), cells, count).reshape(rows, columns)
    shift, deviation = _mean_shifts(found, cells, count)
    shift, deviation = shift.reshape(rows, columns, 2), deviation.reshape(rows, columns, 2)
    clear = many & (np.hypot(*np.moveaxis(shift, 2, 0)) > 2.0 * np.hypot(*np.moveaxis(deviation, 2, 0)))
    return ResidualGrid(np.where(many[..., None], shift, np.nan), clear, np.where(many, sizes, np.nan))


def _mean_shifts(found: EpipolarResiduals, cells: NDArray[np.int64], count: int) -> tuple[FloatArray, FloatArray]:
    """Return shifts (count, 2) of keypoints by cell, by least squares over all matches, and their deviations."""
    matches = len(found.distances_px)
    spots = (2 * cells[..., None] + np.arange(2)).transpose(1, 0, 2).reshape(matches, 4)
    values = found.along.transpose(1, 0, 2).reshape(matches, 4)
    rows = np.repeat(np.arange(matches), 4)
    A = sparse.csr_array((values.ravel(), (rows, spots.ravel())), shape=(matches, 2 * count))
    noise = max(float(np.sqrt(found.repeats * np.mean(found.distances_px**2))) if matches else 0.0, LEAST_NOISE_PX)
    covariance = inverse_of_positive((A.T @ A).toarray() / noise**2 + np.eye(2 * count) / USUAL_PX**2)
    pull = np.asarray(A.T @ found.distances_px, np.float64) / noise**2
    shift = np.einsum("ij,j->i", covariance, pull)
    return shift.reshape(count, 2), np.sqrt(np.diag(covariance)).reshape(count, 2)


def _medians(values: FloatArray, cells: NDArray[np.int64], count: int) -> FloatArray:
    """Return (count,) medians of the values of matches by the cells of both keypoints; NaN without any."""
    found = np.full(count, np.nan)
    both = np.tile(values, 2)
    order = np.argsort(cells.ravel(), kind="stable")
    for cell, mine in zip(*_groups(cells.ravel()[order], both[order]), strict=True):
        found[cell] = np.median(mine)
    return found


def _groups(keys: NDArray[np.int64], values: FloatArray) -> tuple[list[int], list[FloatArray]]:
    """Return the distinct keys, which are sorted, and the values of each."""
    names, starts = np.unique(keys, return_index=True)
    return names.tolist(), np.split(values, starts[1:]) if len(names) else []


def _matrix_of_rays(F: FloatArray, lines: FloatArray, camera: Calibration) -> FloatArray:
    """Return the matrix (3, 3) of rays of a pair: the given one, or fitted again where the lens distorts."""
    if camera.projection != PERSPECTIVE:
        return F
    E = np.asarray(camera.K.T @ F @ camera.K, np.float64)
    for _ in range(REFITS if camera.is_bent else 0):
        E = fit_rays(lines[:, FIRST], lines[:, SECOND], gradients(E, lines) ** -2.0)
    return E
