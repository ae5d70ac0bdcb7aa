"""Painting of photos onto the texels of the pages.

First every texel gets an owner: the triangle that contains it or, in the margin of a chart, the nearest one. Then each
photo adds its share to the texels of the triangles that it contributes to. The texel's point on the surface is
projected through pose and lens, and the photo is sampled there, so photos are resampled only once.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.facets import NONE, IntArray
from sfm_app.texture.packing import MARGIN
from sfm_app.texture.views import project, sample

FloatArray = NDArray[np.float64]
Spread = Callable[[Callable[[int], Any], Sequence[int]], Iterable[Any]]
"""Calls a function for every number, possibly in parallel, and returns the results in order."""

BAND = 512
"""Rows of a page whose texels get owners at once. Chosen by hand: a few for each of two workers."""
LEVELS_PER_GRAY = 256
INSET_PX, MOST_INSET = 1.5, 0.3
"""At an edge where the visible surface ends, pixels mix with the background. Texels closer to it than this distance in
texels, or this share of the triangle's height, repeat the color at that distance."""
NO_LIMIT = -9.0


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """A page that is being painted."""

    owner: IntArray
    """(H, W) triangle that a texel belongs to, -1 for none."""
    total: IntArray
    """(H, W, 3) weighted sum over photos, in 1 / FINE gray levels; sums of integers do not depend on the order."""


def canvas(size: tuple[int, int], triangles: NDArray[np.int64], corners: FloatArray, spread: Spread = map) -> Canvas:
    """Make an empty page whose texels have owners.

    Args:
        size: (width, height) of the page.
        triangles: (N,) indices of the page's triangles.
        corners: (T, 3, 2) texels.
        spread: applies a function to parts of the page, possibly in parallel.
    """
    return Canvas(owners(size, triangles, corners, spread), np.zeros((size[1], size[0], 3), np.int32))


def owners(size: tuple[int, int], triangles: NDArray[np.int64], corners: FloatArray, spread: Spread = map) -> IntArray:
    """Return (H, W) the triangle that each texel belongs to, -1 for none.

    Args:
        size: (width, height) of the page.
        triangles: (N,) indices of the page's triangles.
        corners: (T, 3, 2) texels.
        spread: applies a function to parts of the page, possibly in parallel.
    """
    owner = np.full((size[1], size[0]), NONE, np.int32)

    def claim(top: int) -> None:
        band = owner[top : top + BAND]  # who owns a texel does not depend on the others
        _claim_texels(triangles, corners, top, 0.0, band)
        for margin in range(1, MARGIN + 1):
            _claim_texels(triangles, corners, top, margin - 0.5, band)

    for _ in spread(claim, range(0, size[1], BAND)):
        pass
    return owner


@kernel
def _claim_texels(triangles: NDArray[np.int64], corners: FloatArray, top: int, reach: float, owner: IntArray) -> None:
    """Claim free texels within `reach` of each triangle, in a band of a page; `top` is its first row."""
    height, width = owner.shape
    for f in triangles:
        ax, ay = corners[f, 0, 0], corners[f, 0, 1]
        bx, by = corners[f, 1, 0], corners[f, 1, 1]
        cx, cy = corners[f, 2, 0], corners[f, 2, 1]
        y0, y1 = max(int(min(ay, by, cy) - reach - 0.5), top), min(int(max(ay, by, cy) + reach + 0.5), top + height - 1)
        x0, x1 = max(int(min(ax, bx, cx) - reach - 0.5), 0), min(int(max(ax, bx, cx) + reach + 0.5), width - 1)
        for y in range(y0, y1 + 1):
            for x in range(x0, x1 + 1):
                if owner[y - top, x] == NONE and _distance(corners[f], x + 0.5, y + 0.5) <= reach:
                    owner[y - top, x] = f


@kernel
def _distance(corner: FloatArray, x: float, y: float) -> float:
    """Return the distance from a point to a triangle; 0 inside."""
    turn = (corner[1, 0] - corner[0, 0]) * (corner[2, 1] - corner[0, 1])
    turn -= (corner[1, 1] - corner[0, 1]) * (corner[2, 0] - corner[0, 0])
    sign = 1.0 if turn >= 0.0 else -1.0
    inside, nearest = turn != 0.0, np.inf
    for k in range(3):
        ax, ay = corner[k, 0], corner[k, 1]
        ex, ey = corner[(k + 1) % 3, 0] - ax, corner[(k + 1) % 3, 1] - ay
        inside = inside and sign * (ex * (y - ay) - ey * (x - ax)) >= 0.0
        length = ex * ex + ey * ey
        along = ((x - ax) * ex + (y - ay) * ey) / length if length > 0.0 else 0.0
        along = min(max(along, 0.0), 1.0)
        nearest = min(nearest, np.hypot(x - ax - along * ex, y - ay - along * ey))
    return 0.0 if inside else nearest


