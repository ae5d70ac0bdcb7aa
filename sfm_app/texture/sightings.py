"""Triangles of a surface with their neighbors, and sightings: the triangles in each photo, with score and color."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.raster import NOTHING, draw
from sfm_app.geometry.triangles import Clusters, bucket_order, cluster, number_vertices, unique_edges
from sfm_app.jit import kernel
from sfm_app.texture.views import POSE, PhotoView, project, sample
from sfm_app.types import Surface
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

IntArray = NDArray[np.int32]

NONE = -1


@dataclass(frozen=True, slots=True, eq=False)
class Facets:
    """A surface with the tables of texturing."""

    surface: Surface
    neighbors: IntArray
    """(T, 3) triangle across edge k, from corner k to corner k + 1; -1 at borders and where more than two meet."""
    edges: IndexArray
    """(E, 2) vertices of every edge, each once, smaller first."""
    spacing: float
    """Median length of an edge."""
    clusters: Clusters
    fan_starts: IndexArray
    """(V + 1,) The triangles at vertex v are fans[fan_starts[v]] to fans[fan_starts[v + 1] - 1]."""
    fans: IndexArray
    """(3 T,)"""

    @property
    def vertices(self) -> FloatArray:
        """(V, 3)."""
        return self.surface.vertices

    @property
    def faces(self) -> IndexArray:
        """(T, 3) vertex indices."""
        return self.surface.faces

    @property
    def valence(self) -> IndexArray:
        """(V,) number of triangles at each vertex."""
        return np.asarray(np.diff(self.fan_starts))

    def faces_at(self, vertices: IndexArray) -> IndexArray:
        """Return (M,) the triangles at vertices (N,), each once, ascending."""
        triangles = self.fans[ranges(self.fan_starts[vertices], self.fan_starts[vertices + 1])]
        return distinct(triangles, len(self.faces))

    def edges_among(self, vertices: IndexArray) -> IndexArray:
        """Return (M,) the edges between ascending vertices (N,), ascending."""
        first, end = (np.searchsorted(self.edges[:, 0], vertices, side) for side in ("left", "right"))
        edges = ranges(first, end)
        other = self.edges[edges, 1]
        at = np.minimum(np.searchsorted(vertices, other), max(len(vertices) - 1, 0))
        return np.asarray(edges[vertices[at] == other]) if len(edges) else edges


def facets(surface: Surface) -> Facets:
    """Build the tables of neighbors and edges."""
    edges, edge_of = unique_edges(surface.faces)
    sides, edge_of = np.arange(edge_of.size), edge_of.ravel()
    # the two sides of an edge add up to the sum of their numbers
    both = np.bincount(edge_of, sides, len(edges))[edge_of].astype(np.int64)
    inner = np.bincount(edge_of, minlength=len(edges))[edge_of] == 2
    neighbors = np.where(inner, (both - sides) // 3, NONE).astype(np.int32)
    lengths = np.linalg.norm(surface.vertices[edges[:, 0]] - surface.vertices[edges[:, 1]], axis=1)
    spacing = float(np.median(lengths)) if len(lengths) else 0.0
    corners, count = surface.faces.ravel(), len(surface.vertices)
    fans = bucket_order(corners, count) // 3
    fan_starts = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=count))])
    near = cluster(surface.vertices[surface.faces])
    return Facets(surface, neighbors.reshape(-1, 3), edges, spacing, near, fan_starts.astype(np.int64), fans)


def distinct(numbers: IndexArray, size: int) -> IndexArray:
    """Return (M,) distinct values of numbers (N,) in [0, size), ascending."""
    if 64 * len(numbers) < size:  # sorting few numbers is faster than marking them
        return np.unique(numbers)
    is_present = np.zeros(size, np.bool_)
    is_present[numbers] = True
    return np.flatnonzero(is_present)


def ranges(starts: IndexArray, ends: IndexArray) -> IndexArray:
    """Return (M,) the concatenated ranges from each start (N,) to its end (N,), exclusive."""
    counts = ends - starts
    total = np.cumsum(counts)
    return np.asarray(np.arange(total[-1] if len(total) else 0) + np.repeat(starts - total + counts, counts))


def components(group: IndexArray, neighbors: IntArray) -> tuple[IntArray, int]:
    """Find connected triangles of equal group (T,): component (T,), -1 where the group is -1, and their number."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    of, size, shown = np.full(len(group), NONE, np.int32), len(group), group != NONE
    face, side = np.nonzero((neighbors != NONE) & (group[neighbors] == group[:, None]) & shown[:, None])
    ties = coo_array((np.ones(len(face), bool), (face, neighbors[face, side])), (size, size))
    parts, of[shown] = np.unique(connected_components(ties, directed=False)[1][shown], return_inverse=True)
    return of, len(parts)


