"""Which photos see which triangles, in lists: a photo sees few of a town's triangles."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import number_vertices
from sfm_app.jit import kernel
from sfm_app.texture.facets import NONE, Facets, IntArray
from sfm_app.texture.views import POSE, PhotoView, project, sample
from sfm_app.types.arrays import FloatArray, IndexArray

# Views of the triangles in one photo: which triangles it sees, how well, and in which colors.

OcclusionTest = Callable[[FloatArray, float, FloatArray], NDArray[np.bool_]]
"""Takes a camera center (3,), the slack at a point, and points (N, 3); returns whether each is hidden, (N,)."""

SLACK = 1.0
"""Slack of the occlusion test, in median edge lengths, so that the surface's roughness hides nothing."""
MIN_COSINE = 0.1
"""Smallest cosine of the viewing angle; from more oblique views, few pixels would be stretched over the triangle."""
BORDER_PX = 2.0
"""Width of the unused border of a photo, where resampling and demosaicing are incomplete."""
RIM_RINGS, RIM_WORTH = 2, 0.5
"""Rings of triangles next to those that a photo does not see, and the factor on their worth per ring: where the
surface is off by a pixel, they show the foreground or background."""
MASK_RIM_PX = 1.0
"""A triangle this close to a masked pixel is not used, because colors are interpolated between pixels."""
SHARPNESS_RANGE = (0.2, 1.0)


@dataclass(frozen=True, slots=True, eq=False)
class FaceView:
    """One photo's view of the triangles that it sees."""

    face: IntArray
    """(M,) the triangles, ascending."""
    worth: NDArray[np.float32]
    """(M,) pixels times cosine of the viewing angle, > 0."""
    color: NDArray[np.uint8]
    """(M, 3) mean RGB."""
    sharpness: float
    """Energy of the finest detail relative to that at half size; decreases with blur, hardly depends on content."""


def score_faces(
    view: PhotoView, photo: NDArray[np.uint8], used: NDArray[np.bool_] | None, mesh: Facets, hidden: OcclusionTest
) -> FaceView:
    """Score the triangles in one photo.

    Args:
        view: lens and pose.
        photo: (height, width, 3) RGB, of the view's size.
        used: (height, width) which of its pixels may be used; None where all may.
        mesh: the surface.
        hidden: the occlusion test.
    """
    near = mesh.clusters.find_in_cone(view.center, view.axis, view.widest_angle)
    worth, color = np.zeros(len(near), np.float32), np.zeros((len(near), 3), np.uint8)
    _measure(view.row, photo, mesh.vertices, mesh.faces[near], worth, color)
    if used is not None:
        masked = np.zeros((view.height + 1, view.width + 1), np.int32)
        np.cumsum(np.cumsum(~used, axis=0, dtype=np.int32), axis=1, out=masked[1:, 1:])
        _drop_masked(view.row, masked, mesh.vertices, mesh.faces[near], worth)
    candidates = np.flatnonzero(worth)
    occluded = _occluded_mask(near[candidates], mesh, partial(hidden, view.center, SLACK * mesh.spacing))
    seen = candidates[~occluded]
    face, worth = near[seen], worth[seen]
    _lower_rims(face, worth, mesh)
    shown = worth > 0
    return FaceView(face[shown].astype(np.int32), worth[shown], color[seen[shown]], sharpness(photo, used))


def _lower_rims(face: NDArray[np.int64], worth: NDArray[np.float32], mesh: Facets) -> None:
    """Weigh seen triangles less, in place, ring by ring from those that the photo does not see."""
    inner = np.arange(len(face))
    for _ in range(RIM_RINGS):
        corners = mesh.faces[face[inner]]
        vertices, at = number_vertices(corners)
        whole = np.bincount(at.ravel(), minlength=len(vertices)) == mesh.valence[vertices]
        inside = whole[at].all(axis=1)
        beyond = np.ones(len(face), np.bool_)
        beyond[inner[inside]] = False
        worth[beyond] *= RIM_WORTH
        inner = inner[inside]


def _occluded_mask(
    candidates: NDArray[np.int64], mesh: Facets, hidden: Callable[[FloatArray], NDArray[np.bool_]]
) -> NDArray[np.bool_]:
    """Mark triangles that are hidden at the center or at two corners, (N,)."""
    corners = mesh.faces[candidates]
    points, at = number_vertices(corners)
    blocked = hidden(mesh.vertices[points])[at].sum(axis=1, dtype=np.int8) > 1
    open_ones = np.flatnonzero(~blocked)
    blocked[open_ones] = hidden(mesh.vertices[corners[open_ones]].mean(axis=1))
    return np.asarray(blocked, np.bool_)


