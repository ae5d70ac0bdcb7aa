"""Blocks of a large scene, and the weld of their meshes.

Blocks are boxes with about as many points each, the leaves of a k-d tree (Bentley, CACM 1975). The surfaces of two
blocks overlap; each is cut at the plane between them. Both come from the same points, so that they nearly agree there.
The weld makes one polyline of the two borders: each vertex of the second border moves onto the first, and takes the
surface around it along, less with the distance; then each border gets the vertices of the other.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import select_faces, unique_edges
from sfm_app.meshing.cleaning import cut, make_manifold
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray, IndexArray


@dataclass(frozen=True, slots=True)
class Split:
    """A plane between two halves, each a block or split again."""

    axis: int
    at: float
    low: "Split | int"
    """Half with the smaller coordinates; an integer is a block."""
    high: "Split | int"


@dataclass(frozen=True, slots=True, eq=False)
class Partition:
    """All space in blocks."""

    root: Split | int
    boxes: FloatArray
    """(B, 2, 3) lowest and highest coordinates of each block; infinite at the outside."""

    def find_blocks(self, points: FloatArray) -> NDArray[np.intp]:
        """Return (N,) the number of the block in which each point lies; points (N, 3)."""
        blocks = np.empty(len(points), np.intp)
        waiting: list[tuple[Split | int, NDArray[np.intp]]] = [(self.root, np.arange(len(points)))]
        while waiting:
            node, inside = waiting.pop()
            if isinstance(node, Split):
                low = points[inside, node.axis] < node.at
                waiting += [(node.low, inside[low]), (node.high, inside[~low])]
            else:
                blocks[inside] = node
        return blocks

    def planes(self) -> list[tuple[int, float]]:
        """Return axis and coordinate of all planes between blocks, those of the first cuts first."""
        planes, waiting = list[tuple[int, float]](), [self.root]
        while waiting:
            node = waiting.pop(0)
            if isinstance(node, Split):
                planes.append((node.axis, node.at))
                waiting += [node.low, node.high]
        return planes

    def near_planes(self, points: FloatArray, distance: float) -> NDArray[np.bool_]:
        """Return (N,) whether points lie close to a plane between blocks; points (N, 3)."""
        near = np.zeros(len(points), np.bool_)
        for axis, at in self.planes():
            near |= np.abs(points[:, axis] - at) <= distance
        return near


def split_points(points: FloatArray, blocks: int) -> Partition:
    """Divide space into `blocks` >= 1 boxes with about as many points (N, 3) each, across their longest sides."""
    sample = points[:: max(1, len(points) // 2_000_000)]  # enough to place the planes
    boxes: list[FloatArray] = []

    def grow(inside: FloatArray, box: FloatArray, count: int) -> Split | int:
        if count == 1 or len(inside) < 2:
            boxes.append(box)
            return len(boxes) - 1
        axis = int(np.argmax(np.percentile(inside, 99, axis=0) - np.percentile(inside, 1, axis=0)))
        half = count // 2
        at = float(np.quantile(inside[:, axis], half / count))
        below, above = box.copy(), box.copy()
        below[1, axis] = above[0, axis] = at
        low = inside[:, axis] < at
        return Split(axis, at, grow(inside[low], below, half), grow(inside[~low], above, count - half))

    whole = np.stack([np.full(3, -np.inf), np.full(3, np.inf)])
    root = grow(sample, whole, blocks)
    return Partition(root, np.stack(boxes))


@dataclass(frozen=True, slots=True)
class WeldOptions:
    """Distances and limits of a weld; lengths in cells."""

    reach: float = 2.5
    """Distance up to which the borders count as the same. Chosen by hand: simplification and noise move each by less
    than 1."""
    same: float = 0.05
    """Distance within which two vertices become one. Chosen by hand."""
    step: float = 0.5
    """Distance of the candidates on the first border for a vertex of the second. Chosen by hand."""
    nearest: int = 6
    """Candidates for each vertex. Chosen by hand."""
    rounds: int = 5
    """Rounds in which vertices in the wrong order become one. Chosen by hand: two suffice for noise of a third cell."""
    longest_crack: int = 24
    """Most edges of a crack between the two borders; longer loops are holes of the surface. Chosen by hand."""


WELD = WeldOptions()


@dataclass(frozen=True, slots=True, eq=False)
class Border:
    """Edges of a surface that lie in the plane, each with its triangle on the surface's side."""

    faces: IndexArray
    """(E,) triangle of each edge."""
    sides: IndexArray
    """(E,) the edge runs from this corner of the triangle to the next."""
    ends: IndexArray
    """(E, 2) vertices from which and to which it runs along the triangle."""