MIN_COSINE = 0.1
"""Smallest cosine of the viewing angle; from more oblique views, few pixels would be stretched over the triangle."""
BORDER_PX = 2.0
"""Width of the unused border of a photo, where resampling and demosaicing are incomplete."""
JUMP = 0.01
"""Relative depth difference of adjacent pixels at an outline. Chosen by hand: a plane has it where it is seen at 2
degrees in a photo of 3 000 pixels."""
RIM, RIM_FACTOR = 0.002, 0.25
"""Distance from an outline in rows and columns, in longer sides of the photo: two pixels of a depth map; and the
factor on the score of triangles within it: where the surface is off, the photo shows the foreground or background."""
MASK_MARGIN_PX = 1.0
"""A triangle this close to a masked pixel is not used, because colors are interpolated between pixels."""


@dataclass(frozen=True, slots=True)
class SightingOptions:
    """Occlusion, and factors on the scores."""

    slack: float = 1.0
    """Slack of the occlusion test, in median edge lengths, so that the surface's roughness hides nothing."""
    sharpness_range: tuple[float, float] = (0.2, 1.0)
    """Smallest and largest factor on the scores of a photo."""


OPTIONS = SightingOptions()


@dataclass(frozen=True, slots=True, eq=False)
class FaceView:
    """One photo's view of its visible triangles."""

    face: IntArray
    """(M,) the triangles, ascending."""
    score: NDArray[np.float32]
    """(M,) pixels times cosine of the viewing angle, > 0."""
    color: NDArray[np.uint8]
    """(M, 3) mean RGB."""
    sharpness: float
    """Energy of the finest detail relative to that at half size; decreases with blur, hardly depends on content."""


def score_faces(view: PhotoView, photo: NDArray[np.uint8], used: BoolArray | None, mesh: Facets) -> FaceView:
    """Score the triangles in a photo (height, width, 3) of the view's size; `used` masks its usable pixels."""
    sharp = sharpness(photo, used)  # before the depth buffer: both need as much memory
    near = mesh.clusters.find_in_cone(view.center, view.axis, view.widest_angle)
    faces = mesh.faces[near]
    nearness, shown_px = _draw(view, mesh.vertices, faces)
    jumps, side = np.zeros(nearness.shape, np.uint8), 2 * round(RIM * max(nearness.shape)) + 1
    _mark_jumps(nearness, jumps)
    seen = photo, nearness, shown_px, cv2.dilate(jumps, np.ones((side, side), np.uint8))
    score, color = np.zeros(len(near), np.float32), np.zeros((len(near), 3), np.uint8)
    _measure(view.row, seen, mesh.vertices, faces, OPTIONS.slack * mesh.spacing, score, color)
    if used is not None:
        masked = np.zeros((view.height + 1, view.width + 1), np.int32)
        np.cumsum(np.cumsum(~used, axis=0, dtype=np.int32), axis=1, out=masked[1:, 1:])
        _drop_masked(view.row, masked, mesh.vertices, faces, score)
    usable = score > 0
    return FaceView(near[usable].astype(np.int32), score[usable], color[usable], sharp)


def _draw(view: PhotoView, vertices: FloatArray, faces: IndexArray) -> tuple[NDArray[np.float32], IndexArray]:
    """Draw triangles (T, 3) into a photo: (H, W) 1 / depth, 0 without surface; (T,) pixels that show each triangle."""
    used, own = number_vertices(faces)
    pixels, size = np.empty((len(used), 3)), (view.height, view.width)
    _project_all(view.row, vertices[used], pixels)
    nearness, face = np.zeros(size, np.float32), np.full(size, NOTHING, np.int32)
    draw(pixels, own, nearness, face)
    shown_px = np.zeros(len(faces), np.int64)
    _count(face, shown_px)
    return nearness, shown_px


