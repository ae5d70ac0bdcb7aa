"""Charts of a texture, squares of triangles without a photo, and the layout of both on the pages of each block."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import morton_order
from sfm_app.jit import kernel
from sfm_app.settings import TextureSettings
from sfm_app.texture.seams import solve_ties
from sfm_app.texture.sightings import NONE, Facets, IntArray, Sightings, components, span
from sfm_app.texture.views import project
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

# Charts: connected triangles of one photo, laid out by their projection in that photo.
# The photo is the parametrization: nothing is stretched, and a texel is a pixel. Triangles that a photo sees do not
# overlap in it, except at the outlines of occluders; overlapping triangles get charts of their own.

Views = tuple[IndexArray, IndexArray, IntArray, NDArray[np.float32]]
"""The views by triangle, for kernels: starts, rows, photo and score of each row."""

SMALL = 12
"""Charts of fewer triangles take the photo of a neighboring chart, if it shows them."""
CELL = 4
"""Side of a cell of the profiles, in texels."""
MARGIN = 2
"""Width of the margin of a chart, in texels."""
SQUARE = 2
"""Side of the square of a triangle without a photo, in texels; bilinear interpolation inside it is exact."""
SQUARE_CORNERS = np.array([[0.5, 0.5], [1.5, 0.5], [0.5, 1.5]])
"""Corners of a triangle in its square, on the centers of texels."""
SQUARES_ACROSS = 64
"""Most squares along a side of a rectangle of squares."""


@dataclass(frozen=True, slots=True)
class LayoutOptions:
    """Charts, their packing, blocks, and triangles without a photo."""

    most_layers: int = 4
    """Layers of overlapping triangles that are separated; further ones share their pixels."""
    absorb_rounds: int = 3
    fill: float = 0.7
    """Expected share of a page under charts."""
    scale_step: float = 0.95
    """Factor on the scale for the next attempt if the charts do not fit."""
    least_scale: float = 0.05
    """Below this scale the texture would be too coarse; pages are added instead."""
    block_triangles: int = 400_000
    """Most triangles of a block. Chosen by hand: twice the triangles of a mesh by default, so that those have one."""
    previous_color: float = 1e-4
    """Weight of the previous color of a vertex without a photo, relative to 1 per neighbor, for isolated parts."""
    rounding: float = 5e-3
    """Rounding of a corner, in texels: single precision on the largest page gives a thousandth. Chosen by hand."""


OPTIONS = LayoutOptions()


@dataclass(frozen=True, slots=True, eq=False)
class Charts:
    """The chart of each triangle, and its position in the chart's photo."""

    chart_of_face: IntArray
    """(T,) chart of each triangle, -1 for none."""
    photo: IntArray
    """(C,) photo of each chart."""
    corners: FloatArray
    """(T, 3, 2) corners in the photo, in pixels."""


def make_charts(chosen: IntArray, cameras: FloatArray, mesh: Facets, tile_px: float, block_of: IntArray) -> Charts:
    """Build charts from the photo of each triangle (T,), -1 for none, and the camera rows (P, 26).

    Charts are cut at multiples of `tile_px` in the photo, so that each fits on a page, and between blocks (T,).
    """
    corners = np.zeros((len(mesh.faces), 3, 2))
    _project_corners(chosen, cameras, mesh.vertices, mesh.faces, corners)
    tiles = np.floor(corners.mean(axis=1) / tile_px).astype(np.int64)
    group = np.where(chosen == NONE, NONE, (chosen * 4096 + tiles[:, 1]) * 4096 + tiles[:, 0])
    group = np.where(chosen == NONE, NONE, group + (block_of.astype(np.int64) << 44))  # layers have bits 40 to 43
    of, count = components(group, mesh.neighbors)
    for layer in range(1, OPTIONS.most_layers):
        folded = folds(of, count, corners)
        if not folded.any():
            break
        group[folded] += layer << 40
        of, count = components(group, mesh.neighbors)
    photo = np.full(count, NONE, np.int32)
    photo[of[of != NONE]] = chosen[of != NONE]
    return Charts(of, photo, corners)


def folds(of: IntArray, count: int, corners: FloatArray) -> BoolArray:
    """Mark triangles (T,) that overlap others of the same of `count` charts; `of` is the chart of each triangle."""
    order = np.argsort(of, kind="stable")[np.count_nonzero(of == NONE) :]
    starts = np.concatenate([[0], np.cumsum(np.bincount(of[order], minlength=count))])
    folded = np.zeros(len(of), np.bool_)
    _find_folds(order, starts, corners, folded)
    return folded


