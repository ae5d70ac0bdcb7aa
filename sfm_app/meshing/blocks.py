"""Blocks of a large scene, and the weld of their meshes."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import select_faces, unique_edges
from sfm_app.meshing.cleaning import cut, make_manifold
from sfm_app.types import Surface
from sfm_app.types.arrays import FloatArray, IndexArray

# Blocks of points: boxes with about as many points each, the leaves of a k-d tree (Bentley, CACM 1975).

SAMPLE = 2_000_000
"""Points by which the blocks are laid out. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class Split:
    """A plane between two halves, each a block or split again."""

    axis: int
    at: float
    low: "Split | int"
    """Half with the smaller coordinates; a number is that of a block."""
    high: "Split | int"


@dataclass(frozen=True, slots=True, eq=False)
class Partition:
    """All space in blocks."""

    root: Split | int
    boxes: FloatArray
    """(B, 2, 3) lowest and highest coordinates of each block; infinite at the outside."""

    def find_blocks(self, points: FloatArray) -> NDArray[np.intp]:
        """Return (N,) the number of the block in which each point lies.

        Args:
            points: (N, 3).
        """
        found = np.empty(len(points), np.intp)
        waiting: list[tuple[Split | int, NDArray[np.intp]]] = [(self.root, np.arange(len(points)))]
        while waiting:
            node, inside = waiting.pop()
            if isinstance(node, Split):
                low = points[inside, node.axis] < node.at
                waiting += [(node.low, inside[low]), (node.high, inside[~low])]
            else:
                found[inside] = node
        return found

    def planes(self) -> list[tuple[int, float]]:
        """Return axis and coordinate of all planes between blocks, those of the first cuts first."""
        found, waiting = list[tuple[int, float]](), [self.root]
        while waiting:
            node = waiting.pop(0)
            if isinstance(node, Split):
                found.append((node.axis, node.at))
                waiting += [node.low, node.high]
        return found

    def near_planes(self, points: FloatArray, distance: float) -> NDArray[np.bool_]:
        """Return (N,) whether points lie close to a plane between blocks.

        Args:
            points: (N, 3).
        """
        near = np.zeros(len(points), np.bool_)
        for axis, at in self.planes():
            near |= np.abs(points[:, axis] - at) <= distance
        return near