def sharpness(photo: NDArray[np.uint8], used: NDArray[np.bool_] | None = None) -> float:
    """Return the ratio of Laplacian energies at full and at half size, >= 0, over usable pixels.

    Args:
        photo: (H, W, 3) RGB.
        used: (H, W) which pixels may be used; all where None.
    """
    gray = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY)
    half = cv2.resize(gray, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    fine, coarse = (_energy(part, used) for part in (gray, half))
    return fine / coarse if coarse > 0 else 0.0


def _energy(gray: NDArray[np.uint8], used: NDArray[np.bool_] | None) -> float:
    energy = np.square(cv2.Laplacian(gray, cv2.CV_32F))
    if used is None:
        return float(np.mean(energy))
    size = gray.shape[1], gray.shape[0]
    counted = energy[cv2.resize(used.view(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0]
    return float(np.mean(counted)) if counted.size else 0.0


def sharpness_factors(sharpness_of: NDArray[np.float64]) -> FloatArray:
    """Return (P,) factors on the worth of each photo, 1 for the median sharpness."""
    middle = float(np.median(sharpness_of)) if len(sharpness_of) else 0.0
    relative = sharpness_of / middle if middle > 0 else np.ones(len(sharpness_of))
    return np.asarray(np.clip(relative, *SHARPNESS_RANGE), np.float64)


@kernel
def _measure(
    camera: FloatArray,
    photo: NDArray[np.uint8],
    vertices: FloatArray,
    faces: NDArray[np.int64],
    worth: NDArray[np.float32],
    color: NDArray[np.uint8],
) -> None:
    """Write area in pixels times cosine, and mean color, of triangles within the photo that face the camera."""
    height, width = photo.shape[0], photo.shape[1]
    x, y, corner = np.empty(4), np.empty(4), np.empty((4, 3))
    for f in range(len(faces)):
        for axis in range(3):
            corner[3, axis] = 0.0
            for k in range(3):
                corner[k, axis] = vertices[faces[f, k], axis]
                corner[3, axis] += corner[k, axis] / 3.0
        inside = True
        for k in range(4):
            x[k], y[k], depth = project(camera, corner[k, 0], corner[k, 1], corner[k, 2])
            inside = inside and depth > 0.0 and BORDER_PX <= x[k] <= width - BORDER_PX
            inside = inside and BORDER_PX <= y[k] <= height - BORDER_PX
        if not inside:
            continue
        cosine = _cosine(camera, corner)
        # y points down in the photo: triangles counterclockwise from outside have a negative area
        area = -0.5 * ((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0]))
        if cosine < MIN_COSINE or area <= 0.0:
            continue
        worth[f] = area * cosine
        for channel in range(3):
            total = 0.0
            for k in range(4):
                total += sample(photo, x[k], y[k], channel)
            color[f, channel] = int(total / 4.0 + 0.5)


@kernel
def _drop_masked(
    camera: FloatArray,
    masked: NDArray[np.int32],
    vertices: FloatArray,
    faces: NDArray[np.int64],
    worth: NDArray[np.float32],
) -> None:
    """Set the worth of the triangles that show a masked pixel to 0.

    Args:
        camera: lens and pose.
        masked: (height + 1, width + 1) integral image of masked pixels, above and to the left of each.
        vertices: of the surface.
        faces: of the surface.
        worth: (T,) positive only for triangles within the photo.
    """
    corner = np.empty((3, 2))
    for f in range(len(faces)):
        if worth[f] <= 0.0:
            continue
        for k in range(3):
            v = faces[f, k]
            corner[k, 0], corner[k, 1], _ = project(camera, vertices[v, 0], vertices[v, 1], vertices[v, 2])
        top = int(min(corner[0, 1], corner[1, 1], corner[2, 1]) - MASK_RIM_PX)
        bottom = int(max(corner[0, 1], corner[1, 1], corner[2, 1]) + MASK_RIM_PX) + 1
        for y in range(max(top, 0), min(bottom, masked.shape[0] - 1)):
            left, right = _span(corner, y - MASK_RIM_PX, y + 1 + MASK_RIM_PX)
            if left > right:
                continue
            x0 = max(int(left - MASK_RIM_PX), 0)
            x1 = min(int(right + MASK_RIM_PX) + 1, masked.shape[1] - 1)
            if x0 < x1 and masked[y + 1, x1] - masked[y, x1] - masked[y + 1, x0] + masked[y, x0] > 0:
                worth[f] = 0.0
                break


@kernel
def _span(corner: FloatArray, top: float, bottom: float) -> tuple[float, float]:
    """Return the smallest and largest x of a triangle (3, 2) between two heights; (inf, -inf) if they miss it."""
    left, right = np.inf, -np.inf
    for k in range(3):
        ax, ay, bx, by = corner[k, 0], corner[k, 1], corner[(k + 1) % 3, 0], corner[(k + 1) % 3, 1]
        if max(ay, by) < top or min(ay, by) > bottom:
            continue
        first = last = 0.0
        if ay != by:
            first, last = (top - ay) / (by - ay), (bottom - ay) / (by - ay)
        else:
            last = 1.0
        for part in (min(max(first, 0.0), 1.0), min(max(last, 0.0), 1.0)):
            x = ax + part * (bx - ax)
            left, right = min(left, x), max(right, x)
    return left, right


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
    worth: NDArray[np.float32]
    """(N,) of each view, see `FaceView`; negative for outliers, which show something other than the surface."""
    colors: NDArray[np.uint8]
    """(N, 3) RGB."""
    face_starts: IndexArray
    """(T + 1,) the views of triangle f are face_rows[face_starts[f]] to face_rows[face_starts[f + 1] - 1]."""
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
        """Return the rows of views, -1 for those that are not there.

        Args:
            photos: (M,) photo of each view, or one for all.
            faces: (M,) triangle of each view; -1 for none.
        """
        found = np.full(faces.shape, NONE, np.int64)
        _find(self.starts, self.face, np.broadcast_to(np.asarray(photos, np.int64), faces.shape).ravel(),
              faces.ravel().astype(np.int64), found.ravel())  # fmt: skip
        return found

    def is_usable(self, photos: IndexArray | int, faces: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Return (M,) whether photos see triangles and show the surface there.

        Args:
            photos: (M,) photo of each view, or one for all.
            faces: (M,) triangle of each view; -1 for none.
        """
        row = self.find(photos, faces)
        return np.asarray((row != NONE) & (self.worth[row] > 0)) if len(self.worth) else np.zeros(row.shape, np.bool_)

    def usable_faces(self, photo: int) -> IndexArray:
        """Return (M,) the triangles that a photo may be used for, ascending."""
        rows = self.rows(photo)
        return self.face[rows][self.worth[rows] > 0].astype(np.int64)

    def select_triangles(self, kept: NDArray[np.bool_]) -> "Sightings":
        """Return the views of some triangles, which are numbered anew.

        Args:
            kept: (T,) triangles to keep.
        """
        return _gather(self, kept[self.face], np.cumsum(kept) - 1, int(kept.sum()))

    def with_worth(self, worth: NDArray[np.float32]) -> "Sightings":
        """Return the same views with another worth."""
        return replace(self, worth=worth)


def list_sightings(looks: Sequence[FaceView | None], triangles: int) -> Sightings:
    """List what all photos see.

    Args:
        looks: of each photo; None where it cannot be read.
        triangles: of the surface.
    """
    empty = FaceView(np.empty(0, np.int32), np.empty(0, np.float32), np.empty((0, 3), np.uint8), 0.0)
    found = [look or empty for look in looks]
    return make_sightings(
        np.array([len(look.face) for look in found], np.int64),
        np.concatenate([empty.face, *(look.face for look in found)]),
        np.concatenate([empty.worth, *(look.worth for look in found)]),
        np.concatenate([empty.color, *(look.color for look in found)]),
        triangles,
    )


def make_sightings(
    counts: IndexArray, face: IntArray, worth: NDArray[np.float32], colors: NDArray[np.uint8], triangles: int
) -> Sightings:
    """List views by photo and by triangle.

    Args:
        counts: (P,) views of each photo.
        face: (N,) triangles, ascending within a photo.
        worth: (N,) of each view.
        colors: (N, 3) RGB.
        triangles: of the surface.
    """
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    face_starts = np.concatenate([[0], np.cumsum(np.bincount(face, minlength=triangles))]).astype(np.int64)
    rows = np.empty(len(face), np.int64)
    _rank(face, face_starts[:-1].copy(), rows)
    return Sightings(starts, face, worth, colors, face_starts, rows)


def _gather(old: Sightings, kept: NDArray[np.bool_], number: IndexArray, triangles: int) -> Sightings:
    counts = np.diff(np.concatenate([[0], np.cumsum(kept)])[old.starts])
    face = number[old.face[kept]].astype(np.int32)
    return make_sightings(counts, face, old.worth[kept], old.colors[kept], triangles)


@kernel
def _rank(face: IntArray, next_place: IndexArray, rows: IndexArray) -> None:
    """Sort rows by triangle, by counting."""
    for row in range(len(face)):
        rows[next_place[face[row]]] = row
        next_place[face[row]] += 1


@kernel
def _find(starts: IndexArray, face: IntArray, photos: IndexArray, faces: IndexArray, found: IndexArray) -> None:
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
            found[k] = low