@kernel
def _find_folds(order: IndexArray, starts: IndexArray, corners: FloatArray, folded: BoolArray) -> None:
    """Draw each chart pixel by pixel; a triangle that reaches an occupied pixel is folded."""
    for c in range(len(starts) - 1):
        left = top = np.inf
        right = bottom = -np.inf
        for f in order[starts[c] : starts[c + 1]]:
            for k in range(3):
                left, right = min(left, corners[f, k, 0]), max(right, corners[f, k, 0])
                top, bottom = min(top, corners[f, k, 1]), max(bottom, corners[f, k, 1])
        width, height = int(right - left) + 2, int(bottom - top) + 2
        taken = np.zeros((height, width), np.bool_)
        for f in order[starts[c] : starts[c + 1]]:
            ax, ay = corners[f, 0, 0] - left, corners[f, 0, 1] - top
            bx, by = corners[f, 1, 0] - left, corners[f, 1, 1] - top
            cx, cy = corners[f, 2, 0] - left, corners[f, 2, 1] - top
            turn = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
            if turn == 0.0:
                continue
            for y in range(int(min(ay, by, cy)), int(max(ay, by, cy)) + 1):
                for x in range(int(min(ax, bx, cx)), int(max(ax, bx, cx)) + 1):
                    # strictly inside: neighbors share the pixels on their common edge
                    u = ((x - ax) * (cy - ay) - (y - ay) * (cx - ax)) / turn
                    v = ((bx - ax) * (y - ay) - (by - ay) * (x - ax)) / turn
                    if min(u, v, 1.0 - u - v) > 1e-6:
                        folded[f] = folded[f] or taken[y, x]
                        taken[y, x] = True


def absorb_small_charts(chosen: IntArray, sightings: Sightings, neighbors: IntArray) -> IntArray:
    """Give small charts the photo of a neighboring chart with usable views of all their triangles."""
    chosen = chosen.copy()
    views = sightings.face_starts, sightings.face_rows, sightings.photo, sightings.score
    for _ in range(OPTIONS.absorb_rounds):
        of, count = components(chosen.astype(np.int64), neighbors)
        sizes = np.bincount(of[of != NONE], minlength=count)
        order = np.argsort(of, kind="stable").astype(np.int32)
        starts = np.concatenate([[0], np.cumsum(sizes)]) + int(np.count_nonzero(of == NONE))
        if not _absorb(sizes, starts, order, views, neighbors, chosen):
            break
    return chosen


@kernel
def _project_corners(
    chosen: IntArray, cameras: FloatArray, vertices: FloatArray, faces: IndexArray, corners: FloatArray
) -> None:
    for f in range(len(faces)):
        if chosen[f] == NONE:
            continue
        for k in range(3):
            i = faces[f, k]
            u, v, _ = project(cameras[chosen[f]], vertices[i, 0], vertices[i, 1], vertices[i, 2])
            corners[f, k, 0], corners[f, k, 1] = u, v


@kernel
def _absorb(
    sizes: IndexArray, starts: IndexArray, order: IntArray, views: Views, neighbors: IntArray, chosen: IntArray
) -> int:
    """Give small components the neighboring photo with the longest common border; return how many changed."""
    absorbed = 0
    beside = np.empty(3 * SMALL, np.int64)
    for c in range(len(sizes)):
        if sizes[c] >= SMALL:
            continue
        faces = order[starts[c] : starts[c + 1]]
        count = _list_border_photos(faces, neighbors, chosen, beside)
        best, longest = NONE, 0
        for k in range(count):
            p, border = beside[k], 0
            for j in range(count):
                border += beside[j] == p
            if border < longest or (border == longest and p >= best):
                continue
            if _is_usable(views, p, faces):
                best, longest = p, border
        if best != NONE:
            for f in faces:
                chosen[f] = best
            absorbed += 1
    return absorbed


@kernel
def _list_border_photos(faces: IntArray, neighbors: IntArray, chosen: IntArray, beside: IndexArray) -> int:
    """Write the other photo across each border edge of triangles of one photo; return their number."""
    count, own = 0, chosen[faces[0]]
    for f in faces:
        for k in range(3):
            g = neighbors[f, k]
            if g != NONE and chosen[g] != NONE and chosen[g] != own:
                beside[count] = chosen[g]
                count += 1
    return count


