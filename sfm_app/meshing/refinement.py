"""Refinement of a surface by photos, from coarse to fine, in a few Gauss-Newton steps each."""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from threading import Lock

import cv2
import numpy as np

from sfm_app.geometry.poses import normalize
from sfm_app.geometry.raster import NOTHING, project_vertices, rasterize
from sfm_app.geometry.triangles import morton_order, unique_edges, vertex_normals
from sfm_app.meshing.agreement import Pull, RefinePhoto, Sight, compare
from sfm_app.meshing.fairness import Neighbors, find_displacements
from sfm_app.tasks import Spread
from sfm_app.types import PosedPhoto, Surface
from sfm_app.types.arrays import FloatArray, IndexArray

MOST_KEPT_PX = 100_000_000
"""Pixels of the photos that `Sights` keeps: 2 GB."""


@dataclass(frozen=True, slots=True)
class RefineOptions:
    """Levels and steps of the refinement."""

    levels: tuple[tuple[float, int], ...] = ((0.5, 2), (1.0, 3))
    """Shares of the resolution of the photos, and iterations at each. Chosen on `ornament`, where (3, 2) recovers fewer
    edges; confirmed on `garden`."""
    edge_px: float = 8.0
    """Longest edge in pixels of the closest photo. Chosen on `ornament`: half of it doubles the cost for the same
    surface."""
    divisions: int = 3
    """Most divisions of an edge before a level. Chosen by hand."""
    longest_step_px: float = 1.0
    """Longest step of a vertex in pixels of the closest photo: photos are smooth over about that. By definition of the
    blur."""
    rim_px: int = 2
    """Width of the rim behind an outline that is not compared. Chosen on `garden`: with 3, F at 0.1 % is a point lower;
    without, F at 0.2 % is four points lower."""
    behind: float = 0.05
    """Relative difference in depth beyond which a place lies behind another. Chosen by hand."""
    longest_step_edges: float = 0.5
    """Longest step of a vertex in edges: triangles do not turn over. By definition."""


OPTIONS = RefineOptions()
STEPS = sum(iterations for _, iterations in OPTIONS.levels)
"""Iterations on all levels."""


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """A refined surface."""

    surface: Surface
    correlations: tuple[float, ...]
    """Mean correlation of photos through the surface, before each iteration."""
    failed: str = ""
    """Reason why the surface is not refined; empty where it is."""


def refine(
    surface: Surface, photos: Sequence[RefinePhoto], partners: Sequence[Sequence[int]], most: int, spread: Spread = map
) -> Refinement:
    """Move the vertices of a surface along their normals to where photos agree best; divide coarse triangles.

    `partners` are numbers of the photos for comparison with each one; beyond `most` triangles no edge is divided.
    """
    correlations = list[float]()
    for share, iterations in OPTIONS.levels:
        posed = [photo.posed_at(share) for photo in photos]
        surface = _divide_surface(surface, posed, most)
        neighbors = Neighbors.from_faces(surface.faces, len(surface.vertices))
        reach = OPTIONS.longest_step_px * finest_pixels(surface.vertices, posed)
        for _ in range(iterations):
            surface, correlation = _improve(surface, neighbors, reach, photos, partners, share, spread)
            correlations.append(correlation)
    return Refinement(surface, tuple(correlations))


def _divide_surface(surface: Surface, photos: Sequence[PosedPhoto], most: int) -> Surface:
    """Return the surface with triangles small enough for a level of the photos, as far as `most` allows."""
    for _ in range(OPTIONS.divisions):
        finer = split_long_edges(surface, OPTIONS.edge_px * finest_pixels(surface.vertices, photos))
        if len(finer.faces) == len(surface.faces) or len(finer.faces) > most:
            break
        surface = finer
    return sort_in_space(surface)


def finest_pixels(points: FloatArray, photos: Iterable[PosedPhoto]) -> FloatArray:
    """Return (N,) the size of a pixel at each point in the closest photo with it in view, even hidden, or infinity."""
    sizes = np.full(len(points), np.inf)
    for photo in photos:
        x, y, near = project_vertices(points, photo.projection).T
        shown = (near > 0.0) & (x > 0.0) & (x < photo.width) & (y > 0.0) & (y < photo.height)
        sizes[shown] = np.minimum(sizes[shown], 1.0 / (near[shown] * photo.focal_px))
    return sizes


def split_long_edges(surface: Surface, longest: FloatArray) -> Surface:
    """Return the surface with long edges divided in the middle; the smaller limit (V,) of both ends decides."""
    edges, edge_of = unique_edges(surface.faces)
    one, other = edges.T
    lengths = np.linalg.norm(surface.vertices[other] - surface.vertices[one], axis=1)
    is_long = lengths > np.minimum(longest[one], longest[other])
    one, other, middle = one[is_long], other[is_long], np.full(len(edges), -1)
    middle[is_long] = len(surface.vertices) + np.arange(len(one))
    colors = (surface.colors[one].astype(np.uint16) + surface.colors[other]) // 2
    return Surface(
        np.concatenate([surface.vertices, (surface.vertices[one] + surface.vertices[other]) / 2.0]),
        _divide_triangles(surface.faces, middle[edge_of]) if len(one) else surface.faces,
        np.concatenate([surface.colors, colors.astype(np.uint8)]),
    )