@kernel
def paint(
    photo: NDArray[np.uint8],
    camera: FloatArray,
    brightness: FloatArray,
    triangles: NDArray[np.int64],
    corners: FloatArray,
    points: FloatArray,
    shares: NDArray[np.float32],
    rims: NDArray[np.bool_],
    owner: IntArray,
    total: IntArray,
) -> None:
    """Add one photo to a page.

    Args:
        photo: (height, width, 3) RGB.
        camera: (26,) lens and pose of the photo at this size.
        brightness: (3,) factors, the inverse of the photo's gains.
        triangles: (N,) indices of the page's triangles that the photo contributes to.
        corners: (T, 3, 2) texels.
        points: (N, 3, 3) corners in the scene.
        shares: (N, 3, 4) weight of the photo at each corner, and offsets of its channels in gray levels.
        rims: (N, 3) whether the photo sees no triangle across the edge from corner k to k + 1.
        owner: (H, W) of the page.
        total: (H, W, 3) of the page.
    """
    height, width = owner.shape
    part, least = np.empty(3), np.empty(3)
    for n in range(len(triangles)):
        f = triangles[n]
        ax, ay = corners[f, 0, 0], corners[f, 0, 1]
        bx, by = corners[f, 1, 0] - ax, corners[f, 1, 1] - ay
        cx, cy = corners[f, 2, 0] - ax, corners[f, 2, 1] - ay
        _set_insets(corners[f], rims[n], abs(bx * cy - by * cx), least)
        x0, x1 = int(min(0.0, bx, cx) + ax - MARGIN - 1), int(max(0.0, bx, cx) + ax + MARGIN + 1)
        y0, y1 = int(min(0.0, by, cy) + ay - MARGIN - 1), int(max(0.0, by, cy) + ay + MARGIN + 1)
        for y in range(max(y0, 0), min(y1, height - 1) + 1):
            for x in range(max(x0, 0), min(x1, width - 1) + 1):
                if owner[y, x] != f:
                    continue
                set_shares(corners[f], x + 0.5, y + 0.5, part)
                _clamp_coordinates(part, least)
                px = part[0] * points[n, 0, 0] + part[1] * points[n, 1, 0] + part[2] * points[n, 2, 0]
                py = part[0] * points[n, 0, 1] + part[1] * points[n, 1, 1] + part[2] * points[n, 2, 1]
                pz = part[0] * points[n, 0, 2] + part[1] * points[n, 1, 2] + part[2] * points[n, 2, 2]
                u, v, _ = project(camera, px, py, pz)
                _add(photo, brightness, (u, v), part, shares[n], total[y, x])


@kernel
def set_shares(corner: FloatArray, x: float, y: float, part: FloatArray) -> None:
    """Set the barycentric coordinates of a texel, which may lie in the margin of its triangle.

    Args:
        corner: (3, 2) corners of the triangle in texels.
        x, y: center of the texel.
        part: (3,) is set.
    """
    ax, ay = corner[0, 0], corner[0, 1]
    bx, by, cx, cy = corner[1, 0] - ax, corner[1, 1] - ay, corner[2, 0] - ax, corner[2, 1] - ay
    turn, dx, dy = bx * cy - by * cx, x - ax, y - ay
    part[1] = (dx * cy - dy * cx) / turn if turn != 0.0 else 0.0
    part[2] = (bx * dy - by * dx) / turn if turn != 0.0 else 0.0
    # margins of thin triangles must not be extrapolated far
    part[1], part[2] = min(max(part[1], -1.0), 2.0), min(max(part[2], -1.0), 2.0)
    part[0] = 1.0 - part[1] - part[2]