@kernel
def _count(face: IntArray, shown_px: IndexArray) -> None:
    """Count the pixels (H, W) of each triangle, without the copies that `np.bincount` makes of a large photo."""
    for row in face:
        for f in row:
            if f != NOTHING:
                shown_px[f] += 1


@kernel
def _project_all(camera: FloatArray, vertices: FloatArray, pixels: FloatArray) -> None:
    """Write pixels x, y and 1 / depth (V, 3) of vertices; the last is -1 of invisible ones."""
    for v in range(len(vertices)):
        pixels[v, 0], pixels[v, 1], depth = project(camera, vertices[v, 0], vertices[v, 1], vertices[v, 2])
        pixels[v, 2] = 1.0 / depth if depth > 0.0 else -1.0


@kernel
def _mark_jumps(nearness: NDArray[np.float32], jumps: NDArray[np.uint8]) -> None:
    """Mark the pixels on both sides of each jump of the depth."""
    height, width = nearness.shape
    for y in range(height):
        for x in range(width):
            for i, j in ((y + 1, x), (y, x + 1)):
                if i < height and j < width:
                    one, other = nearness[y, x], nearness[i, j]
                    if abs(one - other) > JUMP * max(one, other):
                        jumps[y, x] = jumps[i, j] = 1


@kernel
def _is_hidden(nearness: NDArray[np.float32], x: float, y: float, depth: float, slack: float) -> bool:
    """Return whether all four pixels around a place show something nearer than its depth less a slack."""
    height, width = nearness.shape
    left, top = min(max(int(x - 0.5), 0), width - 1), min(max(int(y - 0.5), 0), height - 1)
    right, below = min(left + 1, width - 1), min(top + 1, height - 1)
    least = min(nearness[top, left], nearness[top, right], nearness[below, left], nearness[below, right])
    return bool(least * (depth - slack) > 1.0)


def sharpness(photo: NDArray[np.uint8], used: BoolArray | None = None) -> float:
    """Return the ratio of Laplacian energies of a photo (H, W, 3) at full and at half size, >= 0, over used pixels."""
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    half = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    fine, coarse = (_energy(part, used) for part in (gray, half))
    return fine / coarse if coarse > 0 else 0.0


def _energy(gray: NDArray[np.uint8], used: BoolArray | None) -> float:
    energy = np.square(cv2.Laplacian(gray, cv2.CV_32F))
    if used is None:
        return float(np.mean(energy))
    size = gray.shape[1], gray.shape[0]
    whole = (cv2.resize(used.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.999).astype(np.uint8)
    counted = energy[cv2.erode(whole, np.ones((3, 3), np.uint8)) > 0]  # the Laplacian reads the pixels around
    return float(np.mean(counted)) if counted.size else 0.0


def sharpness_factors(sharpness: FloatArray) -> FloatArray:
    """Return (P,) factors on the scores of each photo, 1 for the median sharpness."""
    median = float(np.median(sharpness)) if len(sharpness) else 0.0
    relative = sharpness / median if median > 0 else np.ones(len(sharpness))
    return np.asarray(np.clip(relative, *OPTIONS.sharpness_range), np.float64)


@kernel
def _measure(
    camera: FloatArray,
    seen: Any,
    vertices: FloatArray,
    faces: IndexArray,
    slack: float,
    score: NDArray[np.float32],
    color: NDArray[np.uint8],
) -> None:
    """Write area in pixels times cosine, and mean color, of triangles within the photo that face the camera.

    `seen` are the photo, the results of `_draw`, and the pixels beside outlines. Triangles hidden at the center or at
    two corners are left out, and those hidden by more than half a pixel along their sides: the surface is inexact.
    """
    photo, nearness, shown_px, rim = seen
    height, width = photo.shape[0], photo.shape[1]
    x, y, corner = np.empty(4), np.empty(4), np.empty((4, 3))
    for f in range(len(faces)):
        for axis in range(3):
            corner[3, axis] = 0.0
            for k in range(3):
                corner[k, axis] = vertices[faces[f, k], axis]
                corner[3, axis] += corner[k, axis] / 3.0
        inside, hidden, beside = True, 0, False
        for k in range(4):
            x[k], y[k], depth = project(camera, corner[k, 0], corner[k, 1], corner[k, 2])
            inside = inside and depth > 0.0 and BORDER_PX <= x[k] <= width - BORDER_PX
            inside = inside and BORDER_PX <= y[k] <= height - BORDER_PX
            if not inside:
                break
            beside = beside or rim[int(y[k]), int(x[k])] > 0
            if _is_hidden(nearness, x[k], y[k], depth, slack):
                hidden += 2 if k == 3 else 1
        if not inside or hidden > 1:
            continue
        cosine = _cosine(camera, corner)
        # y points down in the photo: triangles counterclockwise from outside have a negative area
        area = -0.5 * ((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]))
        sides = (
            np.hypot(x[1] - x[0], y[1] - y[0]) + np.hypot(x[2] - x[1], y[2] - y[1]) + np.hypot(x[0] - x[2], y[0] - y[2])
        )
        if cosine < MIN_COSINE or area <= 0.0 or area - shown_px[f] > 0.5 * sides:
            continue
        score[f] = area * cosine * (RIM_FACTOR if beside else 1.0)
        for channel in range(3):
            total = 0.0
            for k in range(4):
                total += sample(photo, x[k], y[k], channel)
            color[f, channel] = int(total / 4.0 + 0.5)


