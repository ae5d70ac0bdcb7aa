"""The surface between what photos see through and what they see: a minimum cut of tetrahedra.

Labatut, Pons and Keriven (Computer Graphics Forum 2009): points become a Delaunay tetrahedralization. The line of sight
from a photo to a point says that the tetrahedra before the point are free, and that the one behind it is full. The cut
with the least contradiction is a closed surface; where photos show nothing, it is small.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import number_vertices
from sfm_app.jit import inlined_kernel, kernel
from sfm_app.meshing.min_cut import sink_side
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray, IndexArray


class OPTIONS:
    """Distances and weights of the cut."""

    spacing_px = 2.5
    """Distance of the points in pixels of the depth maps, as in OpenMVS. Chosen on `statue`: 1.8 shows no more."""
    sigma = 0.3
    """Uncertainty of a point along a line of sight, in distances of the points: less than a pixel. Chosen on `railing`,
    where 1 loses the rods."""
    behind = 1.5
    """Standard deviations behind a point at which it is full. Chosen on `railing`: 3 loses rods."""
    beta = 1.0
    """Weight of the shape of the triangles, in lines of sight. Chosen on `statue`: 0.3 is not better."""
    lines = 2
    """Most lines of sight of a point; each stands for as many as there are. Chosen on `railing`: 4 is not better."""


UNIT = 256.0
"""Capacity of one line of sight: integers have the same sum in any order."""
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Corners of the face opposite to each corner, counter-clockwise seen from outside."""


JITTER = 1e-5
"""Largest shift of a point for the tetrahedra, in distances of points. By definition: rounding is far below."""
FAR = 30.0 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
"""Corners of a tetrahedron around all points, in extents of these. Chosen on castle-P19: at 3, they reach into a court
whose ground is flat and unknown, and open it."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points on surfaces, about as dense as depth maps can tell apart."""

    points: FloatArray
    """(N, 3)."""
    normals: FloatArray
    """(N, 3) unit, towards the photos."""
    colors: NDArray[np.uint8]
    """(N, 3) RGB."""
    step: FloatArray
    """(N,) distance to the next points."""

    def select(self, keep: NDArray[np.bool_]) -> "Cloud":
        """Return the marked points (N,)."""
        return Cloud(self.points[keep], self.normals[keep], self.colors[keep], self.step[keep])


def thin(points: FloatArray, normals: FloatArray, colors: NDArray[np.uint8], step: FloatArray) -> Cloud:
    """Return the means of the points (N, 3) in cubes whose sides are the powers of two closest to their steps (N,)."""
    level = np.rint(np.log2(step)).astype(np.int64)
    cells = np.floor(points / np.exp2(level)[:, None]).astype(np.int64)
    keys = np.column_stack([level, cells])
    _, own, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    own = own.ravel()

    def mean(values: NDArray[np.generic]) -> FloatArray:
        return np.stack([np.bincount(own, column, len(count)) for column in values.T], axis=1) / count[:, None]

    normal = mean(normals)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    steps = np.bincount(own, step, len(count)) / count
    return Cloud(mean(points), normal, np.rint(mean(colors)).astype(np.uint8), steps)


class Sights(NamedTuple):
    """Lines of sight from photos to points."""

    point: IndexArray
    """(L,)."""
    center: FloatArray
    """(L, 3) center of the photo."""
    weight: NDArray[np.float32]
    """(L,) photos for which the line stands."""


def choose_sights(seen: Sequence[IndexArray], centers: FloatArray, count: int, most: int = OPTIONS.lines) -> Sights:
    """Choose lines of sight to `count` points, at most `most` for each, evenly among the photos that see it.

    `seen` has the points that each photo sees, each once, `centers` (P, 3) the centers of the photos.
    """
    total, number = np.bincount(np.concatenate(seen), minlength=count), np.zeros(count, np.int64)
    used = np.minimum(total, most)
    points, photos = list[IndexArray](), list[IndexArray]()
    for photo, at in enumerate(seen):
        step = number[at] * used[at]
        chosen = (step + used[at]) // total[at] > step // total[at]
        number[at] += 1
        points.append(at[chosen])
        photos.append(np.full(len(points[-1]), photo))
    point = np.concatenate(points)
    return Sights(point, centers[np.concatenate(photos)], (total[point] / used[point]).astype(np.float32))


