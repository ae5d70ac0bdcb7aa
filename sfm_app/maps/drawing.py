"""A textured surface drawn along parallel rays, tile by tile: colors and heights.

Triangles are arrays `corners` (T, 3, 5): x to the right, y up and height towards the viewer, in the unit of the raster,
and u, v on a page of the texture. The highest triangle wins. A triangle seen from its back is left out, so that what
lies behind it shows.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from math import ceil, floor

import numpy as np
from numpy.typing import NDArray

from sfm_app.errors import InputError
from sfm_app.geometry.raster import NOTHING, draw
from sfm_app.jit import kernel
from sfm_app.texture.pages import set_shares
from sfm_app.texture.views import sample
from sfm_app.types import Texture
from sfm_app.types.arrays import BoolArray, ByteArray, FloatArray, IndexArray

X, Y, HEIGHT, UV = 0, 1, 2, slice(3, 5)
"""Columns of a corner. By definition."""
FINE_PX = 1536
"""Side in samples of the square that is drawn at once. Chosen by hand: 100 MB of memory."""
RAYS = 3
"""Least number of samples across a pixel of an orthophoto; odd, so that one is in the middle. With 1, edges of roofs
are jagged; 5 takes twice the time, and looks the same."""
MOST_PX = 200_000
"""Longest side of a raster. Chosen by hand: 4 km at 2 cm; a larger one is mostly a typing error."""


@dataclass(frozen=True, slots=True)
class Grid:
    """The pixels of a raster. Its top left corner is a whole number of pixels from (0, 0), so that rasters match."""

    left: float
    top: float
    resolution: float
    """Side of a pixel."""
    width: int
    height: int


@dataclass(frozen=True, slots=True, eq=False)
class Tile:
    """A part of a raster."""

    row: int
    column: int
    colors: ByteArray
    """(h, w, 4) RGB and opacity; empty if not asked for."""
    heights: NDArray[np.float32]
    """(h, w) height in the middle of each pixel; NaN in holes."""


def facing_corners(points: FloatArray, faces: IndexArray, texture: Texture) -> tuple[FloatArray, NDArray[np.int32]]:
    """Return the corners (T, 3, 5) of the triangles that face the viewer, and their pages (T,).

    `points` (V, 3) are the vertices of all triangles in the raster's frame.
    """
    seen = _turns(points[:, :2][faces]) > 0.0
    return np.concatenate([points[faces[seen]], texture.uv[seen]], axis=2), texture.page[seen]


def _turns(flat: FloatArray) -> FloatArray:
    """Return twice the area (T,) of flat triangles (T, 3, 2); positive if counterclockwise."""
    a, b = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def cut_front(corners: FloatArray, page: NDArray[np.int32]) -> tuple[FloatArray, NDArray[np.int32]]:
    """Return triangles without their parts at heights above 0, which stand in front of a section."""
    behind = corners[:, :, HEIGHT] <= 0.0
    count = behind.sum(axis=1)
    kept, pages = [corners[count == 3]], [page[count == 3]]
    for number in (1, 2):
        cut, own = corners[count == number], behind[count == number]
        lone = np.argmax(own == (number == 1), axis=1)  # the corner that is alone on its side
        order = (lone[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(cut, order[:, :, None], axis=1), 1, 0)
        ab, ac = _crossing(a, b), _crossing(a, c)
        parts = [(a, ab, ac)] if number == 1 else [(ab, b, c), (ab, c, ac)]
        kept += [np.stack(part, axis=1) for part in parts]
        pages += [page[count == number]] * len(parts)
    return np.concatenate(kept), np.concatenate(pages)


def _crossing(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the points (N, 5) at height 0 between corners on both sides of it."""
    share = a[:, HEIGHT] / (a[:, HEIGHT] - b[:, HEIGHT])
    return np.asarray(a + share[:, None] * (b - a))


def texel_size(corners: FloatArray, page: NDArray[np.int32], texture: Texture) -> float:
    """Return the side of a texel in the picture: the median over its area, in the raster's unit.

    Texels are the pixels of the photos, unless the pages of the texture are too small for these.
    """
    sizes = np.array([[pixels.shape[1], pixels.shape[0]] for pixels in texture.pages], np.float64)
    texels = np.abs(_turns(corners[:, :, UV] * sizes[page][:, None]))
    areas = _turns(corners[:, :, :2])
    seen = (texels > 0.0) & (areas > 0.0)
    side, weight = np.sqrt(areas[seen] / texels[seen]), areas[seen]
    order = np.argsort(side)
    total = np.cumsum(weight[order])
    return float(side[order[np.searchsorted(total, total[-1] / 2.0)]]) if len(order) else 0.0


def cover(corners: FloatArray, resolution: float) -> Grid:
    """Return the pixels around all triangles; InputError if they are too many."""
    low, high = (edge((0, 1))[:2] / resolution for edge in (corners.min, corners.max))
    if not max(high - low) <= MOST_PX:
        hint = f"name a coarser --resolution; the longest side may have {MOST_PX} pixels"
        raise InputError(f"the raster would be {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} pixels", hint=hint)
    left, top, right, bottom = floor(low[0]), ceil(high[1]), ceil(high[0]), floor(low[1])
    return Grid(left * resolution, top * resolution, resolution, max(right - left, 1), max(top - bottom, 1))