@kernel
def _drop_masked(
    camera: FloatArray, masked: NDArray[np.int32], vertices: FloatArray, faces: IndexArray, score: NDArray[np.float32]
) -> None:
    """Set the score of triangles with a masked pixel to 0; `masked` is the integral image (height + 1, width + 1)."""
    corner = np.empty((3, 2))
    for f in range(len(faces)):
        if score[f] <= 0.0:
            continue
        for k in range(3):
            v = faces[f, k]
            corner[k, 0], corner[k, 1], _ = project(camera, vertices[v, 0], vertices[v, 1], vertices[v, 2])
        top = int(min(corner[0, 1], corner[1, 1], corner[2, 1]) - MASK_MARGIN_PX)
        bottom = int(max(corner[0, 1], corner[1, 1], corner[2, 1]) + MASK_MARGIN_PX) + 1
        for y in range(max(top, 0), min(bottom, masked.shape[0] - 1)):
            left, right = span(corner, 0, y - MASK_MARGIN_PX, y + 1 + MASK_MARGIN_PX)
            if left > right:
                continue
            x0 = max(int(left - MASK_MARGIN_PX), 0)
            x1 = min(int(right + MASK_MARGIN_PX) + 1, masked.shape[1] - 1)
            if x0 < x1 and masked[y + 1, x1] - masked[y, x1] - masked[y + 1, x0] + masked[y, x0] > 0:
                score[f] = 0.0
                break


@kernel
def span(corner: FloatArray, axis: int, low: float, high: float) -> tuple[float, float]:
    """Return the least and largest coordinate along an axis of the part of a triangle (3, 2) in a strip.

    The other coordinate is from `low` to `high` in the strip. (inf, -inf) if it misses the triangle.
    """
    least, largest, across = np.inf, -np.inf, 1 - axis
    for k in range(3):
        a, b = corner[k, across], corner[(k + 1) % 3, across]
        if max(a, b) < low or min(a, b) > high:
            continue
        first, last = ((low - a) / (b - a), (high - a) / (b - a)) if a != b else (0.0, 1.0)
        for part in (min(max(first, 0.0), 1.0), min(max(last, 0.0), 1.0)):
            place = corner[k, axis] + part * (corner[(k + 1) % 3, axis] - corner[k, axis])
            least, largest = min(least, place), max(largest, place)
    return least, largest


