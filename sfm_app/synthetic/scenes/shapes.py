"""Build triangle meshes of simple bodies, y up, counterclockwise seen from outside."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sfm_app.synthetic.cameras import axis_rotation

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Span = tuple[float, float, float, float, float, float]
"""From and to along x, along y and along z."""

BOX_SIDES = np.array([
    [[1, 0, 1], [1, 0, 0], [1, 1, 0], [1, 1, 1]],
    [[0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]],
    [[0, 1, 1], [1, 1, 1], [1, 1, 0], [0, 1, 0]],
    [[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]],
    [[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
])  # fmt: skip
"""Corners of a box, 0 for from and 1 for to along x, y and z, of its sides that face x, -x, y, -y and z."""


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Triangles with shading normals and texture coordinates."""

    vertices: FloatArray
    """(V, 3)."""
    faces: IndexArray
    """(T, 3) vertex indices."""
    normals: FloatArray
    """(V, 3) unit normals; vertices are doubled along sharp edges."""
    texture: FloatArray
    """(V, 3): vertices before the shape was moved into the scene, so that its texture moves with it."""

    def move(
        self, to: tuple[float, float, float] = (0.0, 0.0, 0.0), turn_deg: float = 0.0, tilt_deg: float = 0.0
    ) -> "Shape":
        """Tilt about x, then turn about y, then move.

        Args:
            to: translation along x, y and z.
            turn_deg: about y, right-handed.
            tilt_deg: about x, right-handed.
        """
        R = axis_rotation(np.array([0.0, 1.0, 0.0]), turn_deg) @ axis_rotation(np.array([1.0, 0.0, 0.0]), tilt_deg)
        return Shape(self.vertices @ R.T + to, self.faces, self.normals @ R.T, self.texture)


def box(width: float, height: float, depth: float, spacing: float = 0.15) -> Shape:
    """Return a box centered in x and z that stands on y = 0, its sides divided into squares.

    Args:
        width: along x.
        height: along y.
        depth: along z.
        spacing: approximate side of a square.
    """
    size = np.array([width, height, depth])
    parts = []
    for axis in range(3):
        # u x v = axis keeps the triangles counterclockwise
        u, v = (axis + 1) % 3, (axis + 2) % 3
        steps = [np.linspace(-0.5, 0.5, 1 + max(1, round(size[k] / spacing))) * size[k] for k in (u, v)]
        side, faces = grid(*steps)
        for sign in (1.0, -1.0):
            vertices = np.empty((len(side), 3))
            vertices[:, axis] = 0.5 * sign * size[axis]
            vertices[:, u], vertices[:, v] = side[:, 0], side[:, 1]
            parts.append((vertices, faces if sign > 0 else faces[:, ::-1]))
    return _build_shape([(vertices + np.array([0.0, height / 2, 0.0]), faces) for vertices, faces in parts])


def revolve(
    profile: FloatArray,
    segments: int = 64,
    span_deg: float = 360.0,
    sharp: bool = False,
    flutes: tuple[int, float] = (0, 0.0),
) -> Shape:
    """Return the surface of revolution of a profile about the y axis.

    Args:
        profile: (P, 2) radius and height; with height up, the outside lies to the right of the path from the first to
            the last point, so a vase runs from its foot to its lip and on down the inside.
        segments: steps around the axis.
        span_deg: how far around, in degrees; less than 360 leaves the ends open.
        sharp: whether the points of the profile are sharp edges.
        flutes: number of grooves around the axis, and their depth as a share of the radius.
    """
    strips = [profile[k : k + 2] for k in range(len(profile) - 1)] if sharp else [profile]
    return _build_shape([_revolve_profile(strip, segments, span_deg, flutes) for strip in strips])


def torus(radius: float, tube: float, span_deg: float = 360.0) -> Shape:
    """Return a ring of round section about the y axis, centered at the origin.

    Args:
        radius: from the axis to the middle of the tube.
        tube: radius of the tube.
        span_deg: how far around, in degrees.
    """
    angle = np.linspace(0.0, 2.0 * math.pi, 25)
    section = np.column_stack([radius + tube * np.cos(angle), tube * np.sin(angle)])
    return revolve(section, segments=max(8, round(span_deg / 5.0)), span_deg=span_deg)


def arch(radius: float, thickness: float, depth: float) -> Shape:
    """Return half a ring of square section standing on y = 0 across x, its back at z = 0.

    Args:
        radius: of the opening.
        thickness: of the ring, outwards.
        depth: along z.
    """
    inner, outer = radius, radius + thickness
    section = np.array([[inner, 0.0], [outer, 0.0], [outer, depth], [inner, depth], [inner, 0.0]])
    lying = revolve(section, segments=40, span_deg=180.0, sharp=True)
    # the ring lies on the ground in the half z <= 0; standing it up brings its height to +z
    R = axis_rotation(np.array([1.0, 0.0, 0.0]), 90.0)
    vertices = lying.vertices @ R.T
    return Shape(vertices, lying.faces, lying.normals @ R.T, vertices)


