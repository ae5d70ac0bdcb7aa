"""Charts: connected triangles of one photo, laid out by their projection in that photo.

The photo is the parametrization: nothing is stretched, and a texel is a pixel. Triangles that a photo sees do not
overlap in it, except at the rims of occluders; overlapping triangles get charts of their own.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.texture.appearance.sightings import Sightings
from sfm_app.texture.facets import NONE, Facets, IntArray, components
from sfm_app.texture.views import project

FloatArray = NDArray[np.float64]
Views = tuple[NDArray[np.int64], NDArray[np.int64], IntArray, NDArray[np.float32]]
"""The views by triangle, for kernels: starts, rows, photo and worth of each row."""

MOST_LAYERS = 4
"""Layers of overlapping triangles that are separated; further ones share their pixels."""
SMALL = 12
"""Charts of fewer triangles take the photo of a neighboring chart, if it sees them."""
ROUNDS = 3
LAYER_BITS, BLOCK_BITS = 40, 44
"""Bits of a group's number above which the layer and the block are counted. By definition."""
EDGE = 1e-6
"""Points with a smaller barycentric coordinate count as on the edge."""


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
    """Build charts from one photo per triangle.

    Args:
        chosen: (T,) photo of each triangle, -1 for none.
        cameras: (P, 26) from `PhotoView.row`.
        mesh: the surface.
        tile_px: charts are cut at multiples of this in the photo, so that each fits on a page.
        block_of: (T,) block of each triangle; no chart lies in two.
    """
    corners = np.zeros((len(mesh.faces), 3, 2))
    _project_corners(chosen, cameras, mesh.vertices, mesh.faces, corners)
    tiles = np.floor(corners.mean(axis=1) / tile_px).astype(np.int64)
    group = np.where(chosen == NONE, NONE, (chosen * 4096 + tiles[:, 1]) * 4096 + tiles[:, 0])
    group = np.where(chosen == NONE, NONE, group + (block_of.astype(np.int64) << BLOCK_BITS))
    of, count = components(group, mesh.neighbors)
    for layer in range(1, MOST_LAYERS):
        folded = folds(of, count, corners)
        if not folded.any():
            break
        group[folded] += layer << LAYER_BITS
        of, count = components(group, mesh.neighbors)
    photo = np.full(count, NONE, np.int32)
    photo[of[of != NONE]] = chosen[of != NONE]
    return Charts(of, photo, corners)


def folds(of: IntArray, count: int, corners: FloatArray) -> NDArray[np.bool_]:
    """Mark triangles that overlap others of the same chart, (T,).

    Args:
        of: (T,) chart of each triangle, -1 for none.
        count: number of charts.
        corners: (T, 3, 2) pixels.
    """
    order = np.argsort(of, kind="stable")[np.count_nonzero(of == NONE) :]
    starts = np.concatenate([[0], np.cumsum(np.bincount(of[order], minlength=count))])
    folded = np.zeros(len(of), np.bool_)
    _find_folds(order, starts, corners, folded)
    return folded


@kernel
def _find_folds(
    order: NDArray[np.int64], starts: NDArray[np.int64], corners: FloatArray, folded: NDArray[np.bool_]
) -> None:
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
                    if min(u, v, 1.0 - u - v) > EDGE:
                        folded[f] = folded[f] or taken[y, x]
                        taken[y, x] = True


def absorb_small_charts(chosen: IntArray, seen: Sightings, neighbors: IntArray) -> IntArray:
    """Give small charts the photo of a neighboring chart that may be used for all their triangles.

    Args:
        chosen: (T,) photo of each triangle, -1 for none.
        seen: which photos see which triangles; not used where the worth is negative.
        neighbors: (T, 3) triangle across each edge, -1 for none.
    """
    chosen = chosen.copy()
    views = seen.face_starts, seen.face_rows, seen.photo, seen.worth
    for _ in range(ROUNDS):
        of, count = components(chosen.astype(np.int64), neighbors)
        sizes = np.bincount(of[of != NONE], minlength=count)
        order = np.argsort(of, kind="stable").astype(np.int32)
        starts = np.concatenate([[0], np.cumsum(sizes)]) + int(np.count_nonzero(of == NONE))
        if not _absorb(sizes, starts, order, views, neighbors, chosen):
            break
    return chosen


@kernel
def _project_corners(
    chosen: IntArray, cameras: FloatArray, vertices: FloatArray, faces: NDArray[np.int64], corners: FloatArray
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
    sizes: NDArray[np.int64],
    starts: NDArray[np.int64],
    order: IntArray,
    views: Views,
    neighbors: IntArray,
    chosen: IntArray,
) -> int:
    """Give small components the neighboring photo with the longest common border; return how many changed."""
    absorbed = 0
    around = np.empty(3 * SMALL, np.int64)
    for c in range(len(sizes)):
        if sizes[c] >= SMALL:
            continue
        count = 0
        own = chosen[order[starts[c]]]
        for at in range(starts[c], starts[c + 1]):
            for k in range(3):
                g = neighbors[order[at], k]
                if g != NONE and chosen[g] != NONE and chosen[g] != own:
                    around[count] = chosen[g]
                    count += 1
        best, longest = NONE, 0
        for k in range(count):
            p, border = around[k], 0
            for j in range(count):
                border += around[j] == p
            if border < longest or (border == longest and p >= best):
                continue
            possible = True
            for at in range(starts[c], starts[c + 1]):
                possible = possible and _is_usable(views, p, order[at])
            if possible:
                best, longest = p, border
        if best != NONE:
            for at in range(starts[c], starts[c + 1]):
                chosen[order[at]] = best
            absorbed += 1
    return absorbed


@kernel
def _is_usable(views: Views, photo: int, face: int) -> bool:
    """Return whether a photo sees a triangle and shows the surface there."""
    starts, rows, photos, worth = views
    for row in rows[starts[face] : starts[face + 1]]:
        if photos[row] == photo:
            return bool(worth[row] > 0)
    return False
