"""Find the corners of a marker in a photo to a few hundredths of a pixel, by all edges of its pattern.

Detectors look for the outer contour. Blur and the tone curve of a camera move every edge towards its dark side, so a
contour comes out half a pixel too small: 1 % of a marker of 50 pixels. A pattern has edges with the dark side on the
left and on the right, above and below, which tell this shift from the size.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.numerical import MAD_TO_SIGMA

FloatArray = NDArray[np.float64]

ALONG = (0.25, 0.5, 0.75)
"""Where an edge of a cell is measured, as shares of its length."""
STEPS = 21
"""Samples of a profile from the middle of a light cell to the middle of the dark one beside it."""
ROUNDS = 4
UNKNOWNS = 9
"""Eight of a homography, and the shift of all edges towards their dark side."""
LEAST_SHARE = 0.75
"""Least share of the pattern's edges that are seen where they should be. Chosen by hand: another marker of the family
has two thirds of them, its border included."""
LEAST_CONTRAST = 0.3
"""Least contrast of an edge that is used, as a share of the median: shadows and glare hide some. Chosen by hand."""
MAX_RMS_CELLS = 0.25
"""Largest scatter of the edges about the pattern, in cells. Chosen by hand: noise and blur reach a tenth, another
pattern a half."""
LEAST_SIGMA_PX = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class FittedMarker:
    """The pattern of a marker, fitted to a photo."""

    corners: FloatArray
    """(4, 2) in pixels, clockwise from the pattern's own top left; pixel centers at +0.5."""
    sigma_px: float
    """Standard deviation of a corner, from the scatter of the edges."""


def fit_pattern(gray: NDArray[np.uint8], pattern: NDArray[np.uint8], corners: FloatArray) -> FittedMarker | None:
    """Fit the edges of a pattern to a photo, beginning with corners that are exact to a pixel or two.

    Args:
        gray: (H, W) photo.
        pattern: (N, N) cells of the marker with its dark border, 0 or 255; what surrounds it is light.
        corners: (4, 2) in pixels, clockwise from the pattern's own top left; pixel centers at +0.5.

    Returns:
        The corners; None where too few edges are seen, or they are those of another pattern.
    """
    light, dark = edge_sides(pattern)
    middle, cells = (light + dark) / 2, float(len(pattern))
    square = np.array([[0.0, 0.0], [cells, 0.0], [cells, cells], [0.0, cells]])
    H = cv2.getPerspectiveTransform(square.astype(np.float32), corners.astype(np.float32)).astype(np.float64)
    edges, rms = 0, np.inf
    for _ in range(ROUNDS):
        seen, contrast = _crossings(gray, _project(H, light), _project(H, dark))
        normals = _normals(H, middle, dark - light)
        off = np.einsum("ni,ni->n", normals, seen - _project(H, middle))
        usable = np.isfinite(off) & (contrast > LEAST_CONTRAST * max(float(np.median(contrast)), 1.0))
        if usable.sum() < LEAST_SHARE * len(middle):
            return None
        J = np.column_stack([_derivatives(H, middle, normals), np.ones(len(middle))])
        step, edges, rms = _solve_robustly(J[usable], off[usable])
        H = H + np.append(step[:8], 0.0).reshape(3, 3)
    found = _project(H, square)
    if not np.isfinite(found).all():
        return None
    cell_px = np.sqrt(cv2.contourArea(found.astype(np.float32))) / cells
    if edges < LEAST_SHARE * len(middle) or rms > MAX_RMS_CELLS * cell_px:
        return None
    # a corner is as sure as the two sides that meet in it, each measured by a share of the edges
    return FittedMarker(found, max(float(rms * np.sqrt(UNKNOWNS / edges)), LEAST_SIGMA_PX))