def weld(below: Surface, above: Surface, axis: int, at: float, cell: float, halo: float) -> tuple[Surface, int]:
    """Join two surfaces at a plane; return the surface, and the number of edges in the plane without counterpart.

    Both reach beyond the plane, whose normal is axis 0, 1 or 2. The second is deformed up to the distance `halo` from
    it; `cell` is the side of the finest cells of both.
    """
    first, one = cut_at_plane(below, axis, at, keep_below=True)
    second, other = cut_at_plane(above, axis, at, keep_below=False)
    both = Surface(
        np.concatenate([first.vertices, second.vertices]),
        np.concatenate([first.faces, second.faces + len(first.vertices)]),
        np.concatenate([first.colors, second.colors]),
    )
    other = Border(other.faces + len(first.faces), other.sides, other.ends + len(first.vertices))
    if not len(one.ends) or not len(other.ends):
        return both, len(one.ends) + len(other.ends)
    moving, edge, share, place = _match(both.vertices, one, other, cell)
    vertices = both.vertices.copy()
    own = np.arange(len(first.vertices), len(vertices))
    vertices[own] += _drag(vertices[own], vertices[moving], place - vertices[moving], halo)
    vertices[moving] = place
    chains, same = _split_first(one, other, moving, edge, share, vertices, WELD.same * cell)
    follow = _successors(chains)
    seconds, open_edges = _split_second(same[other.ends], follow, {int(same[v]) for v in moving})
    faces = same[both.faces]
    rest = np.ones(len(faces), np.bool_)
    rest[one.faces] = rest[other.faces] = False
    fans = _fans(faces, one, chains) + _fans(faces, other, seconds)
    faces = np.concatenate([faces[rest], np.array(fans, np.int64).reshape(-1, 3)])
    cracks = _crack_fills(faces, np.unique(np.concatenate([one.ends, other.ends])))
    joined = Surface(vertices, np.concatenate([faces, cracks]), both.colors)
    return select_faces(joined, np.ones(len(joined.faces), np.bool_)), open_edges


def close_cracks(surface: Surface, at_planes: NDArray[np.bool_]) -> Surface:
    """Return the surface as an oriented manifold, and close the short loops of open edges at planes.

    Triangles that welding has folded are removed, and the holes of these are closed with larger ones. Vertices in one
    place, as planes that nearly touch have them, become one.

    `at_planes` (V,) marks vertices that may be at a crack.
    """
    mesh = make_manifold(Surface(surface.vertices, surface.faces, np.column_stack([surface.colors, at_planes])))
    for _ in range(WELD.rounds):
        mesh = _join_same_places(mesh)
        fills = _crack_fills(mesh.faces, np.flatnonzero(mesh.colors[:, 3]))
        if not len(fills):
            break
        mesh = make_manifold(Surface(mesh.vertices, np.concatenate([mesh.faces, fills]), mesh.colors))
    return Surface(mesh.vertices, mesh.faces, mesh.colors[:, :3])


def _join_same_places(surface: Surface) -> Surface:
    """Join the ends of open edges that lie in one place at a plane; the fourth color marks vertices at planes."""
    edges, edge_of = unique_edges(surface.faces)
    ends = np.unique(edges[np.bincount(edge_of.ravel(), minlength=len(edges)) == 1])
    ends = ends[surface.colors[ends, 3] != 0]
    _, first, place = np.unique(surface.vertices[ends], axis=0, return_index=True, return_inverse=True)
    same = np.arange(len(surface.vertices))
    same[ends] = ends[first[place.ravel()]]
    if (same == np.arange(len(same))).all():
        return surface
    return make_manifold(Surface(surface.vertices, same[surface.faces], surface.colors))


