"""Bodies of a scene: triangle meshes, and procedural colors of their surfaces.

Meshes have y up and are counterclockwise seen from outside. A color depends only on the position on the body, so it is
the same from every side; kernels compute it, with detail at every scale. Detail finer than a pixel would alias and is
faded out.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numba import uint32

from sfm_app.jit import kernel
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray


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
    """(V, 3): vertices before `move`, so that the texture moves with the shape."""

    def move(
        self, to: tuple[float, float, float] = (0.0, 0.0, 0.0), turn_deg: float = 0.0, tilt_deg: float = 0.0
    ) -> "Shape":
        """Return the shape tilted about x, then turned about y, then translated."""
        R = axis_rotation(np.array([0.0, 1.0, 0.0]), turn_deg) @ axis_rotation(np.array([1.0, 0.0, 0.0]), tilt_deg)
        return Shape(self.vertices @ R.T + to, self.faces, self.normals @ R.T, self.texture)


def box(width: float, height: float, depth: float, spacing: float = 0.15) -> Shape:
    """Return a box centered in x and z that stands on y = 0, its sides divided into squares."""
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
    profile: FloatArray, segments: int = 64, span_deg: float = 360.0, sharp: bool = False,
    flutes: tuple[int, float] = (0, 0.0),
) -> Shape:  # fmt: skip
    """Return the surface of revolution of a profile (P, 2), radius and height, about the y axis.

    With height up, the outside lies to the right of the path from the first to the last point: a vase runs from its
    foot to its lip and down the inside. `sharp` makes the points edges; `flutes` are the number of grooves around the
    axis, and their depth as a share of the radius.
    """
    strips = [profile[k : k + 2] for k in range(len(profile) - 1)] if sharp else [profile]
    return _build_shape([_revolve_profile(strip, segments, span_deg, flutes) for strip in strips])


def torus(radius: float, tube: float, span_deg: float = 360.0) -> Shape:
    """Return a ring of round section about the y axis, centered at the origin."""
    angle = np.linspace(0.0, 2.0 * math.pi, 25)
    section = np.column_stack([radius + tube * np.cos(angle), tube * np.sin(angle)])
    return revolve(section, segments=max(8, round(span_deg / 5.0)), span_deg=span_deg)


def arch(radius: float, thickness: float, depth: float) -> Shape:
    """Return half a ring of square section standing on y = 0 across x, its back at z = 0."""
    inner, outer = radius, radius + thickness
    section = np.array([[inner, 0.0], [outer, 0.0], [outer, depth], [inner, depth], [inner, 0.0]])
    lying = revolve(section, segments=40, span_deg=180.0, sharp=True)
    # the ring lies on the ground in the half z <= 0; standing it up brings its height to +z
    R = axis_rotation(np.array([1.0, 0.0, 0.0]), 90.0)
    vertices = lying.vertices @ R.T
    return Shape(vertices, lying.faces, lying.normals @ R.T, vertices)


def ball(radius: float, segments: int = 96, bumps: float = 0.0, seed: int = 0) -> Shape:
    """Return a sphere around the origin; `bumps` is the depth of random dents as a share of the radius."""
    angle = np.linspace(-0.5, 0.5, segments // 2 + 1) * math.pi
    round_ball = _revolve_profile(np.column_stack([np.cos(angle), np.sin(angle)]), segments, 360.0, (0, 0.0))
    dents = waves(round_ball[0], seed)
    return _build_shape([(round_ball[0] * radius * (1.0 + bumps * dents[:, None]), round_ball[1])])


def waves(points: FloatArray, seed: int) -> FloatArray:
    """Return (N,) smooth noise of unit variance: cosines in 24 directions with wavelengths of 0.7 to 3 units."""
    rng = np.random.default_rng([seed, 7])
    vectors = rng.normal(size=(24, 3)) * np.linspace(2.0, 9.0, 24)[:, None]
    cosines = np.cos(points @ vectors.T + rng.uniform(0.0, 2.0 * math.pi, 24))
    return np.asarray(cosines.sum(axis=1) / math.sqrt(12.0))


def carve(
    field: Callable[[FloatArray], FloatArray], height: tuple[float, float], reach: float, rows: int = 220,
    segments: int = 240,
) -> Shape:  # fmt: skip
    """Return the outer surface of a body around the y axis, closed at the top and the bottom.

    It keeps only the outermost radius in each direction, so undercuts are lost. The field is positive inside the body
    at points (N, 3), which is within `reach` of the axis.
    """
    angle = 2.0 * math.pi * np.arange(segments) / segments
    # turning from +x towards -z is right-handed about +y
    directions = np.column_stack([np.cos(angle), np.zeros(segments), -np.sin(angle)])
    levels = np.linspace(*height, rows)
    radius = np.stack([_outer_radius(field, directions, level, reach) for level in levels], axis=1)
    radius[:, [0, -1]] = 0.0
    vertices = directions[:, None] * radius[..., None] + np.array([0.0, 1.0, 0.0]) * levels[:, None]
    return _build_shape([(vertices.reshape(-1, 3), _strips(segments, rows, segments))])


def ground(x: tuple[float, float], z: tuple[float, float], unevenness: float, spacing: float = 0.1) -> Shape:
    """Return an uneven floor around y = 0."""
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
    field: Callable[[FloatArray], FloatArray], directions: FloatArray, level: float, reach: float, steps: int = 32
) -> FloatArray:
    """Return the radius (N,) at which rays along -`directions` (N, 3) enter the body at a level; 0 for misses."""

    def is_inside(radius: FloatArray) -> BoolArray:
        points = directions[:, None] * radius[..., None] + np.array([0.0, level, 0.0])
        return np.asarray(field(points.reshape(-1, 3)).reshape(radius.shape) > 0)

    radii = np.broadcast_to(np.linspace(reach, 0.0, steps + 1), (len(directions), steps + 1))
    inside = is_inside(radii)
    at = inside.argmax(axis=1)
    outer = np.take_along_axis(radii, np.maximum(at - 1, 0)[:, None], axis=1)
    inner = np.take_along_axis(radii, at[:, None], axis=1)
    for _ in range(8):
        middle = 0.5 * (outer + inner)
        is_in = is_inside(middle)
        inner, outer = np.where(is_in, middle, inner), np.where(is_in, outer, middle)
    return np.where(inside.any(axis=1), inner[:, 0], 0.0)


def grid(a: FloatArray, b: FloatArray) -> tuple[FloatArray, IndexArray]:
    """Return the points (N, 2) of a grid, and two triangles (T, 3) for each of its squares."""
    points = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
    return points, _strips(len(a) - 1, len(b), len(a))


def _stack(parts: Sequence[tuple[FloatArray, IndexArray]]) -> tuple[FloatArray, IndexArray]:
    """Return the vertices of several meshes, and their triangles."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, starts[:-1], strict=True)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def _build_shape(parts: list[tuple[FloatArray, IndexArray]]) -> Shape:
    vertices, faces = _stack(parts)
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    proper = np.linalg.norm(cross, axis=1) > 1e-12  # not at the poles of a revolved profile
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[proper, k], cross[proper])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, length, out=np.tile([0.0, 1.0, 0.0], (len(normals), 1)), where=length > 0)
    return Shape(vertices, faces[proper], normals, vertices)


