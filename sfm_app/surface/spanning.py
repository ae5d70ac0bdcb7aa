"""The surface through fused points: what photos see is kept, and gaps are closed where they see nothing else."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.dense import read_depth
from sfm_app.colmap.surface import positions
from sfm_app.geometry.raster import NOTHING, rasterize
from sfm_app.geometry.triangles import select_faces, unique_edges
from sfm_app.meshing.cleaning import make_manifold
from sfm_app.meshing.refinement import finest_pixels
from sfm_app.meshing.tetrahedra import OPTIONS, Cloud, choose_sights, cut_surface, thin
from sfm_app.meshing.visibility import CONFIRMED, EMPTY, SEEN_THROUGH, judge
from sfm_app.stereo import View
from sfm_app.tasks import Spread
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray, IndexArray

GAP = 8.0
"""Longest edge of a measured triangle, in distances of points: longer ones close a gap. Chosen by hand."""
NARROW = 16.0
"""Width of a patch that is closed even where no photo looks at it, in distances of points. Chosen by hand."""
LEAST_FACING = 0.25
"""Least mean cosine at which photos look at a wider patch, and not along it. Chosen by hand."""
LEAST_LOOKED = 0.4
"""Least share of it that they look at. Chosen by hand: hidden corners of the demo have a third or less; the gap
behind the pediment of fountain-P11 has 0.44."""
MOST_AGAINST = 0.3
"""Largest share of a patch that photos see through. Chosen on fountain-P11: at half, more pixels are off."""
HALVED = 2
"""Halvings of the photos in which backs of triangles are counted. Chosen by hand."""
SMOOTHING = 3
"""Steps of smoothing: the cut passes through points with noise. Chosen by hand."""
LEAST_CONFIRMED = 200
"""Points that a photo has to confirm to take part in the refinement of a block. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Depth maps as evidence for and against points."""

    dense_dir: Path
    views: Sequence[View]
    tolerance: float
    """Relative difference in depth within which a photo confirms a point."""
    spread: Spread = map

    def judge(self, points: FloatArray, normals: FloatArray) -> Iterable[NDArray[np.uint8]]:
        """Return the verdict of each photo on points (N, 3) with unit normals (N, 3)."""

        def look(number: int) -> NDArray[np.uint8]:
            view = self.views[number]
            depth = read_depth(self.dense_dir, view, "geometric")
            return judge(points, normals, view, depth, view.sample_px, self.tolerance)

        return self.spread(look, range(len(self.views)))


def gather(records: NDArray[np.void], views: Sequence[View]) -> Cloud:
    """Return the fused points (N,), from `open_points`, about as dense as the depth maps tell them apart."""
    points = positions(records)
    pixel = finest_pixels(points, views)
    near = np.isfinite(pixel)
    normals, colors = (
        np.stack([records[name][near] for name in names], axis=1)
        for names in (("nx", "ny", "nz"), ("red", "green", "blue"))
    )
    return thin(points[near], normals.astype(np.float64), colors, OPTIONS.spacing_px * pixel[near])


def span(
    cloud: Cloud, evidence: Evidence, *, close: bool = False, context: Cloud | None = None
) -> tuple[Surface, list[View]]:
    """Return the surface through points, and the photos that confirm enough of them; `close` keeps what no photo sees.

    Lines of sight to the points of `context` pass through the surface of these, too.
    """
    own = len(cloud.points)
    if context is not None:
        cloud = Cloud(*(np.concatenate([getattr(one, name) for one in (cloud, context)]) for name in Cloud.__slots__))
    seen, confirmed, through = list[IndexArray](), np.zeros(len(cloud.points)), np.zeros(len(cloud.points))
    for verdict in evidence.judge(cloud.points, cloud.normals):
        confirmed += verdict == CONFIRMED
        through += verdict == SEEN_THROUGH
        seen.append(np.flatnonzero(verdict == CONFIRMED))
    witnesses = [
        view for view, at in zip(evidence.views, seen, strict=True) if np.count_nonzero(at < own) >= LEAST_CONFIRMED
    ]
    kept = (confirmed > 0) & (through <= confirmed)
    if np.count_nonzero(kept) < 5:
        return Surface(np.empty((0, 3)), np.empty((0, 3), np.int64), np.empty((0, 3), np.uint8)), witnesses
    number, cloud = np.cumsum(kept) - 1, cloud.select(kept)
    centers = np.stack([view.center for view in evidence.views])
    sights = choose_sights([number[at[kept[at]]] for at in seen], centers, len(cloud.points))
    surface, step = cut_surface(cloud, sights, close=close)
    return make_manifold(smooth(surface if close else drop_guesses(surface, step, evidence))), witnesses


def drop_guesses(surface: Surface, step: FloatArray, evidence: Evidence) -> Surface:
    """Drop triangles that are longer than the gaps of points, except patches over holes that photos do not contradict.

    `step` (V,) is the distance of the points at each vertex. Measured triangles surround such a patch, and hardly any
    photo sees through it. It is narrow, or photos look at a part of it and not along it, or see insides without it.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges, edge_of = unique_edges(surface.faces)
    lengths = np.linalg.norm(surface.vertices[edges[:, 0]] - surface.vertices[edges[:, 1]], axis=1)
    steps = step[surface.faces].min(axis=1)
    guesses = np.flatnonzero(lengths[edge_of].max(axis=1) > GAP * steps)
    sides = edge_of[guesses]
    order = np.argsort(sides.ravel(), kind="stable")
    same = np.flatnonzero(np.diff(sides.ravel()[order]) == 0)
    graph = coo_array((np.ones(len(same)), (order[same] // 3, order[same + 1] // 3)), (len(guesses), len(guesses)))
    count, patch = connected_components(graph, directed=False)

    def sum_up(values: NDArray[np.generic]) -> FloatArray:
        return np.asarray(np.bincount(patch, values.astype(np.float64), count), np.float64)

    uses, inner = np.bincount(edge_of.ravel(), minlength=len(edges)), np.bincount(sides.ravel(), minlength=len(edges))
    rim = sum_up((lengths[sides] * (inner[sides] == 1)).sum(axis=1))
    is_closed = sum_up((uses[sides] == 1).any(axis=1)) == 0
    corners = surface.vertices[surface.faces[guesses]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normals, axis=1)
    facing, against = _ask_photos(corners.mean(axis=1), normals / np.maximum(size, 1e-300)[:, None], evidence)
    area = np.maximum(sum_up(size), 1e-300)
    is_narrow = area <= NARROW * rim * sum_up(steps[guesses]) / np.maximum(sum_up(np.ones(len(guesses))), 1.0)
    is_whole = is_closed & (sum_up(size * against) <= MOST_AGAINST * area)
    keep = np.ones(len(surface.faces), np.bool_)
    looked = sum_up(size * (facing > 0.0))
    is_faced = (looked >= LEAST_LOOKED * area) & (sum_up(size * facing) >= LEAST_FACING * looked)
    hides = _count_backs(surface, guesses, patch, evidence) > 0
    keep[guesses] = (is_whole & (is_narrow | is_faced | hides))[patch]
    return select_faces(surface, keep)


def _ask_photos(points: FloatArray, normals: FloatArray, evidence: Evidence) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return (N,) the largest cosine between the normal and the direction to a photo that shows nothing else there.

    Also return (N,) whether more photos see through the point. Points (N, 3) and unit normals (N, 3).
    """
    facing, looks = np.zeros(len(points)), np.zeros(len(points), np.int64)
    for view, verdict in zip(evidence.views, evidence.judge(points, normals), strict=True):
        ray = view.center - points
        cosine = (normals * ray).sum(axis=1) / np.linalg.norm(ray, axis=1)
        agrees = (verdict == CONFIRMED) | (verdict == EMPTY)
        facing[agrees] = np.maximum(facing[agrees], cosine[agrees])
        looks += agrees
        looks -= verdict == SEEN_THROUGH
    return facing, looks < 0


def _count_backs(
    surface: Surface, guesses: IndexArray, patch: NDArray[np.signedinteger], evidence: Evidence
) -> IndexArray:
    """Return how many more backs than fronts of triangles photos would see through each patch, in pixels.

    No photo can see the inside of a body. `patch` has the number of the patch of each guess.
    """
    measured, count = np.delete(surface.faces, guesses, axis=0), int(patch.max(initial=-1)) + 1

    def look(number: int) -> IndexArray:
        view = evidence.views[number].halve(HALVED)
        before, behind = (rasterize(surface.vertices, some, view) for some in (surface.faces[guesses], measured))
        hit = (before.face != NOTHING) & (before.depth < behind.depth) & np.isfinite(behind.depth)
        number_of, is_back = patch[before.face[hit]], behind.face[hit] == NOTHING
        return np.bincount(number_of[is_back], minlength=count) - np.bincount(number_of[~is_back], minlength=count)

    more = np.zeros(count, np.int64)
    for one in evidence.spread(look, range(len(evidence.views))):
        more += one
    return more


def smooth(surface: Surface) -> Surface:
    """Move vertices towards the mean of their neighbors, those of a border along it."""
    edges, edge_of = unique_edges(surface.faces)
    at_border = np.bincount(edge_of.ravel(), minlength=len(edges)) == 1
    is_border = np.zeros(len(surface.vertices), np.bool_)
    is_border[edges[at_border]] = True
    vertices = surface.vertices
    own, near = np.concatenate([edges, edges[:, ::-1]]).T
    used = ~is_border[own] | np.concatenate([at_border, at_border])
    own, near = own[used], near[used]
    count = np.maximum(np.bincount(own, minlength=len(vertices)), 1)
    for _ in range(SMOOTHING):
        mean = np.stack([np.bincount(own, axis[near], len(vertices)) for axis in vertices.T], axis=1) / count[:, None]
        vertices = 0.5 * (vertices + mean)
    return Surface(vertices, surface.faces, surface.colors)