def split_points(points: FloatArray, blocks: int) -> Partition:
    """Divide space into boxes with about as many points each, across their longest sides.

    Args:
        points: (N, 3).
        blocks: number of boxes, >= 1.
    """
    sample = points[:: max(1, len(points) // SAMPLE)]
    boxes: list[FloatArray] = []

    def grow(inside: FloatArray, box: FloatArray, count: int) -> Split | int:
        if count == 1 or len(inside) < 2:
            boxes.append(box)
            return len(boxes) - 1
        axis = int(np.argmax(np.percentile(inside, 99, axis=0) - np.percentile(inside, 1, axis=0)))
        left = count // 2
        at = float(np.quantile(inside[:, axis], left / count))
        below, above = box.copy(), box.copy()
        below[1, axis] = above[0, axis] = at
        low = inside[:, axis] < at
        return Split(axis, at, grow(inside[low], below, left), grow(inside[~low], above, count - left))

    whole = np.stack([np.full(3, -np.inf), np.full(3, np.inf)])
    root = grow(sample, whole, blocks)
    return Partition(root, np.stack(boxes))


# Two surfaces that overlap, cut along a plane and welded there into one.
#
# Both come from the same points, so that they nearly agree at the plane. Their borders there become one polyline:
# each vertex of the second border moves onto the first one, and takes the surface around it along, less and less
# with the distance; then each border gets the vertices of the other.

NONE = -1
REACH = 2.5
"""Distance in cells up to which the borders count as the same. Chosen by hand: simplification and noise move each by
less than one."""
SAME = 0.05
"""Share of a cell within which two vertices become one. Chosen by hand."""
STEP = 0.5
"""Distance in cells of the places on the first border at which the second one looks for it. Chosen by hand."""
NEAREST = 6
"""Places on the first border that each vertex compares. Chosen by hand."""
ROUNDS = 5
"""Rounds in which vertices in the wrong order become one. Chosen by hand: two are enough for noise of a third cell."""
LONGEST_CRACK = 24
"""Edges of a loop between the two borders that is closed; longer ones are holes of the surface. Chosen by hand."""


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
    """Join two surfaces at a plane: the first below it, the second above.

    Args:
        below: reaches beyond the plane.
        above: reaches beyond the plane.
        axis: 0, 1 or 2, across which the plane lies.

    Returns:
        The surface, and how many edges in the plane did not find their like.
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
    chains, same = _split_first(one, other, (moving, edge, share), vertices, SAME * cell)
    follow = _successors(chains)
    seconds, lost = _split_second(same[other.ends], follow, {int(same[v]) for v in moving})
    faces = same[both.faces]
    rest = np.ones(len(faces), np.bool_)
    rest[one.faces] = rest[other.faces] = False
    fans = _fans(faces, one, chains) + _fans(faces, other, seconds)
    found = np.concatenate([faces[rest], np.array(fans, np.int64).reshape(-1, 3)])
    cracks = _crack_fills(found, np.unique(np.concatenate([one.ends, other.ends])))
    joined = Surface(vertices, np.concatenate([found, cracks]), both.colors)
    return select_faces(joined, np.ones(len(joined.faces), np.bool_)), lost


def close_cracks(surface: Surface, at_planes: NDArray[np.bool_]) -> Surface:
    """Return the surface as an oriented manifold, with the short loops of open edges closed that touch a plane.

    Triangles that welding has folded are removed, and the hole that each leaves is closed with larger ones. Where one
    had two corners in one place, as planes that nearly touch leave them, these become one.

    Args:
        at_planes: (V,) which of its vertices may be at a crack.
    """
    found = make_manifold(Surface(surface.vertices, surface.faces, np.column_stack([surface.colors, at_planes])))
    for _ in range(ROUNDS):
        found = _join_same_places(found)
        fills = _crack_fills(found.faces, np.flatnonzero(found.colors[:, 3]))
        if not len(fills):
            break
        found = make_manifold(Surface(found.vertices, np.concatenate([found.faces, fills]), found.colors))
    return Surface(found.vertices, found.faces, found.colors[:, :3])


def _join_same_places(surface: Surface) -> Surface:
    """Return the surface with the ends of open edges at planes as one vertex where they lie in one place."""
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
    """Return the part of a surface on one side of a plane, and its border there.

    Args:
        axis: 0, 1 or 2, across which the plane lies.
    """
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
    """Find the place on the first border of each vertex of the second.

    Only edges that run in the opposite direction, as on the two sides of one surface, are compared.

    Returns:
        (M,) the vertices that have a place, (M,) the edge of the first border, (M,) share of the way along it,
        and (M, 3) the place.
    """
    from scipy.spatial import cKDTree

    starts, ways = vertices[one.ends[:, 0]], vertices[one.ends[:, 1]] - vertices[one.ends[:, 0]]
    steps = np.maximum(1, np.ceil(np.linalg.norm(ways, axis=1) / (STEP * cell))).astype(np.int64)
    of = np.repeat(np.arange(len(steps)), steps)
    along = (np.arange(len(of)) - np.repeat(np.cumsum(steps) - steps, steps) + 0.5) / steps[of]
    moving = np.unique(other.ends)
    heading = np.zeros((len(vertices), 3))
    for end in (0, 1):
        np.add.at(heading, other.ends[:, end], vertices[other.ends[:, 1]] - vertices[other.ends[:, 0]])
    near = cKDTree(starts[of] + along[:, None] * ways[of]).query(vertices[moving], min(NEAREST, len(of)))[1]
    edge = of[near.reshape(len(moving), -1)]
    length = np.maximum(np.einsum("ec,ec->e", ways, ways), 1e-300)
    share = np.einsum("mkc,mkc->mk", vertices[moving, None] - starts[edge], ways[edge]) / length[edge]
    share = np.clip(share, 0.0, 1.0)
    place = starts[edge] + share[..., None] * ways[edge]
    away = np.linalg.norm(vertices[moving, None] - place, axis=2)
    away[np.einsum("mc,mkc->mk", heading[moving], ways[edge]) >= 0.0] = np.inf
    best = np.argmin(away, axis=1)
    rows = np.flatnonzero(away[np.arange(len(moving)), best] <= REACH * cell)
    best = best[rows]
    return moving[rows], edge[rows, best], share[rows, best], place[rows, best]


def _drag(points: FloatArray, from_: FloatArray, shift: FloatArray, halo: float) -> FloatArray:
    """Return (N, 3) shifts of points near vertices that are shifted, falling linearly with the distance."""
    from scipy.spatial import cKDTree

    found = np.zeros_like(points)
    if len(from_):
        away, at = (np.asarray(part) for part in cKDTree(from_).query(points, distance_upper_bound=halo))
        near = np.isfinite(away)
        found[near] = shift[at[near]] * (1.0 - away[near] / halo)[:, None]
    return found


def _split_first(
    one: Border,
    other: Border,
    places: tuple[IndexArray, IndexArray, FloatArray],
    vertices: FloatArray,
    tiny: float,
) -> tuple[list[list[int]], IndexArray]:
    """Put the moved vertices between the ends of the edges of the first border.

    Where two of them would come in the wrong order, they become one.

    Args:
        places: (M,) moved vertices, and for each the edge of the first border, and the share of the way along it.
        vertices: (V, 3).

    Returns:
        Per edge its vertices in their order, and (V,) the vertex that each one has become.
    """
    moving, edge, share = places
    same = np.arange(len(vertices))
    taken, movable = set[int](), set(moving.tolist())
    ends = one.ends[edge]
    far = np.linalg.norm(vertices[ends] - vertices[moving][:, None], axis=2)
    for k in np.flatnonzero(far.min(axis=1) <= tiny):
        nearest = int(ends[k, np.argmin(far[k])])
        if nearest not in taken:
            taken.add(nearest)
            same[moving[k]] = nearest
    for _ in range(ROUNDS):
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


def _next_matched(start: int, follow: dict[int, int], matched: set[int]) -> int:
    """Return the next vertex of both borders after one; -1 where there is none."""
    at = start
    for _ in range(len(follow)):
        at = follow.get(at, NONE)
        if at == NONE or at in matched:
            return at
    return NONE


def _split_second(ends: IndexArray, follow: dict[int, int], matched: set[int]) -> tuple[list[list[int]], int]:
    """Find the vertices of the first border, backwards, along each edge of the second one.

    Args:
        ends: (E, 2) vertices of the edges of the second border.
        follow: next vertex of the first border after each one.
        matched: vertices of the second border that lie on the first.

    Returns:
        Per edge its vertices in their order, and how many edges have no counterpart.
    """
    chains, lost = [], 0
    for start, end in ends.tolist():
        way = [end]
        while (after := follow.get(way[-1])) is not None and len(way) <= len(follow):
            way.append(after)
            if after in matched:
                break
        found = start != end and way[-1] == start and end in matched
        chains.append(way[::-1] if found else [start, end])
        lost += not found and start != end
    return chains, lost


def _crack_fills(faces: IndexArray, at_plane: IndexArray) -> IndexArray:
    """Return (F, 3) triangles that close the short loops of open edges among the vertices at the plane."""
    edges, edge_of = unique_edges(faces)
    alone = (np.bincount(edge_of.ravel(), minlength=len(edges))[edge_of] == 1) & np.isin(faces, at_plane)
    alone &= np.isin(np.roll(faces, -1, axis=1), at_plane)
    face, side = np.nonzero(alone)
    follow: dict[int, list[int]] = {}
    for start, end in zip(faces[face, side].tolist(), faces[face, (side + 1) % 3].tolist(), strict=True):
        follow.setdefault(start, []).append(end)
    fills: list[tuple[int, int, int]] = []
    for first in sorted(follow):
        way = [first]
        while follow.get(way[-1]) and len(way) <= LONGEST_CRACK:
            way.append(follow[way[-1]].pop())
            if way[-1] in way[:-1]:
                loop = way[way.index(way[-1]) : -1]
                fills += [(loop[0], b, a) for a, b in pairwise(loop[1:])]
                way = way[: way.index(way[-1]) + 1]
    return np.array(fills, np.int64).reshape(-1, 3)


def _fans(faces: IndexArray, border: Border, chains: list[list[int]]) -> list[tuple[int, int, int]]:
    """Divide the triangles at a border at the vertices along their edges."""
    fans = []
    for face, side, chain in zip(border.faces, border.sides, chains, strict=True):
        top = int(faces[face, (side + 2) % 3])
        fans += [(a, b, top) for a, b in pairwise(chain) if len({a, b, top}) == 3]
    return fans