def edge_sides(pattern: NDArray[np.uint8]) -> tuple[FloatArray, FloatArray]:
    """Return points (E, 2) in light cells, x and y in cells, and those in the dark ones beside them, across an edge.

    Args:
        pattern: (N, N) cells of the marker, 0 or 255; what surrounds it is light.
    """
    lit = np.pad(pattern > 127, 1, constant_values=True)
    light, dark = [], []
    for row, column in np.argwhere(lit):
        for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            there = row + down, column + right
            if min(there) < 0 or max(there) >= len(lit) or lit[there]:
                continue
            for share in ALONG:
                offset = np.array([0.5, share] if right else [share, 0.5])
                here = np.array([column - 1.0, row - 1.0]) + offset
                light.append(here)
                dark.append(here + np.array([right, down], np.float64))
    return np.array(light).reshape(-1, 2), np.array(dark).reshape(-1, 2)


def _crossings(gray: NDArray[np.uint8], light: FloatArray, dark: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where (E, 2) profiles from light to dark pass the middle of their two gray levels, and the contrast (E,).

    A profile that does not pass it gives NaN.
    """
    along = np.linspace(0.0, 1.0, STEPS)
    places = (light[:, None] + along[None, :, None] * (dark - light)[:, None]).astype(np.float32) - np.float32(0.5)
    levels = cv2.remap(gray, places[..., 0], places[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = np.asarray(levels, np.float64)
    contrast = profile[:, 0] - profile[:, -1]
    below = profile < ((profile[:, 0] + profile[:, -1]) / 2)[:, None]
    after = np.maximum(below.argmax(axis=1), 1)
    rows = np.arange(len(profile))
    high, low = profile[rows, after - 1], profile[rows, after]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (high - (profile[:, 0] + profile[:, -1]) / 2) / (high - low)
    share[~below.any(axis=1)] = np.nan
    place = (after - 1 + share) / (STEPS - 1)
    return light + place[:, None] * (dark - light), contrast


def _project(H: FloatArray, points: FloatArray) -> FloatArray:
    mapped = np.column_stack([points, np.ones(len(points))]) @ H.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _normals(H: FloatArray, middle: FloatArray, across: FloatArray) -> FloatArray:
    """Return unit normals (E, 2) of the edges in the photo, towards their dark side."""
    edge = 0.5 * np.column_stack([-across[:, 1], across[:, 0]])
    drawn = _project(H, middle + edge) - _project(H, middle - edge)
    normals = np.column_stack([drawn[:, 1], -drawn[:, 0]])
    towards = _project(H, middle + 0.5 * across) - _project(H, middle)
    normals *= np.sign(np.einsum("ni,ni->n", normals, towards))[:, None]
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


def _derivatives(H: FloatArray, points: FloatArray, normals: FloatArray) -> FloatArray:
    """Return derivatives (E, 8) of the projections along the normals, by the entries of H but the last."""
    homogeneous = np.column_stack([points, np.ones(len(points))])
    mapped = homogeneous @ H.T
    x = mapped[:, :2] / mapped[:, 2:]
    rows = homogeneous / mapped[:, 2:]
    by_last = -np.einsum("ni,ni->n", normals, x)[:, None] * rows[:, :2]
    return np.hstack([normals[:, :1] * rows, normals[:, 1:] * rows, by_last])


def _solve_robustly(J: FloatArray, off: FloatArray) -> tuple[FloatArray, int, float]:
    """Solve J step = off without outliers; return the step, how many edges agree, and their scatter."""
    kept = np.ones(len(off), bool)
    units = np.maximum(np.abs(J).max(axis=0), 1e-12)
    for _ in range(3):
        step = np.linalg.lstsq(J[kept] / units, off[kept], rcond=None)[0] / units
        left = off - J @ step
        sigma = MAD_TO_SIGMA * float(np.median(np.abs(left[kept])))
        kept = np.abs(left) <= max(3.0 * sigma, 1e-3)
    freedom = max(int(kept.sum()) - UNKNOWNS, 1)
    return step, int(kept.sum()), float(np.sqrt((left[kept] ** 2).sum() / freedom))
