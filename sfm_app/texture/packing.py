"""Packing of charts onto pages, as in Tetris (Levy et al., SIGGRAPH 2002, section 4).

Each chart has a profile of its upper and lower side. It is placed on the horizon of the charts already on the page, as
close to the top as possible. Tall charts come first.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.charts import Charts
from sfm_app.texture.facets import NONE, IntArray

FloatArray = NDArray[np.float64]

CELL = 4
"""Side of a cell of the profiles, in texels."""
MARGIN = 2
"""Width of the margin around a chart that belongs to it, in texels."""
FILL = 0.7
"""Expected share of a page that charts cover."""
SCALE_STEP = 0.95
"""Factor on the scale for the next attempt if the charts do not fit."""
LEAST_SCALE = 0.05
"""Below this scale the texture would be too coarse; pages are added instead."""


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The positions of the charts on the pages."""

    page: IntArray
    """(C,) page of each chart."""
    shift: IntArray
    """(C, 2) integer offset in texels from the photo's pixels (times `scale`) to the page."""
    scale: float
    """Texels per pixel of the photos, <= 1."""
    sizes: tuple[tuple[int, int], ...]
    """(width, height) of each page."""


def pack(
    charts: Charts, blocks: IntArray, max_atlas_px: int, max_pages: int, largest_scale: float = 1.0
) -> tuple[Layout, IntArray]:
    """Place charts and additional rectangles on few pages; reduce the scale of the charts if they do not fit.

    Args:
        charts: their triangles in pixels of the photos.
        blocks: (B, 2) widths and heights of rectangles in texels, which are never scaled.
        max_atlas_px: longest side of a page.
        max_pages: largest number of pages, exceeded only if the charts do not fit at `LEAST_SCALE`.
        largest_scale: most texels per pixel of the photos.

    Returns:
        The layout of the charts, and (B, 3) page, x and y of the rectangles.
    """
    scale = min(largest_scale, float(np.sqrt(FILL * max_pages * max_atlas_px**2 / max(_area(charts), 1.0))))
    while True:
        placed = _try_to_pack(charts, blocks, scale, max_atlas_px, max_pages)
        if placed is not None:
            return placed
        if scale > LEAST_SCALE:
            scale *= SCALE_STEP
        else:  # many small charts: their margins fill the pages
            max_pages += 1


def _area(charts: Charts) -> float:
    """Return the area of all charts in square pixels."""
    a, b, c = (charts.corners[:, k] for k in range(3))
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    return float(np.sum(np.abs(turn[charts.chart_of_face != NONE])) / 2)


