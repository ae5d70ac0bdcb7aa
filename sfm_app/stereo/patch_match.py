"""PatchMatch: a plane for every pixel, propagated to neighboring pixels where it lowers the matching cost.

Bleyer, Rhemann, Rother: PatchMatch stereo. BMVC 2011; Schoenberger et al.: Pixelwise view selection for unstructured
multi-view stereo. ECCV 2016 (the weighted correlation). Semi-global matching prefers fronto-parallel surfaces and
widens the foreground. From its depths, one sweep finds slanted surfaces and the true borders; a second one would
improve 1 % of the pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import inlined_kernel, kernel, summing_kernel
from sfm_app.stereo.view import GrayImage, View
from sfm_app.types.arrays import DepthArray, FloatArray, IndexArray

PlaneArray = NDArray[np.float32]
"""(H, W, 3): inverse depth q and its slopes, q + qu du + qv dv at (du, dv) pixels away; q = 0 where unknown."""

PhotoStack = tuple[NDArray[np.uint32], int, IndexArray, FloatArray]
"""Photos, (N H W) with a byte each of a pixel, its right neighbor and the two below; the width W; their sizes (N, 2),
and the projections (N, 3, 4) of pixels into them."""

REACH = 2
STRIDE_PX = 2
"""The window has (2 REACH + 1)^2 pixels with this spacing."""
SIDE = 2 * REACH + 1
BORDER = REACH * STRIDE_PX
STEPS = np.arange(-REACH, REACH + 1, dtype=np.float32) * STRIDE_PX
ACROSS, DOWN = np.tile(STEPS, SIDE), np.repeat(STEPS, SIDE)
"""Offsets of the window's pixels from its center, row by row."""
NO_MATCH = 2.0
"""The cost where no neighbor sees the pixel; no correlation costs more."""
LOW = np.uint32(0xFF)
MIN_GAIN = 0.01
"""Smallest decrease of the cost that replaces a plane; without it, noise would make flat areas rough."""
STEP_PX = 0.3
"""Largest random change of a trial plane, in pixels of parallax."""
SAME = 0.01
"""Relative difference within which guesses of a depth are the same. Chosen by hand."""
RADIUS_PX = 5
"""Radius of the window of a plane fit."""
MAX_STEP = 0.02
"""Relative depth difference beyond which a pixel belongs to another surface."""


@dataclass(frozen=True, slots=True)
class PatchOptions:
    """Weights in windows."""

    sigma_px: float = 4.0
    """Standard deviation of the weights in the correlation window."""
    falloff_gray: float = 12.0
    """Difference in gray from the center pixel at which the weight is 1/e: the pixel may be of another object."""
    normal_sigma_px: float = 2.5
    """Standard deviation of the weights of a plane fit; smaller keeps more detail, larger makes smoother normals."""
    min_weight: float = 0.25
    """Smallest share of the weight of a plane fit that must have a depth."""


OPTIONS = PatchOptions()


def match_planes(
    guesses: NDArray[np.float32], view: View, image: GrayImage, others: Sequence[tuple[View, GrayImage]]
) -> tuple[PlaneArray, NDArray[np.float32]]:
    """Return planes (H, W, 3) about the pixel centers, and their costs (H, W) in [0, 2]; 2 where unknown.

    A pixel starts from the first of its guesses (N, H, W), depths or 0. In a sweep down and to the right it tries the
    others, the planes of its upper and left neighbors, and a small random change of its own plane. The cost of a plane
    is 1 - the normalized cross-correlation of the pixel's window with its image in a neighboring photo, averaged over
    the better half of the photos, because the others may be occluded. Weights in the window fall with the distance and
    with the difference in gray from the center.
    """
    first = np.take_along_axis(guesses, np.argmax(guesses > 0, axis=0)[None], axis=0)[0]
    planes = fit_planes(first)
    planes[..., 0] = np.divide(1, first, out=np.zeros_like(first), where=first > 0)
    near = np.exp(-0.5 * (STEPS[:, None] ** 2 + STEPS**2) / OPTIONS.sigma_px**2)
    alike = np.exp(-np.arange(256) / OPTIONS.falloff_gray)
    cost = np.full(image.shape, NO_MATCH, np.float32)
    _sweep(image, (near, alike), stack_photos(view, others), guesses, planes, cost)
    return planes, cost


