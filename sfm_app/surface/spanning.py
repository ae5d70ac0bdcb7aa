"""The surface through fused points: what photos see is kept, and gaps are closed where they see nothing else."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.dense import read_depth
from sfm_app.colmap.surface import positions
from sfm_app.geometry.triangles import select_faces, unique_edges
from sfm_app.jit import kernel
from sfm_app.meshing.ray_casting import Occluders
from sfm_app.meshing.tetrahedra import OPTIONS, Cloud, choose_sights, cut_surface, thin
from sfm_app.meshing.visibility import CONFIRMED, SEEN_THROUGH, SKY, judge
from sfm_app.stereo import View
from sfm_app.tasks import Spread
from sfm_app.types import Surface
from sfm_app.types.arrays import DepthArray, FloatArray, IndexArray

GAP = 8.0
"""Longest edge of a measured triangle, in distances of points: longer ones close a gap."""
SMOOTHING = 3
"""Steps of smoothing: the cut passes through points with noise. Chosen by hand."""
LEAST_CONFIRMED = 200
"""Points that a photo has to confirm to take part in the refinement of a block. Chosen by hand."""
LEAST_SEEN = 0.1
"""Least share of a patch over a hole that photos show: the underside of a table has none. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Depth maps as evidence for and against points."""

    dense_dir: Path
    views: Sequence[View]
    tolerance: float
    """Relative difference in depth within which a photo confirms a point."""
    spread: Spread = map

    def depth(self, view: View) -> DepthArray:
        """Return a depth map."""
        return read_depth(self.dense_dir, view, "geometric")

    def judge(self, cloud: Cloud) -> list[tuple[IndexArray, IndexArray]]:
        """Return for each photo the points that it confirms, and those that it sees through."""

        def look(view: View) -> tuple[IndexArray, IndexArray]:
            verdict = judge(cloud.points, cloud.normals, view, self.depth(view), view.sample_px, self.tolerance)
            return np.flatnonzero(verdict == CONFIRMED), np.flatnonzero(verdict == SEEN_THROUGH)

        return list(self.spread(look, self.views))


def gather(records: NDArray[np.void], views: Sequence[View]) -> Cloud:
    """Return the fused points (N,), from `open_points`, about as dense as the depth maps tell them apart."""
    points = positions(records)
    pixel = np.full(len(points), np.inf)
    for view in views:
        _shrink_pixels(points, view.projection, np.array([view.width, view.height]), view.focal_px, pixel)
    near = np.isfinite(pixel)
    normals, colors = (
        np.stack([records[name][near] for name in names], axis=1)
        for names in (("nx", "ny", "nz"), ("red", "green", "blue"))
    )
    return thin(points[near], normals.astype(np.float64), colors, OPTIONS.spacing_px * pixel[near])


@kernel
def _shrink_pixels(
    points: FloatArray, P: FloatArray, size: NDArray[np.int64], focal_px: float, pixel: FloatArray
) -> None:
    """Lower `pixel` (N,) to the side of a pixel at each point in view."""
    for k in range(len(points)):
        z = P[2, 0] * points[k, 0] + P[2, 1] * points[k, 1] + P[2, 2] * points[k, 2] + P[2, 3]
        if z <= 0.0 or z / focal_px >= pixel[k]:
            continue
        x = P[0, 0] * points[k, 0] + P[0, 1] * points[k, 1] + P[0, 2] * points[k, 2] + P[0, 3]
        y = P[1, 0] * points[k, 0] + P[1, 1] * points[k, 1] + P[1, 2] * points[k, 2] + P[1, 3]
        if 0.0 <= x <= size[0] * z and 0.0 <= y <= size[1] * z:
            pixel[k] = z / focal_px


def span(
    cloud: Cloud, evidence: Evidence, *, close: bool = False, context: Cloud | None = None
) -> tuple[Surface, list[View]]:
    """Return the surface through points, and the photos that confirm enough of them; `close` keeps what no photo sees.

    Lines of sight to the points of `context` pass through the surface of these, too.
    """
    own = len(cloud.points)
    if context is not None:
        cloud = Cloud(*(np.concatenate([getattr(one, name) for one in (cloud, context)]) for name in Cloud.__slots__))
    judged = evidence.judge(cloud)
    witnesses = [
        view
        for view, (seen, _) in zip(evidence.views, judged, strict=True)
        if np.count_nonzero(seen < own) >= LEAST_CONFIRMED
    ]
    for_it, against = np.zeros(len(cloud.points), np.int64), np.zeros(len(cloud.points), np.int64)
    for seen, through in judged:
        for_it[seen] += 1
        against[through] += 1
    kept = (for_it > 0) & (against <= for_it)
    if np.count_nonzero(kept) < 5:
        return Surface(np.empty((0, 3)), np.empty((0, 3), np.int64), np.empty((0, 3), np.uint8)), witnesses
    number, cloud = np.cumsum(kept) - 1, cloud.select(kept)
    centers = np.stack([view.center for view in evidence.views])
    sights = choose_sights([number[seen[kept[seen]]] for seen, _ in judged], centers, len(cloud.points))
    surface, step = cut_surface(cloud, sights)
    return smooth(surface if close else drop_guesses(surface, step, evidence)), witnesses


def drop_guesses(surface: Surface, step: FloatArray, evidence: Evidence) -> Surface:
    """Drop triangles that are longer than the gaps of points, except where they close a hole that photos look at.

    `step` (V,) is the distance of the points at each vertex. A group of such triangles stays if measured ones surround
    it, and photos show a part of it that is no sky.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges, edge_of = unique_edges(surface.faces)
    lengths = np.linalg.norm(surface.vertices[edges[:, 0]] - surface.vertices[edges[:, 1]], axis=1)
    is_guess = lengths[edge_of].max(axis=1) > GAP * step[surface.faces].min(axis=1)
    guesses = np.flatnonzero(is_guess)
    sides = edge_of[guesses].ravel()
    order = np.argsort(sides, kind="stable")
    same = np.flatnonzero(sides[order][1:] == sides[order][:-1])
    one, other = order[same] // 3, order[same + 1] // 3
    size = len(guesses)
    count, patch = connected_components(coo_array((np.ones(len(one)), (one, other)), (size, size)), directed=False)
    at_end = (np.bincount(edge_of.ravel(), minlength=len(edges))[edge_of[guesses]] == 1).any(axis=1)
    ends = np.bincount(patch, at_end, count) > 0
    looked_at, area = look_at(surface, guesses, evidence)
    share = np.bincount(patch, area * looked_at, count) / np.maximum(np.bincount(patch, area, count), 1e-300)
    keep = ~is_guess
    keep[guesses] = ((share > LEAST_SEEN) & ~ends)[patch]
    return select_faces(surface, keep)