def cut_at_plane(surface: Surface, axis: int, at: float, *, keep_below: bool) -> tuple[Surface, Border]:
    """Return the part of a surface on one side of a plane, normal to axis 0, 1 or 2, and its border there."""
    inside = (at - surface.vertices[:, axis]) * (1.0 if keep_below else -1.0)
    part = cut(surface, inside)
    if not len(part.faces):
        return part, Border(*(np.empty(shape, np.int64) for shape in (0, 0, (0, 2))))
    vertices, heights = part.vertices.copy(), part.vertices[:, axis]
    on_plane = np.abs(heights - at) <= 1e-9 * max(1.0, abs(at), float(np.abs(heights).max()))
    vertices[on_plane, axis] = at
    _, edge_of = unique_edges(part.faces)
    alone = np.bincount(edge_of.ravel())[edge_of] == 1
    after = np.roll(part.faces, -1, axis=1)
    faces, sides = np.nonzero(alone & on_plane[part.faces] & on_plane[after])
    ends = np.stack([part.faces[faces, sides], after[faces, sides]], axis=1)
    _, first = np.unique(faces, return_index=True)  # a triangle has one edge there, unless it lies in the plane
    return Surface(vertices, part.faces, part.colors), Border(faces[first], sides[first], ends[first])


def _match(
    vertices: FloatArray, one: Border, other: Border, cell: float
) -> tuple[IndexArray, IndexArray, FloatArray, FloatArray]:
    """Find the place of each vertex of the second border on edges of the first that run in the opposite direction.

    Return (M,) the vertices that have a place, (M,) the edge of the first border, (M,) share of the way along it, and
    (M, 3) the place.
    """
    from scipy.spatial import cKDTree

    starts, edges = vertices[one.ends[:, 0]], vertices[one.ends[:, 1]] - vertices[one.ends[:, 0]]
    steps = np.maximum(1, np.ceil(np.linalg.norm(edges, axis=1) / (WELD.step * cell))).astype(np.int64)
    of = np.repeat(np.arange(len(steps)), steps)
    share = (np.arange(len(of)) - np.repeat(np.cumsum(steps) - steps, steps) + 0.5) / steps[of]
    moving = np.unique(other.ends)
    heading = np.zeros((len(vertices), 3))
    for end in (0, 1):
        np.add.at(heading, other.ends[:, end], vertices[other.ends[:, 1]] - vertices[other.ends[:, 0]])
    near = cKDTree(starts[of] + share[:, None] * edges[of]).query(vertices[moving], min(WELD.nearest, len(of)))[1]
    edge = of[near.reshape(len(moving), -1)]
    length = np.maximum(np.einsum("ec,ec->e", edges, edges), 1e-300)
    share = np.einsum("mkc,mkc->mk", vertices[moving, None] - starts[edge], edges[edge]) / length[edge]
    share = np.clip(share, 0.0, 1.0)
    place = starts[edge] + share[..., None] * edges[edge]
    distance = np.linalg.norm(vertices[moving, None] - place, axis=2)
    distance[np.einsum("mc,mkc->mk", heading[moving], edges[edge]) >= 0.0] = np.inf
    best = np.argmin(distance, axis=1)
    rows = np.flatnonzero(distance[np.arange(len(moving)), best] <= WELD.reach * cell)
    best = best[rows]
    return moving[rows], edge[rows, best], share[rows, best], place[rows, best]


def _drag(points: FloatArray, centers: FloatArray, shift: FloatArray, halo: float) -> FloatArray:
    """Return (N, 3) shifts of points around shifted centers, falling linearly with the distance to 0 at the halo."""
    from scipy.spatial import cKDTree

    shifts = np.zeros_like(points)
    if len(centers):
        distance, at = (np.asarray(part) for part in cKDTree(centers).query(points, distance_upper_bound=halo))
        near = np.isfinite(distance)
        shifts[near] = shift[at[near]] * (1.0 - distance[near] / halo)[:, None]
    return shifts


