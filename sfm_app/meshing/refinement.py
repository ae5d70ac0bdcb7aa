"""The refinement of a surface: from coarse photos to fine ones, in a few Gauss-Newton steps each."""

from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from threading import Lock
from typing import Any

import numpy as np

from sfm_app.geometry.poses import normalize
from sfm_app.geometry.triangles import morton_order, unique_edges, vertex_normals
from sfm_app.jit import kernel
from sfm_app.meshing.agreement import NOTHING, Pull, RefinePhoto, Sight, compare, project_vertices, rasterize
from sfm_app.meshing.fairness import Neighbors, find_displacements
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray, IndexArray

# Divide triangles that are too large for the detail that photos show.


def split_long_edges(surface: Surface, longest: FloatArray) -> Surface:
    """Return the surface with every edge that is too long divided in the middle.

    Args:
        longest: (V,) longest edge at each vertex; the smaller one of both ends decides.
    """
    edges, edge_of = unique_edges(surface.faces)
    middle = np.full(len(edges), -1)
    count = _number_long(edges, surface.vertices, longest, middle)
    one, other = edges[middle >= 0].T
    colors = (surface.colors[one].astype(np.uint16) + surface.colors[other]) // 2
    return Surface(
        np.concatenate([surface.vertices, (surface.vertices[one] + surface.vertices[other]) / 2.0]),
        _divide_triangles(surface.faces, middle[edge_of]) if count else surface.faces,
        np.concatenate([surface.colors, colors.astype(np.uint8)]),
    )


@kernel
def _number_long(edges: IndexArray, vertices: FloatArray, longest: FloatArray, middle: IndexArray) -> int:
    """Fill in the numbers of the new vertices in the middle of edges that are too long; return how many there are."""
    count = 0
    for k in range(len(edges)):
        a, b = edges[k, 0], edges[k, 1]
        x, y, z = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
        if np.sqrt(x * x + y * y + z * z) > min(longest[a], longest[b]):
            middle[k] = len(vertices) + count
            count += 1
    return count


def sort_in_space(surface: Surface) -> Surface:
    """Return the surface with neighbors close to each other in memory: it is drawn and smoothed twice as fast."""
    order = morton_order(surface.vertices)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    faces = place[surface.faces]
    faces = faces[np.argsort(faces.min(axis=1), kind="stable")]
    return Surface(surface.vertices[order], faces, surface.colors[order])


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


# Keep the photos that were used last, with the surface in them: each is drawn once, and memory stays bounded.

MOST_KEPT_PX = 100_000_000
"""Pixels of the photos that are kept: 2 GB. By the memory that a run may have."""


class Sights:
    """Photos by their number, made when they are asked for first."""

    def __init__(self, look: Callable[[int], Sight]) -> None:
        self._look, self._lock = look, Lock()
        self._kept = OrderedDict[int, Future[Sight]]()

    def __getitem__(self, number: int) -> Sight:
        with self._lock:
            known = self._kept.get(number)
            if known is None:
                self._kept[number] = mine = Future[Sight]()
            else:
                self._kept.move_to_end(number)
        if known is not None:
            return known.result()
        try:
            mine.set_result(self._look(number))
        except BaseException as error:
            mine.set_exception(error)
            raise
        self._drop_oldest()
        return mine.result()

    def _drop_oldest(self) -> None:
        with self._lock:
            done = [(key, one.result()) for key, one in self._kept.items() if one.done() and not one.exception()]
            pixels = sum(sight.raster.depth.size for _, sight in done)
            for key, sight in done[:-1]:
                if pixels <= MOST_KEPT_PX:
                    break
                pixels -= sight.raster.depth.size
                del self._kept[key]


Spread = Callable[[Callable[[int], Any], Sequence[int]], Iterable[Any]]
"""Calls a function for every number, possibly in parallel, and returns the results in order."""

LEVELS = ((0.5, 2), (1.0, 3))
"""Shares of the resolution of the photos, and iterations at each. Chosen on `ornament`, where three and two find less
of the edges; on `garden`, which was left out, too."""
STEPS = sum(iterations for _, iterations in LEVELS)
"""Times that every photo is asked."""
EDGE_PX = 8.0
"""Longest edge in the photo that shows it best, in pixels. Chosen on `ornament`: half as long ones cost twice as much
and find nothing more."""
ROUNDS = 3
"""Most times that edges are divided before a level."""
LONGEST_STEP_PX = 1.0
"""Longest step of a vertex, in pixels of the photo that shows it best: photos are smooth over about that. By
definition of the blur."""
MOST_EDGES = 0.5
"""Longest step of a vertex in edges, so that triangles do not turn over. By definition."""


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """A refined surface."""

    surface: Surface
    correlations: tuple[float, ...]
    """Mean correlation of photos through the surface, before each iteration."""
    failed: str = ""
    """Why the surface is as it was; empty where it is refined."""