Color = tuple[int, int, int]
Pattern = Literal["stone", "brick", "paving", "ceramic", "wood", "marble", "leaves", "stripes", "masonry"]
PATTERNS: tuple[str, ...] = get_args(Pattern)


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """Procedural color of a body. Colors are sRGB, 0..255."""

    pattern: Pattern
    base: Color
    second: Color
    """Color of veins, bands, grain and dirt."""
    joint: Color = (70, 66, 60)
    """Color between bricks and slabs, and of thin lines."""
    scale: float = 0.3
    """Size of a brick, slab, leaf or band, in scene units."""
    contrast: float = 0.5
    """Strength of the fine grain, 0..1."""
    shine: float = 0.0
    """Share of the light that brushed metal reflects, 0..1: it moves with the camera."""

    def row(self, seed: int) -> FloatArray:
        """Return the (14,) parameters for the kernels: pattern, scale, contrast, seed, linear RGB colors, shine."""
        colors = [(np.array(c) / 255.0) ** 2.2 for c in (self.base, self.second, self.joint)]
        return np.concatenate([[PATTERNS.index(self.pattern), self.scale, self.contrast, seed], *colors, [self.shine]])


@kernel
def lattice(ix: int, iy: int, iz: int, seed: int) -> float:
    """Return a pseudo-random number in [0, 1) for a lattice point; wraps after 2^32."""
    h = uint32(ix) * uint32(0x8DA6B343) ^ uint32(iy) * uint32(0xD8163841)
    h = uint32(h ^ uint32(iz) * uint32(0xCB1AB31F) ^ uint32(seed) * uint32(0x165667B1))
    h = uint32((h ^ (h >> uint32(15))) * uint32(0x2C1B3C6D))
    h = uint32((h ^ (h >> uint32(12))) * uint32(0x297A2D39))
    h = uint32(h ^ (h >> uint32(15)))
    return float(h) * (1.0 / 4294967296.0)