def stack_photos(view: View, others: Sequence[tuple[View, GrayImage]]) -> PhotoStack:
    """Return photos for kernels; the projections are those of `View.projection_into`."""
    height, width = (max((photo.shape[side] for _, photo in others), default=2) for side in (0, 1))
    stack = np.zeros((len(others), height, width), np.uint32)
    projections, sizes = np.empty((len(others), 3, 4)), np.empty((len(others), 2), np.int64)
    for k, (other, photo) in enumerate(others):
        wide = photo.astype(np.uint32)  # a pixel, its right neighbor, and the two below them, a byte each
        packed = wide[:-1, :-1] | wide[:-1, 1:] << 8 | wide[1:, :-1] << 16 | wide[1:, 1:] << 24
        stack[k, : photo.shape[0] - 1, : photo.shape[1] - 1] = packed
        sizes[k] = photo.shape
        projections[k] = view.projection_into(other)
    return stack.ravel(), width, sizes, projections


@kernel
def _sweep(
    image: GrayImage, falloff: Any, others: Any, guesses: NDArray[np.float32], planes: PlaneArray,
    cost: NDArray[np.float32],
) -> None:  # fmt: skip
    height, width = image.shape
    weights, grays = np.empty(SIDE * SIDE, np.float32), np.empty(SIDE * SIDE, np.float32)
    costs = np.empty(len(others[3]))
    best, trial = np.empty(3), np.empty(3)
    for row in range(BORDER, height - BORDER):
        # every row has its own random numbers (Knuth's linear congruential generator)
        state = np.uint64(2 * row + 1) * np.uint64(0x9E3779B97F4A7C15)
        for col in range(BORDER, width - BORDER):
            mean, variance = _read_window(image, row, col, falloff, weights, grays)
            window = (weights, grays, mean, variance)
            for c in range(3):
                best[c] = planes[row, col, c]
            known = best[0] > 0
            lowest = _cost(row, col, best, window, others, costs) if known else NO_MATCH
            unit = _inverse_depth_per_px(row, col, best[0], others[3]) if known else 0.0
            for k in range(len(guesses)):
                depth = guesses[k, row, col]
                if depth > 0 and abs(depth * best[0] - 1.0) > SAME:
                    trial[0], trial[1], trial[2] = 1.0 / depth, best[1], best[2]
                    lowest = _try_plane(row, col, trial, best, lowest, window, others, costs)
            lowest = _try_neighbors(row, col, planes, unit, trial, best, lowest, window, others, costs)
            if lowest < NO_MATCH:
                unit = _inverse_depth_per_px(row, col, best[0], others[3])
                for c in range(3):
                    state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
                    number = 2.0 * (np.float64(state >> np.uint64(11)) / 9007199254740992.0) - 1.0  # in [-1, 1)
                    # slopes change by a fifth of `STEP_PX` per pixel
                    trial[c] = best[c] + number * STEP_PX * unit * (1.0 if c == 0 else 0.2)
                lowest = _try_plane(row, col, trial, best, lowest, window, others, costs)
            for c in range(3):
                planes[row, col, c] = best[c]
            cost[row, col] = lowest