@kernel
def _is_usable(views: Views, photo: int, faces: IntArray) -> bool:
    starts, rows, photos, score = views
    for f in faces:
        usable = False
        for row in rows[starts[f] : starts[f + 1]]:
            if photos[row] == photo:
                usable = bool(score[row] > 0)
                break
        if not usable:
            return False
    return True


# Triangles without a photo: their vertices get colors from the photos around, and each triangle a square of texels.
# The squares of a block form rectangles, which are packed with the charts.


def vertex_colors(mesh: Facets, painted: BoolArray, corner_colors: FloatArray) -> FloatArray:
    """Compute colors (V, 3) in 0..255, diffused from painted triangles and their corners (S, 3, 3) to the others."""
    faces, size = mesh.faces[painted], len(mesh.vertices)
    count = np.bincount(faces.ravel(), minlength=size)
    sums = [np.bincount(faces.ravel(), corner_colors[..., channel].ravel(), size) for channel in range(3)]
    known = count > 0
    colors = mesh.surface.colors.astype(np.float64)
    colors[known] = np.stack(sums, axis=1)[known] / count[known, None]
    free = np.full(size, -1, np.int64)
    free[~known] = np.arange(size - known.sum())
    if known.all() or not known.any():
        return colors
    ends = free[mesh.edges]
    inner = (ends >= 0).all(axis=1)
    border = (ends >= 0).any(axis=1) & ~inner
    outside = np.where(ends[border, 0] < 0, mesh.edges[border, 0], mesh.edges[border, 1])
    inside = ends[border].max(axis=1)
    hold = np.asarray(OPTIONS.previous_color + np.bincount(inside, minlength=int((~known).sum())), np.float64)
    right = OPTIONS.previous_color * colors[~known]
    for channel in range(3):
        right[:, channel] += np.bincount(inside, colors[outside, channel], len(right))
    spread = solve_ties(ends[inner, 0], ends[inner, 1], np.ones(int(inner.sum())), hold, right)
    colors[~known] = np.clip(spread, 0, 255)
    return colors