def ball(radius: float, segments: int = 96, bumps: float = 0.0, seed: int = 0) -> Shape:
    """Return a sphere around the origin.

    Args:
        radius: before the dents.
        segments: steps around the axis.
        bumps: depth of random dents as a share of the radius.
        seed: same seed, same dents.
    """
    angle = np.linspace(-0.5, 0.5, segments // 2 + 1) * math.pi
    round_ball = _revolve_profile(np.column_stack([np.cos(angle), np.sin(angle)]), segments, 360.0, (0, 0.0))
    dents = waves(round_ball[0], seed)
    return _build_shape([(round_ball[0] * radius * (1.0 + bumps * dents[:, None]), round_ball[1])])


def waves(points: FloatArray, seed: int) -> FloatArray:
    """Return (N,) smooth noise of unit variance: cosines in 24 directions with wavelengths of 0.7 to 3 units.

    Args:
        points: (N, 3).
        seed: same seed, same noise.
    """
    rng = np.random.default_rng([seed, 7])
    vectors = rng.normal(size=(24, 3)) * np.linspace(2.0, 9.0, 24)[:, None]
    found = np.cos(points @ vectors.T + rng.uniform(0.0, 2.0 * math.pi, 24)).sum(axis=1) / math.sqrt(12.0)
    return np.asarray(found)


def carve(
    field: Callable[[FloatArray], FloatArray],
    height: tuple[float, float],
    reach: float,
    rows: int = 220,
    segments: int = 240,
) -> Shape:
    """Return the outer surface of a body around the y axis, closed at the top and the bottom.

    It keeps only the outermost radius in each direction, so undercuts are lost.

    Args:
        field: positive inside the body at points (N, 3).
        height: lowest and highest level that is sampled.
        reach: the body lies within this distance of the axis.
        rows: levels.
        segments: steps around the axis.
    """
    angle = 2.0 * math.pi * np.arange(segments) / segments
    # turning from +x towards -z is right-handed about +y
    ways = np.column_stack([np.cos(angle), np.zeros(segments), -np.sin(angle)])
    levels = np.linspace(*height, rows)
    radius = np.stack([_outer_radius(field, ways, level, reach) for level in levels], axis=1)
    radius[:, [0, -1]] = 0.0
    vertices = ways[:, None] * radius[..., None] + np.array([0.0, 1.0, 0.0]) * levels[:, None]
    return _build_shape([(vertices.reshape(-1, 3), _strips(segments, rows, segments))])


def assemble(parts: Sequence[Shape]) -> Shape:
    """Join several shapes into one; the texture continues across the parts."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
    return Shape(vertices, faces, np.concatenate([part.normals for part in parts]), vertices)


def quads(corners: FloatArray) -> Shape:
    """Return flat quadrangles, each with corners of its own.

    Args:
        corners: (N, 4, 3), counterclockwise seen from outside; two may coincide.
    """
    across = np.cross(corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1])
    normals = across / np.linalg.norm(across, axis=1, keepdims=True)
    first = 4 * np.arange(len(corners))[:, None, None]
    faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    vertices = corners.reshape(-1, 3)
    return Shape(vertices, faces, np.repeat(normals, 4, axis=0), vertices)


def panels(spans: Sequence[Span]) -> Shape:
    """Return boxes whose sides are not divided, for small parts on a wall: nothing closes their backs.

    Args:
        spans: from and to along x, y and z of each; the back is at the lower z.
    """
    spread = np.asarray(spans, dtype=np.float64).reshape(-1, 3, 2)
    axes = np.arange(3)[None, None]
    return quads(spread[:, axes, BOX_SIDES].reshape(-1, 4, 3))


def plate(reach: tuple[float, float, float, float], holes: FloatArray, thickness: float, spacing: float) -> Shape:
    """Return an upright wall with holes, its front at z = 0: the front, and the reveals down to its thickness.

    Args:
        reach: from and to along x, and along y.
        holes: (N, 4) likewise.
        thickness: along -z.
        spacing: largest side of a division of the front.
    """
    x, y = (_cut(reach[k : k + 2], holes[:, k : k + 2], spacing) for k in (0, 2))
    u, v = np.meshgrid((x[1:] + x[:-1]) / 2, (y[1:] + y[:-1]) / 2, indexing="ij")
    solid = np.ones(u.shape, np.bool_)
    for left, right, low, high in holes:
        solid &= ~((u > left) & (u < right) & (v > low) & (v < high))
    around = np.pad(solid, 1)
    open_sides = (~around[2:, 1:-1], ~around[:-2, 1:-1], ~around[1:-1, 2:], ~around[1:-1, :-2], np.ones_like(solid))
    found = []
    for side, is_open in zip(BOX_SIDES, open_sides, strict=True):
        i, j = np.nonzero(solid & is_open)
        spread = np.stack([np.stack([x[i], x[i + 1]], -1), np.stack([y[j], y[j + 1]], -1)], axis=1)
        depth = np.broadcast_to([[[-thickness, 0.0]]], (len(i), 1, 2))
        found.append(np.concatenate([spread, depth], axis=1)[:, np.arange(3)[None], side])
    return quads(np.concatenate(found))


def _cut(reach: tuple[float, ...], holes: FloatArray, spacing: float) -> FloatArray:
    """Return the ends and the edges of holes along an axis, with steps of at most `spacing` between them."""
    inside = holes[(holes > reach[0]) & (holes < reach[1])]
    edges = np.unique(np.concatenate([np.array(reach), inside.ravel()]).round(6))
    steps = [np.linspace(a, b, max(1, math.ceil((b - a) / spacing)), endpoint=False) for a, b in pairwise(edges)]
    return np.concatenate([*steps, edges[-1:]])


def ground(x: tuple[float, float], z: tuple[float, float], unevenness: float, spacing: float = 0.1) -> Shape:
    """Return an uneven floor around y = 0.

    Args:
        x: from and to.
        z: from and to.
        unevenness: approximate largest height.
        spacing: approximate side of a square.
    """
    xs, zs = (np.linspace(a, b, 1 + max(1, round((b - a) / spacing))) for a, b in (x, z))
    floor, faces = grid(zs, xs)
    height = np.sin(1.3 * floor[:, 1] + 0.7) * np.sin(1.7 * floor[:, 0] + 2.1) + 0.5 * np.sin(3.1 * floor.sum(axis=1))
    return _build_shape([(np.column_stack([floor[:, 1], unevenness * height, floor[:, 0]]), faces)])


def _revolve_profile(
    profile: FloatArray, segments: int, span_deg: float, flutes: tuple[int, float]
) -> tuple[FloatArray, IndexArray]:
    closed = span_deg >= 360.0
    count = segments if closed else segments + 1
    angle = np.radians(span_deg) * np.arange(count) / segments
    radius = profile[None, :, 0] * (1.0 - flutes[1] * np.abs(np.sin(0.5 * flutes[0] * angle))[:, None])
    height = np.broadcast_to(profile[None, :, 1], radius.shape)
    # turning from +x towards -z is right-handed about +y
    vertices = np.stack([radius * np.cos(angle)[:, None], height, -radius * np.sin(angle)[:, None]], axis=-1)
    return vertices.reshape(-1, 3), _strips(segments, len(profile), count)


def _strips(segments: int, rows: int, count: int) -> IndexArray:
    """Return triangles between `segments` pairs of adjacent columns, of `count` columns with `rows` vertices each.

    The last column joins the first if `segments` equals `count`.
    """
    ring = np.arange(segments)[:, None] * rows + np.arange(rows - 1)
    step = (ring + rows) % (count * rows)
    faces = np.concatenate([np.stack([ring, step, step + 1], -1), np.stack([ring, step + 1, ring + 1], -1)])
    return faces.reshape(-1, 3)


def _outer_radius(
    field: Callable[[FloatArray], FloatArray], ways: FloatArray, level: float, reach: float, steps: int = 32
) -> FloatArray:
    """Return the radius (N,) at which rays from outside along -`ways` (N, 3) enter the body at a level.

    0 for rays that miss it.
    """

    def is_inside(radius: FloatArray) -> NDArray[np.bool_]:
        points = ways[:, None] * radius[..., None] + np.array([0.0, level, 0.0])
        return np.asarray(field(points.reshape(-1, 3)).reshape(radius.shape) > 0)

    radii = np.broadcast_to(np.linspace(reach, 0.0, steps + 1), (len(ways), steps + 1))
    found = is_inside(radii)
    at = found.argmax(axis=1)
    outer = np.take_along_axis(radii, np.maximum(at - 1, 0)[:, None], axis=1)
    inner = np.take_along_axis(radii, at[:, None], axis=1)
    for _ in range(8):
        middle = 0.5 * (outer + inner)
        is_in = is_inside(middle)
        inner, outer = np.where(is_in, middle, inner), np.where(is_in, outer, middle)
    return np.where(found.any(axis=1), inner[:, 0], 0.0)


def grid(a: FloatArray, b: FloatArray) -> tuple[FloatArray, IndexArray]:
    """Return the points (N, 2) of a grid, and two triangles (T, 3) for each of its squares.

    Args:
        a: steps along the first axis.
        b: steps along the second.
    """
    points = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
    corner = (np.arange(len(a) - 1)[:, None] * len(b) + np.arange(len(b) - 1)).ravel()
    right, up = corner + len(b), corner + 1
    return points, np.concatenate([np.stack([corner, right, right + 1], -1), np.stack([corner, right + 1, up], -1)])


def _build_shape(parts: list[tuple[FloatArray, IndexArray]]) -> Shape:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + start for (_, faces), start in zip(parts, starts[:-1], strict=True)])
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    kept = np.linalg.norm(cross, axis=1) > 1e-12  # drops degenerate triangles at the poles of a revolved profile
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[kept, k], cross[kept])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.tile([0.0, 1.0, 0.0], (len(normals), 1)), where=length > 0)
    return Shape(vertices, faces[kept], normals, vertices)