@kernel
def _try_neighbors(  # noqa: PLR0913
    row: int, col: int, planes: PlaneArray, unit: float, trial: FloatArray, best: FloatArray, lowest: float,
    window: Any, others: Any, costs: FloatArray,
) -> float:  # fmt: skip
    """Try the planes of the upper and the left neighbor; return the lowest cost."""
    for side in range(2):
        r, s = (row - 1, col) if side == 0 else (row, col - 1)
        if planes[r, s, 0] <= 0:
            continue
        trial[1], trial[2] = planes[r, s, 1], planes[r, s, 2]
        trial[0] = planes[r, s, 0] + (col - s) * trial[1] + (row - r) * trial[2]
        slopes = abs(trial[1] - best[1]) + abs(trial[2] - best[2])
        # equal planes: in pixels of parallax, at the pixel and per pixel of distance
        if abs(trial[0] - best[0]) < 0.1 * unit and slopes < 0.03 * unit:
            continue
        lowest = _try_plane(row, col, trial, best, lowest, window, others, costs)
    return lowest


@kernel
def _read_window(
    image: GrayImage, row: int, col: int, falloff: Any, weights: NDArray[np.float32], grays: NDArray[np.float32]
) -> tuple[float, float]:
    """Fill in weights, of sum 1, and gray values around a pixel; return the weighted mean and variance."""
    near, alike = falloff
    middle = np.int64(image[row, col])  # int() of an unsigned number stays unsigned
    total, mean, square = 0.0, 0.0, 0.0
    k = 0
    for i in range(SIDE):
        for j in range(SIDE):
            gray = np.int64(image[row + (i - REACH) * STRIDE_PX, col + (j - REACH) * STRIDE_PX])
            weight = near[i, j] * alike[abs(gray - middle)]
            weights[k], grays[k] = weight, gray
            total += weight
            mean += weight * gray
            square += weight * gray * gray
            k += 1
    for k in range(SIDE * SIDE):
        weights[k] /= total
    mean /= total
    return mean, max(0.0, square / total - mean * mean)


@kernel
def _inverse_depth_per_px(row: int, col: int, q: float, projections: FloatArray) -> float:
    """Return the change of inverse depth that moves the image by one pixel in the neighbor where it moves most."""
    most = 1e-12
    x, y = col + 0.5, row + 0.5
    for k in range(len(projections)):
        P = projections[k]
        w = P[2, 0] * x + P[2, 1] * y + P[2, 2] + P[2, 3] * q
        if w > 0:
            u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] + P[0, 3] * q) / w
            v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] + P[1, 3] * q) / w
            most = max(most, np.hypot(P[0, 3] - u * P[2, 3], P[1, 3] - v * P[2, 3]) / w)
    return 1.0 / most


@kernel
def _try_plane(  # noqa: PLR0913
    row: int, col: int, trial: FloatArray, best: FloatArray, lowest: float, window: Any, others: Any, costs: FloatArray
) -> float:
    """Replace the best plane if the trial costs less by `MIN_GAIN`; return the lowest cost."""
    if trial[0] <= 0:
        return lowest
    cost = _cost(row, col, trial, window, others, costs)
    if cost >= lowest - MIN_GAIN:
        return lowest
    for c in range(3):
        best[c] = trial[c]
    return cost