class Cells(NamedTuple):
    """A Delaunay tetrahedralization."""

    points: FloatArray
    """(N, 3)."""
    corners: NDArray[np.int32]
    """(T, 4) points; FACES has the face opposite to each."""
    neighbors: NDArray[np.int32]
    """(T, 4) tetrahedra opposite to each corner, -1 outside the hull."""
    starts: IndexArray
    """(N + 1,) where the tetrahedra around each point begin."""
    around: NDArray[np.int32]
    """Tetrahedra around the points."""


def cut_surface(cloud: Cloud, sights: Sights, *, close: bool = False) -> tuple[Surface, FloatArray]:
    """Return the cut, oriented, and (V,) the points' steps; open where it leads beyond all points, unless `close`."""
    from scipy.spatial import Delaunay

    origin, scale = cloud.points.mean(axis=0), float(np.ptp(cloud.points, axis=0).max())
    # flat tetrahedra have no outside: none is exactly flat
    jitter = JITTER * np.random.default_rng(0).uniform(-1.0, 1.0, cloud.points.shape) * cloud.step[:, None]
    # tetrahedra behind every point, also on the convex hull
    points = np.concatenate([(cloud.points + jitter - origin) / scale, FAR])
    raw = Delaunay(points)
    _orient(points, raw.simplices, raw.neighbors)
    cells = Cells(points, raw.simplices, raw.neighbors, *_find_around(raw.simplices, len(points)))
    crossed, ends = np.zeros(cells.corners.shape, np.float32), np.zeros(len(cells.corners), np.float32)
    sight = Sights(sights.point, (sights.center - origin) / scale, sights.weight)
    _cast(cells, sight, OPTIONS.sigma * cloud.step / scale, OPTIONS.behind, crossed, ends)
    _add_shape(cells, OPTIONS.beta, crossed)
    capacity = np.rint(np.minimum(UNIT * crossed, 2.0**30)).astype(np.int32)
    excess = np.rint(UNIT * ends).astype(np.int64)
    if close:
        excess[(cells.corners >= len(cloud.points)).any(axis=1)] += 2**40  # beyond all points is free
    full = sink_side(cells.neighbors, capacity, excess)
    faces, vertices = _extract(cells, full)
    used, faces = number_vertices(faces[(vertices[faces] < len(cloud.points)).all(axis=1)])
    at = vertices[used]
    return Surface(cloud.points[at], faces, cloud.colors[at]), cloud.step[at]


@kernel
def _find_around(corners: NDArray[np.int32], count: int) -> tuple[IndexArray, NDArray[np.int32]]:
    """Return where the tetrahedra around each of `count` points begin, and their numbers."""
    starts = np.zeros(count + 1, np.int64)
    for t in range(len(corners)):
        for k in range(4):
            starts[corners[t, k] + 1] += 1
    for v in range(count):
        starts[v + 1] += starts[v]
    at, around = starts[:-1].copy(), np.empty(starts[-1], np.int32)
    for t in range(len(corners)):
        for k in range(4):
            v = corners[t, k]
            around[at[v]] = t
            at[v] += 1
    return starts, around


@kernel
def _orient(points: FloatArray, corners: NDArray[np.int32], neighbors: NDArray[np.int32]) -> None:
    """Turn all tetrahedra so that the normals of their faces, by FACES, point outwards."""
    n = np.empty(3)
    for t in range(len(corners)):
        a = _face_normal(points, corners, t, 0, n)
        inwards = 0.0
        for c in range(3):
            inwards += n[c] * (points[corners[t, 0], c] - points[a, c])
        if inwards > 0:
            corners[t, 2], corners[t, 3] = corners[t, 3], corners[t, 2]
            neighbors[t, 2], neighbors[t, 3] = neighbors[t, 3], neighbors[t, 2]


@inlined_kernel
def _face_normal(points: FloatArray, corners: NDArray[np.int32], t: int, k: int, n: FloatArray) -> int:
    """Fill in the normal of a face, twice its area long, outwards; return a corner of it."""
    a, b, c = corners[t, FACES[k, 0]], corners[t, FACES[k, 1]], corners[t, FACES[k, 2]]
    ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    n[0], n[1], n[2] = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    return int(a)