def _divide_triangles(faces: IndexArray, middle: IndexArray) -> IndexArray:
    """Return the parts of triangles; `middle` (T, 3) has the new vertices on the edges ab, bc, ca, -1 for none."""
    count = np.sum([side >= 0 for side in middle.T], axis=0)
    parts = [faces[count == 0]]
    for corner in range(3):
        a, b, c = corner, (corner + 1) % 3, (corner + 2) % 3
        one = (count == 1) & (middle[:, a] >= 0)
        parts.append(np.stack([faces[one, a], middle[one, a], faces[one, c]], axis=1))
        parts.append(np.stack([middle[one, a], faces[one, b], faces[one, c]], axis=1))
        two = (count == 2) & (middle[:, a] < 0)
        parts.append(np.stack([middle[two, c], middle[two, b], faces[two, c]], axis=1))
        parts.append(np.stack([faces[two, a], faces[two, b], middle[two, b]], axis=1))
        parts.append(np.stack([faces[two, a], middle[two, b], middle[two, c]], axis=1))
        three = count == 3
        parts.append(np.stack([faces[three, a], middle[three, a], middle[three, c]], axis=1))
    return np.concatenate([*parts, middle[count == 3]])


def sort_in_space(surface: Surface) -> Surface:
    """Return the surface with neighbors close to each other in memory, which halves the time of a step."""
    order = morton_order(surface.vertices)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    faces = place[surface.faces]
    faces = faces[np.argsort(faces.min(axis=1), kind="stable")]
    return Surface(surface.vertices[order], faces, surface.colors[order])


def _improve(
    surface: Surface, neighbors: Neighbors, reach: FloatArray, photos: Sequence[RefinePhoto],
    partners: Sequence[Sequence[int]], share: float, spread: Spread,
) -> tuple[Surface, float]:  # fmt: skip
    """Return the surface after one step, and the correlation of photos before it."""
    vertices, faces = surface.vertices, surface.faces
    normals = vertex_normals(vertices, faces)
    facing = normalize(normals[faces].mean(axis=1)).astype(np.float32)
    sights = Sights(lambda k: look(surface, photos[k], share))

    def pull_of(k: int) -> Pull:
        return compare(vertices, faces, facing, sights[k], [sights[other] for other in partners[k]])

    whole = Pull.zeros(len(vertices))
    for pull in spread(pull_of, range(len(photos))):
        whole.add(pull)
    size = np.maximum(neighbors.edge_lengths(vertices), np.finfo(np.float64).tiny ** 0.25)
    steps = find_displacements(vertices, normals, neighbors, (whole.g, whole.h), size)
    limit = np.minimum(np.where(np.isfinite(reach), reach, 0.0), OPTIONS.longest_step_edges * size)
    moved = vertices + np.clip(steps, -limit, limit)[:, None] * normals
    return replace(surface, vertices=moved), whole.correlation / max(whole.pixels, 1.0)


def look(surface: Surface, photo: RefinePhoto, share: float) -> Sight:
    """Return a photo at a share of its resolution, and the surface in it.

    It shows NOTHING where the photo is masked, and on the rim behind an outline: if this is inexact, the object draws
    what lies behind towards itself.
    """
    posed = photo.posed_at(share)
    size = posed.width, posed.height
    raster, masked = rasterize(surface.vertices, surface.faces, posed), photo.mask_at(size)
    square = np.ones((2 * OPTIONS.rim_px + 1, 2 * OPTIONS.rim_px + 1), np.uint8)
    nearest = cv2.erode(raster.depth, square, borderType=cv2.BORDER_REPLICATE)
    unused = raster.depth > (1.0 + OPTIONS.behind) * nearest
    if masked is not None:
        unused |= masked
    raster.depth[unused], raster.face[unused] = np.inf, NOTHING
    return Sight(posed, photo.image_at(size), raster)


class Sights:
    """A cache of the last photos used, by number, each with the surface drawn into it."""

    def __init__(self, look: Callable[[int], Sight], most_px: int = MOST_KEPT_PX) -> None:
        self._look, self._most_px, self._lock = look, most_px, Lock()
        self._sights = OrderedDict[int, Future[Sight]]()

    def __getitem__(self, number: int) -> Sight:
        with self._lock:
            cached = self._sights.get(number)
            if cached is None:
                self._sights[number] = mine = Future[Sight]()
            else:
                self._sights.move_to_end(number)
        if cached is not None:
            return cached.result()
        try:
            mine.set_result(self._look(number))
        except BaseException as error:
            mine.set_exception(error)
            raise
        self._drop_oldest()
        return mine.result()

    def _drop_oldest(self) -> None:
        with self._lock:
            done = [(key, one.result()) for key, one in self._sights.items() if one.done() and not one.exception()]
            pixels = sum(sight.raster.depth.size for _, sight in done)
            for key, sight in done[:-1]:
                if pixels <= self._most_px:
                    break
                pixels -= sight.raster.depth.size
                del self._sights[key]