@kernel
def _cost(row: int, col: int, plane: FloatArray, window: Any, others: Any, costs: FloatArray) -> float:
    stack, stride, sizes, projections = others
    x, y = col + 0.5, row + 0.5
    count = 0
    for k in range(len(projections)):
        u, v, uu, uv, vu, vv = warp(projections[k], x, y, plane)
        if np.isnan(u):
            continue
        u, v = u - 0.5, v - 0.5
        du, dv = BORDER * (abs(uu) + abs(uv)), BORDER * (abs(vu) + abs(vv))
        inside = u - du >= 0 and v - dv >= 0 and u + du < sizes[k, 1] - 1 and v + dv < sizes[k, 0] - 1
        # area of a warped pixel in the neighbor
        if not (inside and 0.1 < uu * vv - uv * vu < 8.0):
            continue
        start = k * (len(stack) // len(projections))
        cost = 1.0 - _correlation(stack, start, stride, (u, v, uu, uv, vu, vv), window)
        place = count  # insertion keeps the costs in rising order
        while place > 0 and costs[place - 1] > cost:
            costs[place] = costs[place - 1]
            place -= 1
        costs[place] = cost
        count += 1
    if count == 0:
        return NO_MATCH
    used = min(count, (len(projections) + 1) // 2)
    total = 0.0
    for k in range(used):
        total += costs[k]
    return total / used


@inlined_kernel
def warp(P: FloatArray, x: float, y: float, plane: FloatArray) -> tuple[float, float, float, float, float, float]:
    """Return the image (u, v) of a pixel by its plane, and du/dx, du/dy, dv/dx, dv/dy; u is nan behind the camera."""
    q = plane[0]
    w = P[2, 0] * x + P[2, 1] * y + P[2, 2] + P[2, 3] * q
    if w <= 0:
        return np.nan, np.nan, 0.0, 0.0, 0.0, 0.0
    u = (P[0, 0] * x + P[0, 1] * y + P[0, 2] + P[0, 3] * q) / w
    v = (P[1, 0] * x + P[1, 1] * y + P[1, 2] + P[1, 3] * q) / w
    # within a window the plane's homography is nearly affine
    wu, wv = P[2, 0] + P[2, 3] * plane[1], P[2, 1] + P[2, 3] * plane[2]
    uu = (P[0, 0] + P[0, 3] * plane[1] - u * wu) / w
    uv = (P[0, 1] + P[0, 3] * plane[2] - u * wv) / w
    vu = (P[1, 0] + P[1, 3] * plane[1] - v * wu) / w
    vv = (P[1, 1] + P[1, 3] * plane[2] - v * wv) / w
    return u, v, uu, uv, vu, vv


@summing_kernel
def _correlation(stack: NDArray[np.uint32], start: int, stride: int, affine: Any, window: Any) -> float:
    """Return the weighted normalized cross-correlation of a window and its image; both variances include noise."""
    weights, grays, mean, variance = window
    u, v = np.float32(affine[0]), np.float32(affine[1])
    uu, uv, vu, vv = np.float32(affine[2]), np.float32(affine[3]), np.float32(affine[4]), np.float32(affine[5])
    one, square, mixed, middle = np.float32(0), np.float32(0), np.float32(0), np.float32(mean)
    for k in range(SIDE * SIDE):
        x, y = u + ACROSS[k] * uu + DOWN[k] * uv, v + ACROSS[k] * vu + DOWN[k] * vv
        column, line = np.int32(x), np.int32(y)
        fx, fy = x - np.float32(column), y - np.float32(line)
        # unsigned indices need no test for negative values
        four = stack[np.uint64(start + line * stride + column)]
        a, b = np.float32(four & LOW), np.float32((four >> np.uint32(8)) & LOW)
        c, d = np.float32((four >> np.uint32(16)) & LOW), np.float32(four >> np.uint32(24))
        upper, lower = a + fx * (b - a), c + fx * (d - c)
        gray = upper + fy * (lower - upper) - middle  # small numbers keep their digits
        weighted = weights[k] * gray
        one += weighted
        square += weighted * gray
        mixed += weighted * grays[k]
    noise = 2.0 * 2.0  # variance of gray levels without texture
    spread = (variance + noise) * (max(0.0, float(square - one * one)) + noise)
    return float((mixed - one * mean) / np.sqrt(spread))


def fit_planes(depth: DepthArray) -> PlaneArray:
    """Fit a plane to the surroundings of every pixel, by least squares.

    A plane n'X = 1 has the inverse depth n'x at the ray x = K^-1 (u, v, 1), which is linear in n and in the noise.

    Return (H, W, 3) inverse depth at the pixel and its slopes per pixel; 0 where the depth is unknown or isolated.
    """
    planes = np.zeros((*depth.shape, 3), np.float32)
    steps = np.arange(-RADIUS_PX, RADIUS_PX + 1)
    profile = np.exp(-0.5 * (steps / OPTIONS.normal_sigma_px) ** 2)
    inverse = np.divide(1.0, depth, out=np.zeros(depth.shape), where=depth > 0, dtype=np.float64)
    window = np.outer(profile, profile)
    _fit(depth, inverse, (window, OPTIONS.min_weight * float(window.sum())), planes)
    return planes


def plane_normals(planes: PlaneArray, view: View) -> NDArray[np.float32]:
    """Return (H, W, 3) unit normals in the camera frame that point to the camera; 0 where the inverse depth is 0."""
    row, col = np.nonzero(planes[..., 0] > 0)
    q, a, b = planes[row, col].astype(np.float64).T
    # n'K^-1 (u, v, 1) = q + a (u - u0) + b (v - v0) for all u, v
    c = q - a * (col + view.sample_px) - b * (row + view.sample_px)
    n = np.stack([a * K[0] + b * K[1] + c * K[2] for K in view.K.T], axis=1)
    normals = np.zeros_like(planes)
    normals[row, col] = -n / np.linalg.norm(n, axis=1, keepdims=True)
    return normals


def planes_of(depth: DepthArray, normals: NDArray[np.float32], view: View) -> PlaneArray:
    """Return the planes (H, W, 3) with these depths (H, W) and normals: `plane_normals` reversed."""
    planes = np.zeros((*depth.shape, 3), np.float32)
    row, col = np.nonzero(depth > 0)
    slopes = normals[row, col].astype(np.float64) @ np.linalg.inv(view.K)
    along = slopes[:, 0] * (col + view.sample_px) + slopes[:, 1] * (row + view.sample_px) + slopes[:, 2]
    planes[row, col, 0] = q = 1.0 / depth[row, col].astype(np.float64)
    scale = np.divide(q, along, out=np.zeros_like(q), where=along != 0.0)
    planes[row, col, 1:] = scale[:, None] * slopes[:, :2]
    return planes


@kernel
def _fit(depth: DepthArray, inverse: FloatArray, weights: tuple[FloatArray, float], planes: PlaneArray) -> None:
    for row in range(depth.shape[0]):
        for col in range(depth.shape[1]):
            if depth[row, col] > 0:
                g0, gu, gv = _slopes(depth, inverse, row, col, weights)
                if g0 > 0:
                    planes[row, col, 0], planes[row, col, 1], planes[row, col, 2] = g0, gu, gv


@kernel
def _slopes(
    depth: DepthArray, inverse: FloatArray, row: int, col: int, weights: tuple[FloatArray, float]
) -> tuple[float, float, float]:
    """Fit the inverse depth g0 + gu du + gv dv, (du, dv) in pixels from (col, row); g0 = 0 where undetermined."""
    window, least = weights
    height, width = depth.shape
    z = depth[row, col]
    n, su, sv, suu, suv, svv, q, qu, qv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(max(row - RADIUS_PX, 0), min(row + RADIUS_PX + 1, height)):
        for j in range(max(col - RADIUS_PX, 0), min(col + RADIUS_PX + 1, width)):
            other = depth[i, j]
            if other <= 0 or abs(other - z) > MAX_STEP * z:
                continue
            weight = window[i - row + RADIUS_PX, j - col + RADIUS_PX]
            du, dv, share = float(j - col), float(i - row), weight * inverse[i, j]
            n += weight
            su += weight * du
            sv += weight * dv
            suu += weight * du * du
            suv += weight * du * dv
            svv += weight * dv * dv
            q += share
            qu += du * share
            qv += dv * share
    if n < least:
        return 0.0, 0.0, 0.0
    suu, suv, svv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
    qu, qv = qu - su * q / n, qv - sv * q / n
    det = suu * svv - suv * suv
    if det < 1e-3 * n * n:  # all on one line
        return 0.0, 0.0, 0.0
    gu, gv = (svv * qu - suv * qv) / det, (suu * qv - suv * qu) / det
    return (q - gu * su - gv * sv) / n, gu, gv