@kernel
def _cast(
    cells: Cells, sights: Sights, sigma: FloatArray, behind: float, crossed: NDArray[np.float32],
    ends: NDArray[np.float32],
) -> None:  # fmt: skip
    """Add the lines of sight; `sigma` (N,) is the uncertainty of the points.

    `crossed` (T, 4) has those from a tetrahedron to its neighbors, in the direction of sight, and `ends` (T,) those
    that begin in it less those that end.
    """
    d, n = np.empty(3), np.empty(3)
    for line in range(len(sights.point)):
        v, weight = sights.point[line], sights.weight[line]
        for c in range(3):
            d[c] = sights.center[line, c] - cells.points[v, c]
        distance = np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        d /= distance
        _walk(cells, v, d, n, distance, sigma[v], weight, crossed, ends)
        d *= -1.0
        _walk(cells, v, d, n, behind * sigma[v], sigma[v], -weight, crossed, ends)


@inlined_kernel
def _walk(  # noqa: PLR0913
    cells: Cells, v: int, d: FloatArray, n: FloatArray, reach: float, sigma: float, weight: float,
    crossed: NDArray[np.float32], ends: NDArray[np.float32],
) -> None:  # fmt: skip
    """Follow a line from a point in the direction d, towards the photo, or away where the weight is negative.

    Close to the point, faces count less.
    """
    points, corners, neighbors = cells.points, cells.corners, cells.neighbors
    t, came, gone = _first(cells, v, d, n), -1, 0.0
    for _ in range(len(corners) if t >= 0 else 0):
        leave, farther = -1, np.inf
        for k in range(4):
            if (came < 0 and corners[t, k] != v) or (came >= 0 and neighbors[t, k] == came):
                continue
            a = _face_normal(points, corners, t, k, n)
            slope = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
            if slope <= 0.0:
                continue
            height = 0.0
            for c in range(3):
                height += n[c] * (points[a, c] - points[v, c])
            if height / slope < farther:
                leave, farther = k, height / slope
        if leave < 0:
            return
        gone, after = max(gone, farther), neighbors[t, leave]
        if gone >= reach or after < 0:
            ends[t] += weight
            return
        share = abs(weight) * (1.0 - np.exp(-0.5 * (gone / sigma) ** 2))
        if weight < 0.0:
            crossed[t, leave] += share
        else:
            for k in range(4):
                if neighbors[after, k] == t:
                    crossed[after, k] += share
        came, t = t, after


@inlined_kernel
def _first(cells: Cells, v: int, d: FloatArray, n: FloatArray) -> int:
    """Return the tetrahedron that a direction enters from a point, -1 where it leaves the hull."""
    best, least = -1, 1e-7
    for at in range(cells.starts[v], cells.starts[v + 1]):
        t, most = cells.around[at], -np.inf
        for k in range(4):
            if cells.corners[t, k] != v:
                _face_normal(cells.points, cells.corners, t, k, n)
                slope = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
                most = max(most, slope / np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2] + 1e-300))
        if most < least:
            best, least = t, most
    return best


@kernel
def _add_shape(cells: Cells, beta: float, crossed: NDArray[np.float32]) -> None:
    """Add to each face up to 2 beta by one less the smaller cosine of its angles with the circumspheres at both sides.

    It is small within a dense surface, and large across space (Labatut 2009).
    """
    points, corners, neighbors = cells.points, cells.corners, cells.neighbors
    center, radius, n = np.empty((len(corners), 3)), np.empty(len(corners)), np.empty(3)
    for t in range(len(corners)):
        _circumsphere(points, corners, t, center, radius)
    for t in range(len(corners)):
        for k in range(4):
            a, other = _face_normal(points, corners, t, k, n), neighbors[t, k]
            size = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) + 1e-300
            own, opposite = 0.0, 0.0
            for c in range(3):
                own += n[c] * (points[a, c] - center[t, c])
                if other >= 0:
                    opposite += n[c] * (center[other, c] - points[a, c])
            cosine = own / (size * radius[t])
            if other >= 0:
                cosine = min(cosine, opposite / (size * radius[other]))
            crossed[t, k] += beta * (1.0 - max(min(cosine, 1.0), -1.0))


