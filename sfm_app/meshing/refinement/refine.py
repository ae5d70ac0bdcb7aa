"""The refinement of a surface: from coarse photos to fine ones, in a few Gauss-Newton steps each."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import vertex_normals
from sfm_app.geometry.unit_vectors import normalize
from sfm_app.jit import kernel
from sfm_app.meshing.refinement.agreement import Pull, Sight, compare
from sfm_app.meshing.refinement.fairness import Neighbors, find_displacements
from sfm_app.meshing.refinement.photo_levels import RefinePhoto
from sfm_app.meshing.refinement.rasterize import NOTHING, project_vertices, rasterize
from sfm_app.meshing.refinement.sights import Sights
from sfm_app.meshing.refinement.subdivide import sort_in_space, split_long_edges
from sfm_app.types import Surface

FloatArray = NDArray[np.float64]
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
MOST_PX = 1.0
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
        most: triangles; edges are no longer divided beyond.
        spread: applies a function to photos, possibly in parallel.
    """
    found = list[float]()
    for share, iterations in LEVELS:
        surface = _divide(surface, photos, share, most)
        around = Neighbors.from_faces(surface.faces, len(surface.vertices))
        reach = MOST_PX * finest_pixels(surface.vertices, photos, share)
        for _ in range(iterations):
            surface, correlation = _improve(surface, around, reach, (photos, partners, share), spread)
            found.append(correlation)
    return Refinement(surface, tuple(found))


def finest_pixels(vertices: FloatArray, photos: Sequence[RefinePhoto], share: float) -> FloatArray:
    """Return (V,) the size of a pixel at each vertex, in the photo that has it in view and shows it largest.

    Infinite where no photo has it in view; what hides it does not matter.

    Args:
        vertices: (V, 3).
        photos: posed photos.
        share: of their resolution.
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


def _divide(surface: Surface, photos: Sequence[RefinePhoto], share: float, most: int) -> Surface:
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
    """Return a photo, and the surface in it; nothing where the photo is masked.

    Args:
        surface: triangles.
        photo: the photo.
        share: of its resolution.
    """
    found = rasterize(surface.vertices, surface.faces, photo.projection(share), photo.size_at(share))
    masked = photo.mask_at(share)
    if masked is not None:
        found.depth[masked], found.face[masked] = np.inf, NOTHING
    return Sight(photo.level(share), found)