def _split_first(
    one: Border, other: Border, moving: IndexArray, edge: IndexArray, share: FloatArray, vertices: FloatArray,
    tolerance: float,
) -> tuple[list[list[int]], IndexArray]:  # fmt: skip
    """Insert the moved vertices into the edges of the first border; two in the wrong order become one.

    `share` (M,) is the position of a moved vertex along its edge; within the tolerance, it becomes an end of the edge.
    Return per edge its vertices in order, and (V,) the vertex that replaces each one.
    """
    same = np.arange(len(vertices))
    used, movable = set[int](), set(moving.tolist())
    ends = one.ends[edge]
    distance = np.linalg.norm(vertices[ends] - vertices[moving][:, None], axis=2)
    for k in np.flatnonzero(distance.min(axis=1) <= tolerance):
        nearest = int(ends[k, np.argmin(distance[k])])
        if nearest not in used:
            used.add(nearest)
            same[moving[k]] = nearest
    for _ in range(WELD.rounds):
        alone = np.flatnonzero(same[moving] == moving)
        chains = [[int(a), int(b)] for a, b in one.ends]
        for k in alone[np.lexsort((share[alone], edge[alone]))]:
            chains[edge[k]].insert(len(chains[edge[k]]) - 1, int(moving[k]))
        follow, matched = _successors(chains), {int(same[v]) for v in moving}
        turned = [
            (start, end)
            for start, end in same[other.ends].tolist()
            if start != end and start in matched and _next_matched(start, follow, matched) == end
        ]
        turned = [(a, b) for a, b in turned if _next_matched(b, follow, matched) != a]
        if not turned:
            break
        for pair in turned:
            start, end = same[list(pair)].tolist()
            first, last = (start, end) if start in movable else (end, start)
            same[same == first] = last
    return chains, same


def _successors(chains: list[list[int]]) -> dict[int, int]:
    """Return the next vertex of the first border after each one."""
    return {a: b for chain in chains for a, b in pairwise(chain)}


def _next_matched(start: int, follow: dict[int, int], matched: set[int]) -> int | None:
    """Return the next vertex of both borders after one."""
    at: int | None = start
    for _ in range(len(follow)):
        at = None if at is None else follow.get(at)
        if at is None or at in matched:
            return at
    return None


def _split_second(ends: IndexArray, follow: dict[int, int], matched: set[int]) -> tuple[list[list[int]], int]:
    """Find the vertices of the first border, backwards, along each edge of the second one.

    `follow` is the next vertex of the first border after each one, `matched` the vertices of the second that lie on it.
    Return per edge its vertices in their order, and how many edges have no counterpart.
    """
    chains, open_edges = [], 0
    for start, end in ends.tolist():
        chain = [end]
        while (after := follow.get(chain[-1])) is not None and len(chain) <= len(follow):
            chain.append(after)
            if after in matched:
                break
        matches = start != end and chain[-1] == start and end in matched
        chains.append(chain[::-1] if matches else [start, end])
        open_edges += not matches and start != end
    return chains, open_edges


def _crack_fills(faces: IndexArray, at_plane: IndexArray) -> IndexArray:
    """Return (F, 3) triangles that close the short loops of open edges between vertices at the plane."""
    edges, edge_of = unique_edges(faces)
    alone = (np.bincount(edge_of.ravel(), minlength=len(edges))[edge_of] == 1) & np.isin(faces, at_plane)
    alone &= np.isin(np.roll(faces, -1, axis=1), at_plane)
    face, side = np.nonzero(alone)
    follow: dict[int, list[int]] = {}
    for start, end in zip(faces[face, side].tolist(), faces[face, (side + 1) % 3].tolist(), strict=True):
        follow.setdefault(start, []).append(end)
    fills: list[tuple[int, int, int]] = []
    for first in sorted(follow):
        path = [first]
        while follow.get(path[-1]) and len(path) <= WELD.longest_crack:
            path.append(follow[path[-1]].pop())
            if path[-1] in path[:-1]:
                loop = path[path.index(path[-1]) : -1]
                fills += [(loop[0], b, a) for a, b in pairwise(loop[1:])]
                path = path[: path.index(path[-1]) + 1]
    return np.array(fills, np.int64).reshape(-1, 3)


def _fans(faces: IndexArray, border: Border, chains: list[list[int]]) -> list[tuple[int, int, int]]:
    """Divide the triangles at a border at the vertices along their edges."""
    fans = []
    for face, side, chain in zip(border.faces, border.sides, chains, strict=True):
        top = int(faces[face, (side + 2) % 3])
        fans += [(a, b, top) for a, b in pairwise(chain) if len({a, b, top}) == 3]
    return fans