@kernel
def _cosine(camera: FloatArray, corner: FloatArray) -> float:
    """Return the cosine between the triangle's normal and the direction from its center to the camera."""
    ax, ay, az = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    bx, by, bz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    # -R'(R X + t) is the direction to the camera; its center need not be computed
    wx = wy = wz = 0.0
    for row in range(3):
        at = POSE + 4 * row
        along = (
            camera[at] * corner[3, 0] + camera[at + 1] * corner[3, 1] + camera[at + 2] * corner[3, 2] + camera[at + 3]
        )
        wx -= camera[at] * along
        wy -= camera[at + 1] * along
        wz -= camera[at + 2] * along
    size = np.sqrt((nx * nx + ny * ny + nz * nz) * (wx * wx + wy * wy + wz * wz))
    return (nx * wx + ny * wy + nz * wz) / size if size > 0.0 else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """N views of triangles in photos. Those of photo p are the rows starts[p] to starts[p + 1] - 1."""

    starts: IndexArray
    """(P + 1,)"""
    face: IntArray
    """(N,) triangles, ascending within a photo."""
    score: NDArray[np.float32]
    """(N,) of each view, see `FaceView`; negative for outliers, which do not show the surface."""
    colors: NDArray[np.uint8]
    """(N, 3) RGB."""
    face_starts: IndexArray
    """(T + 1,) The views of triangle f are face_rows[face_starts[f]] to face_rows[face_starts[f + 1] - 1]."""
    face_rows: IndexArray
    """(N,) rows by triangle, ascending for each."""

    @property
    def photos(self) -> int:
        """Number of photos P."""
        return len(self.starts) - 1

    @property
    def triangles(self) -> int:
        """Number of triangles T."""
        return len(self.face_starts) - 1

    @property
    def photo(self) -> IntArray:
        """(N,) photo of each row."""
        return np.repeat(np.arange(self.photos, dtype=np.int32), np.diff(self.starts))

    def rows(self, photo: int) -> slice:
        """Return the rows of a photo."""
        return slice(int(self.starts[photo]), int(self.starts[photo + 1]))

    def find(self, photos: IndexArray | int, faces: NDArray[np.integer]) -> IndexArray:
        """Return the rows of views by photo, one or (M,), and triangle (M,), -1 for none; -1 for missing views."""
        row = np.full(faces.shape, NONE, np.int64)
        photos = np.broadcast_to(np.asarray(photos, np.int64), faces.shape).ravel()
        _find(self.starts, self.face, photos, faces.ravel().astype(np.int64), row.ravel())
        return row

    def is_usable(self, photos: IndexArray | int, faces: NDArray[np.integer]) -> BoolArray:
        """Return (M,) whether views by photo, one or (M,), and triangle (M,), -1 for none, show the surface."""
        row = self.find(photos, faces)
        return np.asarray((row != NONE) & (self.score[row] > 0)) if len(self.score) else np.zeros(row.shape, np.bool_)

    def select_triangles(self, selected: BoolArray) -> "Sightings":
        """Return the views of selected triangles (T,), renumbered."""
        rows = selected[self.face]
        counts = np.diff(np.concatenate([[0], np.cumsum(rows)])[self.starts])
        face = (np.cumsum(selected) - 1)[self.face[rows]].astype(np.int32)
        return make_sightings(counts, face, self.score[rows], self.colors[rows], int(selected.sum()))


def list_sightings(face_views: Sequence[FaceView | None], triangles: int) -> Sightings:
    """List the views of all photos, None for unreadable ones, of a surface with a number of triangles."""
    empty = FaceView(np.empty(0, np.int32), np.empty(0, np.float32), np.empty((0, 3), np.uint8), 0.0)
    views = [view or empty for view in face_views]
    return make_sightings(
        np.array([len(view.face) for view in views], np.int64),
        np.concatenate([empty.face, *(view.face for view in views)]),
        np.concatenate([empty.score, *(view.score for view in views)]),
        np.concatenate([empty.color, *(view.color for view in views)]),
        triangles,
    )


def make_sightings(
    counts: IndexArray, face: IntArray, score: NDArray[np.float32], colors: NDArray[np.uint8], triangles: int
) -> Sightings:
    """List views by photo and by triangle: `counts` (P,) of them per photo, with triangles (N,) ascending in each."""
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    face_starts = np.concatenate([[0], np.cumsum(np.bincount(face, minlength=triangles))]).astype(np.int64)
    return Sightings(starts, face, score, colors, face_starts, bucket_order(face.astype(np.int64), triangles))


@kernel
def _find(starts: IndexArray, face: IntArray, photos: IndexArray, faces: IndexArray, rows: IndexArray) -> None:
    """Find views by bisection among the rows of their photo."""
    for k in range(len(faces)):
        if faces[k] == NONE or photos[k] == NONE:
            continue
        low, high = starts[photos[k]], starts[photos[k] + 1]
        while low < high:
            middle = (low + high) // 2
            if face[middle] < faces[k]:
                low = middle + 1
            else:
                high = middle
        if low < starts[photos[k] + 1] and face[low] == faces[k]:
            rows[k] = low