@kernel
def value_noise(x: float, y: float, z: float, seed: int) -> float:
    """Return smooth noise in [-1, 1) on the unit lattice (Perlin's interpolation of lattice values)."""
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    u, v, w = x - fx, y - fy, z - fz
    u, v, w = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v), w * w * (3.0 - 2.0 * w)
    total = 0.0
    for dz in range(2):
        low = lattice(ix, iy, iz + dz, seed) * (1.0 - u) + lattice(ix + 1, iy, iz + dz, seed) * u
        high = lattice(ix, iy + 1, iz + dz, seed) * (1.0 - u) + lattice(ix + 1, iy + 1, iz + dz, seed) * u
        total += (low * (1.0 - v) + high * v) * (w if dz else 1.0 - w)
    return 2.0 * total - 1.0


@kernel
def octaves(p: tuple[float, float, float], size: float, gain: float, footprint: float, seed: int) -> float:
    """Return noise summed over halving sizes, from `size` down to the size of a pixel; about -1..1.

    Args:
        p: position (x, y, z).
        size: of the broadest noise, > 0.
        gain: amplitude of each octave over the one before, in (0, 1).
        footprint: size of a pixel on the surface; octaves fade out between twice that size and that size.
    """
    total = 0.0
    amplitude = 1.0
    turn = seed
    while size > footprint and turn < seed + 10:
        fade = min(1.0, size / footprint - 1.0)
        total += amplitude * fade * value_noise(p[0] / size, p[1] / size, p[2] / size, turn)
        amplitude *= gain
        size *= 0.5
        turn += 1
    return total * (1.0 - gain) * 2.0


@kernel
def cells(a: float, b: float, seed: int) -> tuple[float, float]:
    """Return border distance and number, in [0, 1), of the cell at a point, for random cells in the plane."""
    ia, ib = math.floor(a), math.floor(b)
    first, second, name = 9.0, 9.0, 0.0
    for i in range(ia - 1, ia + 2):
        for j in range(ib - 1, ib + 2):
            da = i + 0.15 + 0.7 * lattice(i, j, 1, seed) - a
            db = j + 0.15 + 0.7 * lattice(i, j, 2, seed) - b
            d = math.sqrt(da * da + db * db)
            if d < first:
                first, second, name = d, first, lattice(i, j, 3, seed)
            elif d < second:
                second = d
    return 0.5 * (second - first), name


@kernel
def bricks(a: float, b: float, seed: int) -> tuple[float, float]:
    """Return border distance and number as `cells` does, for bricks twice as long as high in running bond."""
    row = math.floor(b)
    a = 0.5 * a + 0.5 * (row % 2.0)
    column = math.floor(a)
    border = min(2.0 * (a - column), 2.0 * (column + 1.0 - a), b - row, row + 1.0 - b)
    return border, lattice(column, row, 4, seed)


@kernel
def _ramp(x: float, low: float, high: float) -> float:
    return min(1.0, max(0.0, (x - low) / (high - low)))


@kernel
def tiles(
    kind: int, p: tuple[float, float, float], n: tuple[float, float, float], scale: float, seed: int
) -> tuple[float, float]:
    """Return border distance and number as `cells` does, for the tile pattern of a kind at a point with a unit normal.

    Bricks on upright walls (1), slabs on the ground (2), leaves along the axis they face most (6), and bricks of bodies
    that may have been turned (8), whose walls run along x or z.
    """
    if kind == 6:
        if abs(n[1]) >= max(abs(n[0]), abs(n[2])):
            return cells(p[0] / scale, p[2] / scale, seed)
        return cells(p[1] / scale, (p[2] if abs(n[0]) >= abs(n[2]) else p[0]) / scale, seed)
    wobble = 0.06 * value_noise(3.0 * p[0] / scale, 3.0 * p[1] / scale, 3.0 * p[2] / scale, seed)
    if kind == 2:
        return cells(p[0] / scale + wobble, p[2] / scale + wobble, seed)
    along = p[0] if abs(n[2]) >= abs(n[0]) else p[2]
    if kind == 8:  # the normal turns with the body, and its texture does not
        along = p[0] + p[2]
    return bricks(along / scale + wobble, p[1] / scale + wobble, seed)


@kernel
def ceramic(p: tuple[float, float, float], scale: float) -> tuple[float, float]:
    """Return the shares of the second color (glaze) and of thin lines on Greek pottery, in bands of one height."""
    band = p[1] / scale
    row = math.floor(band)
    inside = band - row
    turn = (math.atan2(p[2], p[0]) / (2.0 * math.pi) + 0.5) * 24.0
    line = 1.0 - _ramp(min(inside, 1.0 - inside), 0.03, 0.06)
    part = turn - math.floor(turn)
    kind = row % 4
    if kind == 0:
        return 1.0, line
    if kind == 1:  # zigzag
        return _ramp(abs(2.0 * part - 1.0) - inside, -0.05, 0.05), line
    if kind == 2:  # rays and dots of uneven size
        reach = 0.22 + 0.2 * lattice(math.floor(turn), row, 5, 17)
        return 1.0 - _ramp(math.hypot(part - 0.5, inside - 0.5) - reach, -0.04, 0.04), line
    steps = math.floor(4.0 * part)  # meander
    wall = (steps == 0.0) or (steps == 2.0 and inside > 0.3) or (inside > 0.75 and steps < 3.0)
    return 1.0 if wall else 0.0, line