def rectangle_sizes(triangles: int) -> NDArray[np.int32]:
    """Return (B, 2) widths and heights in texels of rectangles with one square per triangle."""
    sizes = []
    for start in range(0, triangles, SQUARES_ACROSS * SQUARES_ACROSS):
        count = min(triangles - start, SQUARES_ACROSS * SQUARES_ACROSS)
        columns = min(SQUARES_ACROSS, int(np.ceil(np.sqrt(count))))
        sizes.append((columns * SQUARE, -(-count // columns) * SQUARE))
    return np.array(sizes, np.int32).reshape(-1, 2)


def squares(places: NDArray[np.int32], sizes: NDArray[np.int32], triangles: int) -> IndexArray:
    """Return (N, 3) page, x and y of the square of each triangle, row by row in rectangles at (B, 3) page, x, y."""
    parts = [np.empty((0, 3), np.int64)]
    for number, ((page, left, top), (width, _)) in enumerate(zip(places, sizes, strict=True)):
        count = min(triangles - number * SQUARES_ACROSS * SQUARES_ACROSS, SQUARES_ACROSS * SQUARES_ACROSS)
        row, column = np.divmod(np.arange(count), width // SQUARE)
        parts.append(np.column_stack([np.full(count, page), left + SQUARE * column, top + SQUARE * row]))
    return np.concatenate(parts).astype(np.int64)


def are_squares(corners: FloatArray) -> BoolArray:
    """Mark triangles (T,) with the corners (T, 3, 2) of a square, in texels of single precision."""
    first = np.floor(corners[:, :1])
    return np.asarray((np.abs(corners - first - SQUARE_CORNERS) < OPTIONS.rounding).all(axis=(1, 2)))


def square_texels(corner_colors: FloatArray) -> NDArray[np.uint8]:
    """Return (N, 2, 2, 3) texels whose bilinear interpolation gives colors (N, 3, 3) at `SQUARE_CORNERS`."""
    a, b, c = (corner_colors[:, k] for k in range(3))
    texels = np.stack([np.stack([a, b], axis=1), np.stack([c, b + c - a], axis=1)], axis=1)
    return np.asarray(np.round(np.clip(texels, 0, 255)), np.uint8)


# Packing of charts onto pages, as in Tetris (Levy et al., SIGGRAPH 2002, section 4).
# Each chart has a profile of its upper and lower side. It is placed on the horizon of the charts already on the
# page, as close to the top as possible. Tall charts come first.


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """The positions of the charts on the pages."""

    page: IntArray
    """(C,) page of each chart."""
    shift: IntArray
    """(C, 2) offset in texels from the photo's pixels (times `scale`) to the page."""
    scale: float
    """Texels per pixel of the photos, <= 1."""
    sizes: tuple[tuple[int, int], ...]
    """(width, height) of each page."""


def pack(
    charts: Charts, rectangles: IntArray, max_atlas_px: int, max_pages: int, largest_scale: float = 1.0
) -> tuple[Layout, IntArray]:
    """Place charts, in pixels of the photos, and rectangles (B, 2) in texels, which are never scaled, on few pages.

    Charts that do not fit are reduced in scale, to the least one; then more pages are used. Return the layout of the
    charts, and (B, 3) page, x and y of the rectangles.
    """
    a, b, c = (charts.corners[:, k] for k in range(3))
    turn = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    area = float(np.sum(np.abs(turn[charts.chart_of_face != NONE])) / 2)
    scale = min(largest_scale, float(np.sqrt(OPTIONS.fill * max_pages * max_atlas_px**2 / max(area, 1.0))))
    while True:
        packed = _try_to_pack(charts, rectangles, scale, max_atlas_px, max_pages)
        if packed is not None:
            return packed
        if scale > OPTIONS.least_scale:
            scale *= OPTIONS.scale_step
        else:  # many small charts: their margins fill the pages
            max_pages += 1


def _try_to_pack(
    charts: Charts, rectangles: IntArray, scale: float, max_atlas_px: int, max_pages: int
) -> tuple[Layout, IntArray] | None:
    count = len(charts.photo)
    origin, cells, starts, low, high = _profiles(charts, scale)
    rectangle_cells = -(-rectangles // CELL)
    area = float(np.sum(high - low)) + float(np.sum(rectangle_cells.astype(np.int64).prod(axis=1)))
    widest = max((int(c) for c in np.concatenate([cells[:, 0], rectangle_cells[:, 0]])), default=1)
    page_cells = max_atlas_px // CELL
    width = page_cells if scale < 1.0 else min(page_cells, max(widest, int(np.ceil(np.sqrt(area / OPTIONS.fill)))))
    if widest > page_cells or area > max_pages * page_cells * width:
        return None
    starts = np.concatenate([starts, starts[-1] + np.cumsum(rectangle_cells[:, 0])])
    low = np.concatenate([low, np.zeros(int(rectangle_cells[:, 0].sum()), np.int64)])
    high = np.concatenate([high, np.repeat(rectangle_cells[:, 1], rectangle_cells[:, 0]).astype(np.int64)])
    heights = np.concatenate([cells[:, 1], rectangle_cells[:, 1]]).astype(np.int64)
    order = np.lexsort((np.arange(len(heights)), -heights))
    place = np.full((len(heights), 3), NONE, np.int32)
    horizon = np.zeros((max_pages, width), np.int64)
    if not _set_down(order, starts, low, high, page_cells, horizon, place):
        return None
    used = int(place[:, 0].max(initial=-1)) + 1
    sizes = tuple((width * CELL, int(horizon[page].max()) * CELL) for page in range(used))
    shift = CELL * place[:count, 1:] - origin
    return Layout(place[:count, 0], shift.astype(np.int32), scale, sizes), place[count:] * np.array([1, CELL, CELL])


def _profiles(charts: Charts, scale: float) -> tuple[IntArray, IntArray, IndexArray, IndexArray, IndexArray]:
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
def _outline(of: IntArray, corners: FloatArray, starts: IndexArray, low: IndexArray, high: IndexArray) -> None:
    """Widen the profiles of the charts to contain each triangle and its margin, column by column."""
    for f in range(len(of)):
        first, columns = starts[of[f]], starts[of[f] + 1] - starts[of[f]]
        left = min(corners[f, 0, 0], corners[f, 1, 0], corners[f, 2, 0]) - MARGIN
        right = max(corners[f, 0, 0], corners[f, 1, 0], corners[f, 2, 0]) + MARGIN
        for column in range(max(int(left // CELL), 0), min(int(right // CELL) + 1, columns)):
            top, bottom = span(corners[f], 1, column * CELL - MARGIN, (column + 1) * CELL + MARGIN)
            if top <= bottom:
                low[first + column] = min(low[first + column], int((top - MARGIN) // CELL))
                high[first + column] = max(high[first + column], int((bottom + MARGIN) // CELL) + 1)


@kernel
def _set_down(
    order: IndexArray,
    starts: IndexArray,
    low: IndexArray,
    high: IndexArray,
    page_height: int,
    horizon: IndexArray,
    place: IntArray,
) -> bool:
    """Place every chart; return False if one does not fit on any page."""
    for c in order:
        first, columns = starts[c], starts[c + 1] - starts[c]
        deepest = 0
        for j in range(columns):
            deepest = max(deepest, high[first + j])
        own_low, own_high = low[first : first + columns], high[first : first + columns]
        for page in range(len(horizon)):
            best_x, best_y = _find_place(own_low, own_high, horizon[page], page_height - deepest + 1)
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


@kernel
def _find_place(low: IndexArray, high: IndexArray, horizon: IndexArray, limit: int) -> tuple[int, int]:
    """Return the leftmost of the highest places above `limit` for a profile on a page; x is -1 if none exists."""
    best_x, best_y = -1, limit
    for x in range(len(horizon) - len(low) + 1):
        y = 0
        for j in range(len(low)):
            if high[j] > low[j]:
                y = max(y, horizon[x + j] - low[j])
                if y >= best_y:
                    break
        if y < best_y:
            best_x, best_y = x, y
    return best_x, best_y


def block_of_faces(mesh: Facets) -> IntArray:
    """Return the block of each triangle, (T,): equal parts along the Morton curve, painted one after the other."""
    count = len(mesh.faces)
    blocks = max(1, -(-count // OPTIONS.block_triangles))
    block_of = np.empty(count, np.int32)
    block_of[mesh.clusters.order] = np.arange(count) * blocks // max(count, 1)
    return block_of


def lay_out(
    charts: Charts, block_of: IntArray, mesh: Facets, options: TextureSettings
) -> tuple[Layout, IndexArray, IntArray]:
    """Give every block (T,) its own pages, for its charts and the squares of triangles without a chart.

    Return the layout; (U, 3) page, x and y of the squares; and (P,) block of each page.
    """
    unseen = np.flatnonzero(charts.chart_of_face == NONE)
    faces = [np.flatnonzero(block_of == block) for block in range(int(block_of.max(initial=0)) + 1)]
    parts = [_part(charts, own) for own in faces]
    rests = [rectangle_sizes(int((part.chart_of_face == NONE).sum())) for _, part in parts]
    packed = [
        pack(part, rest, options.max_atlas_px, options.max_pages) for (_, part), rest in zip(parts, rests, strict=True)
    ]
    scale = min(layout.scale for layout, _ in packed)
    page, shift = np.full(len(charts.photo), NONE, np.int32), np.zeros((len(charts.photo), 2), np.int32)
    cells, sizes, owners = np.empty((len(unseen), 3), np.int64), list[tuple[int, int]](), list[int]()
    for block, ((numbers, part), rest, own_packing) in enumerate(zip(parts, rests, packed, strict=True)):
        is_common = own_packing[0].scale == scale
        layout, places = own_packing if is_common else pack(part, rest, options.max_atlas_px, options.max_pages, scale)
        page[numbers], shift[numbers] = layout.page + len(sizes), layout.shift
        own = np.flatnonzero(block_of[unseen] == block)
        order = morton_order(mesh.vertices[mesh.faces[unseen[own]]].mean(axis=1))
        cells[own[order]] = squares(places + np.array([len(sizes), 0, 0]), rest, len(own))
        sizes += layout.sizes
        owners += [block] * len(layout.sizes)
    return Layout(page, shift, scale, tuple(sizes)), cells, np.array(owners, np.int32)


def _part(charts: Charts, faces: IndexArray) -> tuple[IndexArray, Charts]:
    """Return the numbers of the charts of a block, and these charts with the triangles of the block."""
    of = charts.chart_of_face[faces]
    numbers = np.unique(of[of != NONE])
    own = np.where(of == NONE, NONE, np.searchsorted(numbers, of)).astype(np.int32)
    return numbers, replace(charts, chart_of_face=own, photo=charts.photo[numbers], corners=charts.corners[faces])