@inlined_kernel
def _circumsphere(
    points: FloatArray, corners: NDArray[np.int32], t: int, center: FloatArray, radius: FloatArray
) -> None:
    """Fill in the center and radius.

    From the corner of the edges p, q, r, the center is at (|p|^2 q x r + |q|^2 r x p + |r|^2 p x q) / (2 p . q x r).
    """
    a, b, c, d = corners[t]
    px, py, pz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
    qx, qy, qz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
    rx, ry, rz = points[d, 0] - points[a, 0], points[d, 1] - points[a, 1], points[d, 2] - points[a, 2]
    pp, qq, rr = px * px + py * py + pz * pz, qx * qx + qy * qy + qz * qz, rx * rx + ry * ry + rz * rz
    ax, ay, az = qy * rz - qz * ry, qz * rx - qx * rz, qx * ry - qy * rx
    bx, by, bz = ry * pz - rz * py, rz * px - rx * pz, rx * py - ry * px
    cx, cy, cz = py * qz - pz * qy, pz * qx - px * qz, px * qy - py * qx
    whole = 2.0 * (px * ax + py * ay + pz * az)
    whole = whole if abs(whole) > 1e-300 else 1e-300
    x, y, z = (pp * ax + qq * bx + rr * cx), (pp * ay + qq * by + rr * cy), (pp * az + qq * bz + rr * cz)
    x, y, z = x / whole, y / whole, z / whole
    center[t, 0], center[t, 1], center[t, 2] = points[a, 0] + x, points[a, 1] + y, points[a, 2] + z
    radius[t] = max(np.sqrt(x * x + y * y + z * z), 1e-300)


def _extract(cells: Cells, full: NDArray[np.bool_]) -> tuple[IndexArray, IndexArray]:
    """Return the faces (F, 3) between full and free tetrahedra, outwards, and (V,) the point of each vertex.

    Triangles around an edge belong together by the full tetrahedra between them: parts of the surface that only touch
    at an edge or a point do not share vertices there.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    t, k = np.nonzero(full[:, None] & (cells.neighbors >= 0) & ~full[np.maximum(cells.neighbors, 0)])
    number, joined = np.full(cells.corners.shape, -1, np.int32), np.empty((6 * len(t), 2), np.int64)
    number[t, k] = np.arange(len(t))
    one, other = joined[: _join_corners(cells, full, number, t, k, joined)].T
    graph = coo_array((np.ones(len(one), np.bool_), (one, other)), (3 * len(t), 3 * len(t)))
    _, vertex = connected_components(graph, directed=False)
    points = np.empty(int(vertex.max(initial=-1)) + 1, np.int64)
    points[vertex] = np.take_along_axis(cells.corners[t], FACES[k], axis=1).ravel()
    return vertex.reshape(-1, 3).astype(np.int64), points


@kernel
def _join_corners(
    cells: Cells, full: NDArray[np.bool_], number: NDArray[np.int32], tetrahedra: IndexArray, sides: IndexArray,
    joined: IndexArray,
) -> int:  # fmt: skip
    """Fill in pairs of corners (3 f + i) of faces that are one vertex; return how many.

    From each edge of a face, the way leads around the edge through full tetrahedra to the next face. `number` (T, 4)
    has the number of each face; face f is opposite to corner `sides[f]` of `tetrahedra[f]`.
    """
    corners, neighbors, count = cells.corners, cells.neighbors, 0
    for f in range(len(tetrahedra)):
        for i in range(3):
            t, inner = tetrahedra[f], sides[f]
            first, second = corners[t, FACES[inner, i]], corners[t, FACES[inner, (i + 1) % 3]]
            opposite = FACES[inner, (i + 2) % 3]  # the next face around the edge lies opposite to the third corner
            while neighbors[t, opposite] >= 0 and full[neighbors[t, opposite]]:
                kept, after = corners[t, inner], neighbors[t, opposite]
                for j in range(4):
                    if neighbors[after, j] == t:
                        entry = j
                for j in range(4):
                    if corners[after, j] == kept:
                        opposite = j
                t, inner = after, entry
            if neighbors[t, opposite] < 0:
                continue  # the surface ends at the hull
            g = number[t, opposite]
            for j in range(3):
                v = corners[t, FACES[opposite, j]]
                if v == first:
                    joined[count, 0], joined[count, 1] = 3 * f + i, 3 * g + j
                    count += 1
                elif v == second:
                    joined[count, 0], joined[count, 1] = 3 * f + (i + 1) % 3, 3 * g + j
                    count += 1
    return count