@kernel
def mixture(
    row: FloatArray, p: tuple[float, float, float], n: tuple[float, float, float], footprint: float
) -> tuple[float, float, float]:
    """Return shares of the second and the joint color, and brightness (about 1), at a point of a body before `move`."""
    kind, scale, contrast, seed = int(row[0]), row[1], row[2], int(row[3])
    fine = octaves(p, 0.4 * scale, 0.72, footprint, seed + 20)
    broad = octaves(p, 3.0 * scale, 0.5, max(footprint, 0.7 * scale), seed + 40)
    bright = 1.0 + contrast * (1.7 * fine + 0.4 * broad)
    if kind == 0:  # stone: stains and dark pores
        second = _ramp(broad + 0.6 * fine, -0.3, 0.9)
        joint = 0.8 * _ramp(octaves(p, 0.09 * scale, 0.75, footprint, seed + 60), 0.3, 0.55)
    elif kind <= 2 or kind == 8:
        border, name = tiles(kind, p, n, scale, seed)
        blur = footprint / scale
        joint = 1.0 - _ramp(border, 0.04 - 0.5 * blur, 0.06 + 0.5 * blur)
        second = name + 0.4 * fine
        bright *= 0.8 + 0.4 * ((7.0 * name) % 1.0)
    elif kind == 3:
        second, joint = ceramic(p, scale)
        second *= 1.0 - 0.25 * _ramp(fine, 0.1, 0.5)
    elif kind == 4:  # wood: rings about the z axis, bent by noise; planks by height
        r = math.hypot(p[0] + 0.3 * scale * broad, p[1] - 2.0 * scale) / scale
        rings = 6.0 * r + 1.5 * octaves((p[0], p[1], 0.2 * p[2]), 0.5 * scale, 0.6, footprint, seed)
        second = 0.5 + 0.5 * math.sin(2.0 * math.pi * rings) + 0.3 * fine
        plank = 2.0 * p[1] / scale
        joint = 1.0 - _ramp(min(plank - math.floor(plank), math.floor(plank) + 1.0 - plank), 0.02, 0.05)
        bright *= 0.8 + 0.4 * lattice(math.floor(plank), 3, 0, seed)
    elif kind == 5:  # marble: thin veins where bent planes cross the body
        wave = (p[0] + 0.7 * p[1] + 0.4 * p[2]) / scale + 2.2 * octaves(p, scale, 0.6, footprint, seed)
        second = (1.0 - abs(math.sin(math.pi * wave))) ** 3
        joint = 0.5 * _ramp(octaves(p, 0.5 * scale, 0.6, footprint, seed + 80), 0.3, 0.7)
    elif kind == 6:
        border, name = tiles(kind, p, n, scale, seed)
        second, joint = name, 1.0 - _ramp(border, 0.0, 0.14)
        bright *= 0.7 + 0.6 * ((5.0 * name) % 1.0)
    else:  # stripes around the y axis, worn off in places
        turn = (math.atan2(p[2], p[0]) / (2.0 * math.pi) + 0.5) * 8.0
        second = float(math.floor(turn) % 2)
        joint = 0.8 * _ramp(broad + fine, 0.25, 0.5)
    return min(1.0, max(0.0, second)), joint, max(0.15, bright)


@dataclass(frozen=True, slots=True)
class Body:
    """One object in a scene. Bodies of one material differ in texture: their index in the scene seeds it."""

    shape: Shape
    material: Material


@dataclass(frozen=True, slots=True)
class SyntheticScene:
    """Bodies under a fixed light; y up, scene units are about meters."""

    name: str
    bodies: tuple[Body, ...]
    to_light: tuple[float, float, float] = (0.45, 0.75, 0.5)
    """Direction towards the sun, any length."""
    sun: float = 0.95
    """Brightness of the sun on a surface that faces it."""
    sky: float = 0.5
    """Brightness of the sky on a surface that faces up."""

    bounced: float = 0.0
    """Share of the sky's light on places without sky in view, such as panes in deep windows; 0..1."""

    thin: tuple[FloatArray, ...] = ()
    """Lines (N, 4) of thin things: points on their axes, and the radius there."""

    @property
    def vertices(self) -> FloatArray:
        """(V, 3) vertices of all bodies."""
        return np.concatenate([body.shape.vertices for body in self.bodies])

    @property
    def faces(self) -> IndexArray:
        """(T, 3) vertex indices of all bodies."""
        return _stack([(body.shape.vertices, body.shape.faces) for body in self.bodies])[1]