def refine(
    surface: Surface, photos: Sequence[RefinePhoto], partners: Sequence[Sequence[int]], most: int, spread: Spread = map
) -> Refinement:
    """Move the vertices of a surface along their normals to where photos agree best; divide what is too coarse.

    Args:
        surface: triangles, counterclockwise seen from outside, about right to some pixels.
        photos: posed photos without distortion.
        partners: for each photo, numbers of others that it is compared with.
    """
    found = list[float]()
    for share, iterations in LEVELS:
        surface = _divide_surface(surface, photos, share, most)
        around = Neighbors.from_faces(surface.faces, len(surface.vertices))
        reach = LONGEST_STEP_PX * finest_pixels(surface.vertices, photos, share)
        for _ in range(iterations):
            surface, correlation = _improve(surface, around, reach, (photos, partners, share), spread)
            found.append(correlation)
    return Refinement(surface, tuple(found))


def finest_pixels(vertices: FloatArray, photos: Sequence[RefinePhoto], share: float) -> FloatArray:
    """Return (V,) the size of a pixel at each vertex, in the photo that has it in view and shows it largest.

    Infinite where no photo has it in view; what hides it does not matter.

    Args:
        vertices: (V, 3).
    """
    found = np.full(len(vertices), np.inf)
    for photo in photos:
        seen = project_vertices(vertices, photo.projection(share))
        _keep_finest(seen, photo.size_at(share), photo.focal_px, photo.gray.shape[1], found)
    return found


@kernel
def _keep_finest(seen: FloatArray, shape: tuple[int, int], focal_px: float, full_width: int, found: FloatArray) -> None:
    """Keep the smaller size of a pixel at each vertex, the known one or that of a photo with x, y, 1 / depth `seen`."""
    height, width = shape
    for v in range(len(found)):
        x, y, near = seen[v, 0], seen[v, 1], seen[v, 2]
        if near > 0.0 and 0.0 < x < width and 0.0 < y < height:
            found[v] = min(found[v], 1.0 / (near * focal_px * width / full_width))


def _divide_surface(surface: Surface, photos: Sequence[RefinePhoto], share: float, most: int) -> Surface:
    """Return the surface with triangles as small as a level of the photos asks for, as far as `most` allows."""
    for _ in range(ROUNDS):
        finer = split_long_edges(surface, EDGE_PX * finest_pixels(surface.vertices, photos, share))
        if len(finer.faces) == len(surface.faces) or len(finer.faces) > most:
            break
        surface = finer
    return sort_in_space(surface)


def _improve(
    surface: Surface, around: Neighbors, reach: FloatArray,
    seen: tuple[Sequence[RefinePhoto], Sequence[Sequence[int]], float], spread: Spread,
) -> tuple[Surface, float]:  # fmt: skip
    """Return the surface after one step, and the correlation of photos before it."""
    photos, partners, share = seen
    vertices, faces = surface.vertices, surface.faces
    normals = vertex_normals(vertices, faces)
    facing = normalize(normals[faces].mean(axis=1)).astype(np.float32)
    sights = Sights(lambda k: look(surface, photos[k], share))

    def ask(k: int) -> Pull:
        return compare(vertices, faces, facing, sights[k], [sights[other] for other in partners[k]])

    whole = Pull.zeros(len(vertices))
    for pull in spread(ask, range(len(photos))):
        whole.add(pull)
    size = np.maximum(around.edge_lengths(vertices), np.finfo(np.float64).tiny ** 0.25)
    steps = find_displacements(vertices, normals, around, (whole.g, whole.h), size)
    limit = np.minimum(np.where(np.isfinite(reach), reach, 0.0), MOST_EDGES * size)
    moved = vertices + np.clip(steps, -limit, limit)[:, None] * normals
    return replace(surface, vertices=moved), whole.correlation / max(whole.pixels, 1.0)


def look(surface: Surface, photo: RefinePhoto, share: float) -> Sight:
    """Return a photo, and the surface in it; nothing where the photo is masked."""
    found = rasterize(surface.vertices, surface.faces, photo.projection(share), photo.size_at(share))
    masked = photo.mask_at(share)
    if masked is not None:
        found.depth[masked], found.face[masked] = np.inf, NOTHING
    return Sight(photo.level(share), found)