def _try_to_pack(
    charts: Charts, blocks: IntArray, scale: float, max_atlas_px: int, max_pages: int
) -> tuple[Layout, IntArray] | None:
    count = len(charts.photo)
    origin, cells, starts, low, high = _profiles(charts, scale)
    block_cells = -(-blocks // CELL)
    area = float(np.sum(high - low)) + float(np.sum(block_cells.astype(np.int64).prod(axis=1)))
    widest = max((int(c) for c in np.concatenate([cells[:, 0], block_cells[:, 0]])), default=1)
    page_cells = max_atlas_px // CELL
    width = page_cells if scale < 1.0 else min(page_cells, max(widest, int(np.ceil(np.sqrt(area / FILL)))))
    if widest > page_cells or area > max_pages * page_cells * width:
        return None
    starts = np.concatenate([starts, starts[-1] + np.cumsum(block_cells[:, 0])])
    low = np.concatenate([low, np.zeros(int(block_cells[:, 0].sum()), np.int64)])
    high = np.concatenate([high, np.repeat(block_cells[:, 1], block_cells[:, 0]).astype(np.int64)])
    heights = np.concatenate([cells[:, 1], block_cells[:, 1]]).astype(np.int64)
    order = np.lexsort((np.arange(len(heights)), -heights))
    place = np.full((len(heights), 3), NONE, np.int32)
    horizon = np.zeros((max_pages, width), np.int64)
    if not _set_down(order, starts, low, high, page_cells, horizon, place):
        return None
    used = int(place[:, 0].max(initial=-1)) + 1
    sizes = tuple((width * CELL, int(horizon[page].max()) * CELL) for page in range(used))
    shift = CELL * place[:count, 1:] - origin
    return Layout(place[:count, 0], shift.astype(np.int32), scale, sizes), place[count:] * np.array([1, CELL, CELL])


def _profiles(
    charts: Charts, scale: float
) -> tuple[IntArray, IntArray, NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return origins in texels (C, 2), sizes in cells (C, 2), starts of columns (C + 1,), lower and upper profiles."""
    count = len(charts.photo)
    drawn = np.flatnonzero(charts.chart_of_face != NONE)
    of, corners = charts.chart_of_face[drawn], charts.corners[drawn] * scale
    least, most = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    for k in range(3):
        np.minimum.at(least, of, corners[:, k])
        np.maximum.at(most, of, corners[:, k])
    origin = (np.floor(least) - MARGIN).astype(np.int32)
    cells = (-(-(np.ceil(most) + MARGIN - origin) // CELL)).astype(np.int32)
    starts = np.concatenate([[0], np.cumsum(cells[:, 0], dtype=np.int64)])
    low = np.full(int(starts[-1]), np.iinfo(np.int64).max)
    high = np.zeros(int(starts[-1]), np.int64)
    _outline(of, corners - origin[of][:, None, :], starts, low, high)
    return origin, cells, starts, np.minimum(low, high), high


@kernel
def _outline(
    of: IntArray, corners: FloatArray, starts: NDArray[np.int64], low: NDArray[np.int64], high: NDArray[np.int64]
) -> None:
    """Widen the profiles of the charts to contain each triangle and its margin, column by column."""
    for f in range(len(of)):
        first, columns = starts[of[f]], starts[of[f] + 1] - starts[of[f]]
        left = min(corners[f, 0, 0], corners[f, 1, 0], corners[f, 2, 0]) - MARGIN
        right = max(corners[f, 0, 0], corners[f, 1, 0], corners[f, 2, 0]) + MARGIN
        for column in range(max(int(left // CELL), 0), min(int(right // CELL) + 1, columns)):
            x0, x1 = column * CELL - MARGIN, (column + 1) * CELL + MARGIN
            top, bottom = np.inf, -np.inf
            for k in range(3):
                ax, ay = corners[f, k, 0], corners[f, k, 1]
                bx, by = corners[f, (k + 1) % 3, 0], corners[f, (k + 1) % 3, 1]
                if max(ax, bx) < x0 or min(ax, bx) > x1:
                    continue
                if ax == bx:
                    top, bottom = min(top, ay, by), max(bottom, ay, by)
                    continue
                for x in (x0, x1):
                    y = ay + min(max((x - ax) / (bx - ax), 0.0), 1.0) * (by - ay)
                    top, bottom = min(top, y), max(bottom, y)
            if top <= bottom:
                low[first + column] = min(low[first + column], int((top - MARGIN) // CELL))
                high[first + column] = max(high[first + column], int((bottom + MARGIN) // CELL) + 1)


@kernel
def _set_down(
    order: NDArray[np.int64],
    starts: NDArray[np.int64],
    low: NDArray[np.int64],
    high: NDArray[np.int64],
    page_height: int,
    horizon: NDArray[np.int64],
    place: IntArray,
) -> bool:
    """Place every chart; return False if one does not fit on any page."""
    pages, width = horizon.shape
    for c in order:
        first, columns = starts[c], starts[c + 1] - starts[c]
        deepest = 0
        for j in range(columns):
            deepest = max(deepest, high[first + j])
        for page in range(pages):
            best_x, best_y = -1, page_height - deepest + 1
            for x in range(width - columns + 1):
                y = 0
                for j in range(columns):
                    if high[first + j] > low[first + j]:
                        y = max(y, horizon[page, x + j] - low[first + j])
                        if y >= best_y:
                            break
                if y < best_y:
                    best_x, best_y = x, y
            if best_x < 0:
                continue
            place[c, 0], place[c, 1], place[c, 2] = page, best_x, best_y
            for j in range(columns):
                if high[first + j] > low[first + j]:
                    horizon[page, best_x + j] = best_y + high[first + j]
            break
        if place[c, 0] == NONE:
            return False
    return True