@kernel
def _add(
    photo: NDArray[np.uint8],
    brightness: FloatArray,
    position: tuple[float, float],
    part: FloatArray,
    share: NDArray[np.float32],
    texel: IntArray,
) -> None:
    """Add the color of a photo at a position to a texel, with weight and offset clamped to the triangle."""
    inner = 0.0
    for k in range(3):
        part[k] = max(part[k], 0.0)
        inner += part[k]
    weight = (part[0] * share[0, 0] + part[1] * share[1, 0] + part[2] * share[2, 0]) / inner
    if weight <= 0.0:
        return
    for channel in range(3):
        value = brightness[channel] * sample(photo, position[0], position[1], channel)
        for k in range(3):
            value += part[k] / inner * share[k, 1 + channel]
        texel[channel] += int(np.floor(LEVELS_PER_GRAY * weight * value + 0.5))


@kernel
def _set_insets(corner: FloatArray, rim: NDArray[np.bool_], double_area: float, least: FloatArray) -> None:
    """Set lower bounds of barycentric coordinates that keep texels away from rims; other edges have none."""
    for k in range(3):
        a, b = (k + 1) % 3, (k + 2) % 3
        length = np.hypot(corner[b, 0] - corner[a, 0], corner[b, 1] - corner[a, 1])
        height_px = max(double_area / max(length, 1e-9), 1e-9)
        least[k] = min(INSET_PX / height_px, MOST_INSET) if rim[a] else NO_LIMIT


@kernel
def _clamp_coordinates(part: FloatArray, least: FloatArray) -> None:
    """Raise barycentric coordinates to their lower bounds, and reduce the others so that the sum stays 1."""
    for k in range(3):
        lack = least[k] - part[k]
        if lack > 0.0:
            rest = part[(k + 1) % 3] + part[(k + 2) % 3]
            for j in (k + 1, k + 2):
                part[j % 3] -= lack * part[j % 3] / rest if rest != 0.0 else 0.5 * lack
            part[k] = least[k]


def finish_page(page: Canvas) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the page as 8-bit RGB, black at texels without an owner, and (H, W) whether a texel has one."""
    rounded = np.empty(page.total.shape, np.uint8)
    _round_levels(page.total, rounded)
    return rounded, page.owner != NONE


@kernel
def _round_levels(total: IntArray, rounded: NDArray[np.uint8]) -> None:
    """Fill in the gray levels of weighted sums."""
    for y in range(total.shape[0]):
        for x in range(total.shape[1]):
            for channel in range(3):
                level = (total[y, x, channel] + LEVELS_PER_GRAY // 2) // LEVELS_PER_GRAY
                rounded[y, x, channel] = min(max(level, 0), 255)


def fill_background(page: NDArray[np.uint8], painted: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Fill texels without an owner with the mean painted color of the smallest block around them that has one.

    The blocks are those of mipmaps, so a page downsampled by a viewer keeps its colors up to the rims of the charts.

    Args:
        page: (H, W, 3) RGB.
        painted: (H, W) whether a texel has an owner.
    """
    if painted.all() or min(page.shape[:2]) < 2:
        return page
    shape = page.shape[0] // 2, page.shape[1] // 2
    means, known = np.zeros((*shape, 3), np.uint8), np.zeros(shape, np.bool_)
    _average_blocks(page, painted, means, known)
    filled = page.copy()
    _fill_gaps(fill_background(means, known), painted, filled)
    return filled


@kernel
def _average_blocks(
    page: NDArray[np.uint8], painted: NDArray[np.bool_], means: NDArray[np.uint8], known: NDArray[np.bool_]
) -> None:
    """Fill in the mean painted color of each block of 2 x 2 texels, and whether it has one."""
    for y in range(known.shape[0]):
        for x in range(known.shape[1]):
            count = 0
            for k in range(4):
                count += painted[2 * y + k // 2, 2 * x + k % 2]
            known[y, x] = count > 0
            for channel in range(3):
                total = 0
                for k in range(4):
                    if painted[2 * y + k // 2, 2 * x + k % 2]:
                        total += page[2 * y + k // 2, 2 * x + k % 2, channel]
                means[y, x, channel] = total // max(count, 1)


@kernel
def _fill_gaps(coarse: NDArray[np.uint8], painted: NDArray[np.bool_], page: NDArray[np.uint8]) -> None:
    """Give texels without an owner the color of their block."""
    for y in range(page.shape[0]):
        for x in range(page.shape[1]):
            if not painted[y, x]:
                for channel in range(3):
                    page[y, x, channel] = coarse[
                        min(y // 2, coarse.shape[0] - 1), min(x // 2, coarse.shape[1] - 1), channel
                    ]