def rays_per_pixel(resolution: float, texel: float) -> int:
    """Return how many samples lie across a pixel: one for each texel or more."""
    return max(RAYS, min(2 * ceil(resolution / texel / 2.0) + 1 if texel > 0.0 else RAYS, FINE_PX))


def count_tiles(grid: Grid, rays: int) -> int:
    """Return the number of tiles, also of those without a triangle."""
    side = max(FINE_PX // rays, 1)
    return -(-grid.width // side) * -(-grid.height // side)


def draw_tiles(
    corners: FloatArray, page: NDArray[np.int32], pages: Sequence[ByteArray], grid: Grid, rays: int
) -> Iterator[Tile]:
    """Draw all tiles with a triangle, from the top left; without `pages`, heights only.

    Memory is that of the triangles and of one tile.
    """
    pixels = corners.copy()
    pixels[:, :, X] = (corners[:, :, X] - grid.left) / grid.resolution
    pixels[:, :, Y] = (grid.top - corners[:, :, Y]) / grid.resolution
    low, high = pixels[:, :, :2].min(axis=1), pixels[:, :, :2].max(axis=1)
    base = float(corners[:, :, HEIGHT].min()) - max(float(np.ptp(corners[:, :, HEIGHT])), grid.resolution)
    pixels[:, :, HEIGHT] -= base  # positive, as what is drawn has to be
    side = max(FINE_PX // rays, 1)
    for row in range(0, grid.height, side):
        in_row = np.flatnonzero((low[:, 1] < row + side) & (high[:, 1] > row))
        for column in range(0, grid.width, side):
            own = in_row[(low[in_row, 0] < column + side) & (high[in_row, 0] > column)]
            if len(own):
                size = min(side, grid.height - row), min(side, grid.width - column)
                yield _draw_tile(pixels[own], page[own], pages, (row, column), size, rays, base)


def assemble(tiles: Iterable[Tile], grid: Grid) -> NDArray[np.float32]:
    """Return the heights (H, W) of all tiles; NaN in holes."""
    heights = np.full((grid.height, grid.width), np.nan, np.float32)
    for tile in tiles:
        size = tile.heights.shape
        heights[tile.row : tile.row + size[0], tile.column : tile.column + size[1]] = tile.heights
    return heights


def _draw_tile(
    pixels: FloatArray, page: NDArray[np.int32], pages: Sequence[ByteArray], at: tuple[int, int],
    size: tuple[int, int], rays: int, base: float,
) -> Tile:  # fmt: skip
    fine = pixels.copy()
    fine[:, :, X] = rays * (pixels[:, :, X] - at[1])
    fine[:, :, Y] = rays * (pixels[:, :, Y] - at[0])
    height = np.zeros((rays * size[0], rays * size[1]), np.float32)
    face = np.full(height.shape, NOTHING, np.int32)
    draw(fine[:, :, :3].reshape(-1, 3), np.arange(3 * len(fine)).reshape(-1, 3), height, face)
    middle = slice(rays // 2, None, rays)
    heights = np.where(face[middle, middle] == NOTHING, np.nan, height[middle, middle].astype(np.float64) + base)
    colors = np.zeros((*size, 4), np.uint8)
    if pages:
        total = np.zeros((*size, 4))
        for number in np.unique(page):
            _add_colors(pages[number], page == number, fine, face, rays, total)
        colors = _finish(total, rays)
    return Tile(*at, colors, heights.astype(np.float32))


@kernel
def _add_colors(
    page: NDArray[np.uint8], own: BoolArray, corners: FloatArray, face: NDArray[np.int32], rays: int, total: FloatArray
) -> None:
    """Add the texture, and 1 as the weight, of all samples on triangles of a page to their pixels (h, w, 4)."""
    part = np.empty(3)
    height, width = page.shape[0], page.shape[1]
    for i in range(face.shape[0]):
        for j in range(face.shape[1]):
            f = face[i, j]
            if f == NOTHING or not own[f]:
                continue
            corner = corners[f]
            set_shares(corner[:, :2], j + 0.5, i + 0.5, part)
            u = part[0] * corner[0, 3] + part[1] * corner[1, 3] + part[2] * corner[2, 3]
            v = part[0] * corner[0, 4] + part[1] * corner[1, 4] + part[2] * corner[2, 4]
            pixel = total[i // rays, j // rays]
            for channel in range(3):
                pixel[channel] += sample(page, u * width, v * height, channel)
            pixel[3] += 1.0


def _finish(total: FloatArray, rays: int) -> ByteArray:
    """Return the mean colors of the samples on the surface, and the share of these as opacity."""
    weight = total[:, :, 3:]
    colors = np.divide(total[:, :, :3], weight, out=np.zeros_like(total[:, :, :3]), where=weight > 0.0)
    return np.round(np.concatenate([colors, 255.0 * weight / rays**2], axis=2)).astype(np.uint8)