def look_at(surface: Surface, faces: IndexArray, evidence: Evidence) -> tuple[NDArray[np.bool_], FloatArray]:
    """Return (N,) whether a photo shows the middle of triangles, most of them no sky there, and (N,) their areas."""
    corners = surface.vertices[surface.faces[faces]]
    middle, normal = corners.mean(axis=1), np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(normal, axis=1)
    seen, sky = np.zeros(len(faces), np.int64), np.zeros(len(faces), np.int64)
    occluders = Occluders(surface.vertices, surface.faces)
    for view in evidence.views:
        ray = view.center - middle
        x, y, z = (middle @ view.projection[:, :3].T + view.projection[:, 3]).T
        shown = (z > 0) & (x >= 0) & (y >= 0) & (x < view.width * z) & (y < view.height * z)
        shown &= (normal * ray).sum(axis=1) > 0.0
        at = np.flatnonzero(shown)
        slack = 1e-4 * float(np.linalg.norm(ray[at], axis=1).min(initial=np.inf))
        at = at[~occluders.is_hidden(view.center, slack, middle[at])] if len(at) else at
        depth = evidence.depth(view)
        rows, columns = depth.shape
        row = np.minimum((y[at] / z[at] * rows / view.height).astype(np.int64), rows - 1)
        column = np.minimum((x[at] / z[at] * columns / view.width).astype(np.int64), columns - 1)
        seen[at] += 1
        sky[at] += depth[row, column] == SKY
    return (seen > 0) & (2 * sky <= seen), area


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
