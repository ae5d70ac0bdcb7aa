"""Scenes with detail of a five hundredth of their size: a carved wall, a railing with a tree, a garden."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from benchmarks.synthetic.houses import assemble
from sfm_app.synthetic.cameras import ArcOptions, Camera, Views, arc
from sfm_app.synthetic.scenes import BRICK, LEAVES, LIMESTONE, PAVING, SANDSTONE, TERRACOTTA, WOOD
from sfm_app.synthetic.shapes import Body, Material, Shape, SyntheticScene, ball, box, grid, ground, revolve

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

Height = Callable[[FloatArray, FloatArray], FloatArray]
"""Returns the height above the plane z = 0 at x and y."""


def relief(height: Height, width: float, high: float, spacing: float) -> Shape:
    """Return a relief that faces +z, centered in x and standing on y = 0; nothing closes its back.

    Args:
        height: above the plane z = 0, at arrays x and y of one shape.
        width: along x.
        high: along y.
        spacing: approximate side of a square of its grid.
    """
    columns, rows = (1 + max(1, round(size / spacing)) for size in (width, high))
    plane, faces = grid(np.linspace(-width / 2, width / 2, columns), np.linspace(0.0, high, rows))
    x, y = plane.T.reshape(2, columns, rows)
    z = height(x, y)
    up_x, up_y = np.gradient(z, width / (columns - 1), high / (rows - 1))
    normals = np.stack([-up_x, -up_y, np.ones_like(z)], -1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    return Shape(vertices, faces, normals, vertices)


def tube(line: FloatArray, segments: int = 10) -> Shape:
    """Return a round tube along a line, pointed at both ends.

    Args:
        line: (N, 4) points and the radius there, N >= 2; bends less than a right angle from point to point.
        segments: sides of its section.
    """
    path, radius = line[:, :3], line[:, 3]
    ways = np.gradient(path, axis=0)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    side = np.empty_like(ways)
    side[0] = np.cross(ways[0], np.eye(3)[np.argmin(np.abs(ways[0]))])
    for k in range(1, len(path)):  # carried along without turning about the line
        side[k] = side[k - 1] - (side[k - 1] @ ways[k]) * ways[k]
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = 2.0 * math.pi * np.arange(segments) / segments
    around = np.cross(ways, side)
    out = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * around[:, None]
    rings = path[:, None] + radius[:, None, None] * out
    count = len(path) * segments
    vertices = np.concatenate([rings.reshape(-1, 3), path[[0, -1]]])
    normals = np.concatenate([out.reshape(-1, 3), [-ways[0], ways[-1]]])
    return Shape(vertices, _tube_faces(len(path), segments, count), normals, vertices)


def _tube_faces(rings: int, segments: int, first_end: int) -> IndexArray:
    here = np.arange(segments)
    there = (here + 1) % segments
    start = segments * np.arange(rings - 1)[:, None]
    a, b, c, d = start + here, start + there, start + segments + here, start + segments + there
    sides = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)]).reshape(-1, 3)
    last = segments * (rings - 1)
    low = np.stack([np.full(segments, first_end), there, here], -1)
    high = np.stack([np.full(segments, first_end + 1), last + here, last + there], -1)
    return np.concatenate([sides, low, high])


def ridge(distance: FloatArray, width: float) -> FloatArray:
    """Return the profile of a rounded ridge: 1 in the middle, 0 from half its width on.

    Args:
        distance: from its middle line, >= 0.
        width: of its foot.
    """
    return np.asarray(np.sqrt(np.maximum(1.0 - (2.0 * distance / width) ** 2, 0.0)))


def pebbles(x: FloatArray, y: FloatArray, size: tuple[float, float], spacing: float, seed: int) -> FloatArray:
    """Return the height (..., ) of gravel: flattened balls at random places, the highest of which shows.

    Args:
        x, y: positions, arrays of one shape.
        size: smallest and largest radius.
        spacing: mean distance of their middles.
        seed: same seed, same gravel.
    """
    rng = np.random.default_rng([seed, 41])
    low, high = np.array([x.min(), y.min()]), np.array([x.max(), y.max()])
    count = int(np.prod(high - low) / spacing**2)
    middles, radii = rng.uniform(low, high, (count, 2)), rng.uniform(*size, count)
    sunk = radii * rng.uniform(0.1, 0.6, count)
    found = np.zeros_like(x)
    steps = (high - low) / (np.array(x.shape) - 1)
    for middle, radius, depth in zip(middles, radii, sunk, strict=True):
        first = np.maximum(np.floor((middle - radius - low) / steps).astype(int), 0)
        last = np.ceil((middle + radius - low) / steps).astype(int) + 1
        box = np.s_[first[0] : last[0], first[1] : last[1]]
        square = (x[box] - middle[0]) ** 2 + (y[box] - middle[1]) ** 2
        ball = 0.8 * np.sqrt(np.maximum(radius**2 - square, 0.0)) - depth
        found[box] = np.maximum(found[box], ball)
    return found


WIDTH, HIGH, FOOT = 2.8, 1.9, 0.35
"""Of the carved wall, and where it begins; the scene is 4 m large, so that 8 mm are 0.2 % of it."""
SPACING = 0.004
STONE = replace(LIMESTONE, scale=0.2, contrast=0.4)
SCROLLS = tuple((x, 1.32, 1.0 if k % 2 else -1.0) for k, x in enumerate(np.linspace(-1.1, 1.1, 6)))
"""Middle and direction of turn of the tendrils of the frieze."""
STROKES = (
    ((0, 1), (1, 1), (0, 0), (1, 0)),
    ((1, 1), (0, 1), (0, 0), (1, 0)), ((0, 0.5), (0.8, 0.5)),
    ((0, 0), (0, 1), (1, 0.9), (1, 0.6), (0, 0.5), (1, 0)),
    ((0, 0), (0, 1), (1, 1), (1, 0), (0, 0)),
)  # fmt: skip
LETTERS = ((0,), (1, 2), (3,), (4,))
"""Letters as lines that are cut into the stone, in units of their width and height."""


def ornament() -> SyntheticScene:
    """Return the scene; it is best photographed from 3 to 4 units in front of it."""
    steps = [box(WIDTH + 0.2, 0.12, 0.5).move((0.0, 0.0, 0.2)), box(WIDTH + 0.1, 0.23, 0.3).move((0.0, 0.12, 0.1))]
    courses = [box(WIDTH + 0.1, 0.05, 0.12).move((0.0, FOOT + y, 0.03)) for y in (-0.01, 0.62, 1.05, 1.62, HIGH - 0.02)]
    dentils = [box(0.05, 0.06, 0.06).move((x, FOOT + 1.73, 0.04)) for x in np.arange(-1.36, 1.37, 0.085)]
    posts = [box(0.16, HIGH, 0.14).move((side * (WIDTH / 2 + 0.02), FOOT, 0.03)) for side in (-1, 1)]
    return SyntheticScene(
        "ornament",
        (
            Body(ground((-1.9, 1.9), (-0.1, 1.3), unevenness=0.01), replace(PAVING, scale=0.3)),
            Body(assemble(steps), SANDSTONE),
            Body(relief(carving, WIDTH, HIGH, SPACING).move((0.0, FOOT, 0.0)), STONE),
            Body(assemble([*courses, *posts]), replace(SANDSTONE, scale=0.2)),
            Body(assemble(dentils), STONE),
        ),
        to_light=(-0.7, 0.75, 0.6),
        bounced=0.3,
    )


def ornament_views(camera: Camera, seed: int = 0) -> Views:
    """Return 14 hand-held photos from the left to the right.

    Args:
        camera: of all photos.
        seed: same seed, same poses.
    """
    walk = ArcOptions(
        photos=14, sweep_deg=75.0, distance=(2.9, 3.9), height=(0.8, 2.0), aim=(0.0, 1.3, 0.0), aim_spread=0.25,
        roll_deg=5.0,
    )  # fmt: skip
    return arc(camera, walk, seed)


def carving(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of the carved wall, in scene units.

    Args:
        x: from its middle, an array of any shape.
        y: above its foot, likewise.
    """
    layers = (_rosettes(x, y), _tendrils(x, y), _cords(x, y), _beads(x, y), _diamonds(x, y))
    return np.asarray(np.maximum.reduce(layers) - _letters(x, y))


def _rosettes(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return three flowers with ribbed petals."""
    found = np.zeros_like(x)
    for number, middle in enumerate((-0.9, 0.0, 0.9)):
        radius, angle = np.hypot(x - middle, y - 0.84), np.arctan2(y - 0.84, x - middle)
        petals = 8 + 2 * number
        wide = np.abs(np.cos(0.5 * petals * angle))
        leaf = np.clip(1.0 - radius / (0.08 + 0.09 * wide), 0.0, 1.0)
        ribs = 0.004 * np.cos(3.0 * petals * angle) * (leaf > 0.05)
        bud = 0.03 * ridge(radius, 0.08)
        found = np.maximum(found, np.maximum(0.035 * np.sqrt(leaf) + ribs, bud))
    return found


def _tendrils(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return spirals whose stems are 22 mm wide and 12 mm high."""
    found = np.zeros_like(x)
    for middle, level, turn in SCROLLS:
        radius = np.hypot(x - middle, y - level)
        angle = np.arctan2(y - level, turn * (x - middle))
        # r = pitch * (angle / 2 pi + k), the nearest winding
        pitch = 0.055
        winding = np.round(radius / pitch - angle / (2.0 * math.pi))
        away = np.abs(radius - pitch * (winding + angle / (2.0 * math.pi)))
        stem = np.where((radius < 0.2) & (radius > 0.015), 0.012 * ridge(away, 0.022), 0.0)
        leaves = 0.008 * ridge(np.abs(radius - 0.215) + 0.02 * (1.0 + np.cos(9.0 * angle)), 0.05)
        found = np.maximum(found, np.maximum(stem, leaves))
    return found


def _cords(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return twisted cords of 30 mm."""
    found = np.zeros_like(x)
    for level in (0.58, 1.13, 1.56):
        across = y - level
        twist = 0.7 + 0.3 * np.abs(np.sin(math.pi * (x + 0.7 * across) / 0.03))
        found = np.maximum(found, 0.015 * ridge(np.abs(across), 0.03) * twist)
    return found


def _beads(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return rows of beads of 24 mm."""
    found = np.zeros_like(x)
    for level in (0.535, 1.6):
        along = (x + 0.015) % 0.03 - 0.015
        found = np.maximum(found, 0.012 * ridge(np.hypot(along, y - level), 0.024))
    return found


def _diamonds(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the ground between the flowers: pyramids 9 mm high, 36 mm apart."""
    along, across = (x + y) / 0.036, (x - y) / 0.036
    top = np.maximum(np.abs(along - np.round(along)), np.abs(across - np.round(across)))
    return np.where((y > 0.68) & (y < 1.0), 0.009 * np.clip(1.0 - 2.4 * top, 0.0, 1.0), 0.0)


def _letters(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return how deep letters of 15 cm are cut: grooves of 10 mm, 5 mm deep."""
    deep = np.zeros_like(x)
    for place in range(12):
        left, low = -1.2 + 0.205 * place, 0.28 - 0.06 * (place % 2)
        for number in LETTERS[(place * 7 + place // 4) % len(LETTERS)]:
            line = np.array(STROKES[number], np.float64) * [0.12, 0.15] + [left, low]
            for a, b in pairwise(line):
                deep = np.maximum(deep, 0.005 * np.clip(1.0 - _line_distance(x, y, a, b) / 0.005, 0.0, 1.0))
    return deep


def _line_distance(x: FloatArray, y: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    along = np.clip(((x - a[0]) * (b[0] - a[0]) + (y - a[1]) * (b[1] - a[1])) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.asarray(np.hypot(x - a[0] - along * (b[0] - a[0]), y - a[1] - along * (b[1] - a[1])))


IRON = Material(pattern="stone", base=(58, 70, 66), second=(126, 92, 62), joint=(24, 26, 26), scale=0.05)
BARK = Material(pattern="stone", base=(112, 92, 70), second=(66, 54, 42), joint=(34, 28, 22), scale=0.06)
WALL_TOP_Y = 1.5
RAIL_Y = (0.12, 0.98)
"""Lower and upper bar of the railing."""
FLOOR_Y = 0.12


def railing() -> SyntheticScene:
    """Return the scene; the sky is behind all that rises above the wall."""
    iron, wood = _railing_lines() + _lamp_lines(), tree((-1.55, 0.0, 0.15), 2.3, seed=4)
    pot = revolve(np.array([[0.0, 0.0], [0.14, 0.0], [0.2, 0.3], [0.2, 0.36], [0.16, 0.36], [0.0, 0.33]]), sharp=True)
    bodies = (
        Body(ground((-2.2, 2.2), (-1.3, 1.2), unevenness=0.01), replace(PAVING, scale=0.3)),
        Body(box(4.2, WALL_TOP_Y, 0.2).move((0.0, 0.0, -1.25)), BRICK),
        Body(box(4.3, 0.08, 0.3).move((0.0, WALL_TOP_Y, -1.25)), LIMESTONE),
        Body(box(2.6, FLOOR_Y, 0.2).move((0.25, 0.0, 0.0)), SANDSTONE),
        Body(pot.move((1.0, 0.0, -0.75)), TERRACOTTA),
        Body(ball(0.2, bumps=0.1, seed=3).move((1.0, 0.5, -0.75)), replace(LIMESTONE, scale=0.1)),
        Body(assemble([tube(line) for line in iron]), IRON),
        Body(assemble([tube(line) for line in wood]), BARK),
    )
    return SyntheticScene("railing", bodies, to_light=(0.5, 0.7, 0.6), thin=tuple(iron + wood))


def railing_views(camera: Camera, seed: int = 0) -> Views:
    """Return 18 hand-held photos from the left to the right.

    Args:
        camera: of all photos.
        seed: same seed, same poses.
    """
    walk = ArcOptions(
        photos=18, sweep_deg=80.0, distance=(3.4, 4.4), height=(0.9, 1.9), aim=(0.0, 0.95, -0.2), aim_spread=0.25,
        roll_deg=5.0,
    )  # fmt: skip
    return arc(camera, walk, seed)


def _railing_lines() -> list[FloatArray]:
    """Return the lines of the railing: bars, rods, and scrolls between some of them."""
    low, high = (FLOOR_Y + y for y in RAIL_Y)
    left, right = -0.95, 1.45
    lines = [straight((left, y, 0.0), (right, y, 0.0), radius) for y, radius in ((low, 0.014), (high, 0.02))]
    places = np.linspace(left, right, 17)
    lines += [straight((x, FLOOR_Y, 0.0), (x, high, 0.0), 0.016 if k % 8 == 0 else 0.009) for k, x in enumerate(places)]
    for x in places[2:-1:4]:
        angle = np.linspace(0.0, 3.5 * math.pi, 40)
        radius = 0.012 + 0.011 * angle / math.pi * 1.6
        scroll = np.column_stack(
            [x + 0.075 + radius * np.cos(angle), 0.6 + radius * np.sin(angle), 0.0 * angle, 0.007 + 0.0 * angle]
        )
        lines.append(scroll)
    return lines


def _lamp_lines() -> list[FloatArray]:
    """Return a lamp post with an arm, and a sagging wire to the tree."""
    angle = np.linspace(0.0, math.pi, 24)
    arm = np.column_stack(
        [1.75 - 0.2 + 0.2 * np.cos(angle), 2.3 + 0.2 * np.sin(angle), 0.0 * angle - 0.3, 0.012 + 0.0 * angle]
    )
    x = np.linspace(-1.5, 1.74, 40)
    wire = np.column_stack([x, 2.05 + 0.05 * (x - 0.1) ** 2, -0.3 + 0.13 * (1.74 - x) / 3.24, 0.005 + 0.0 * x])
    return [straight((1.75, 0.0, -0.3), (1.75, 2.3, -0.3), 0.03), arm, wire]


def straight(start: tuple[float, float, float], end: tuple[float, float, float], radius: float) -> FloatArray:
    """Return a straight line (N, 4) with its radius, in steps of about 5 cm.

    Args:
        start, end: its ends.
        radius: all along it.
    """
    a, b = np.array([*start, radius]), np.array([*end, radius])
    steps = 2 + round(float(np.linalg.norm(b - a)) / 0.05)
    return np.asarray(a + np.linspace(0.0, 1.0, steps)[:, None] * (b - a))


def tree(foot: tuple[float, float, float], high: float, seed: int) -> list[FloatArray]:
    """Return the lines (N, 4) of a bare tree: a trunk that forks, down to twigs of 5 mm.

    Args:
        foot: where it stands.
        high: approximate height.
        seed: same seed, same tree.
    """
    rng = np.random.default_rng([seed, 23])
    lines: list[FloatArray] = []
    _grow(lines, np.array(foot), np.array([0.05, 1.0, 0.0]), 0.36 * high, 0.045, rng)
    return lines


def _grow(
    lines: list[FloatArray], start: FloatArray, way: FloatArray, length: float, radius: float, rng: np.random.Generator
) -> None:
    """Add a branch and all that fork from it; each is shorter and thinner than what it comes from."""
    way = way / np.linalg.norm(way)
    bend = 0.25 * rng.normal(size=3)
    share = np.linspace(0.0, 1.0, 9)[:, None]
    end_radius = 0.7 * radius
    path = start + length * (share * way + 0.3 * share**2 * bend)
    lines.append(np.column_stack([path, radius + share[:, 0] * (end_radius - radius)]))
    if end_radius < 0.006:
        return
    for _ in range(2 if radius < 0.03 else 3):
        away = rng.normal(size=3)
        away -= (away @ way) * way
        turned = way + 0.75 * away / np.linalg.norm(away) + [0.0, 0.15, 0.0]
        _grow(lines, path[-1], turned, length * rng.uniform(0.62, 0.8), end_radius * rng.uniform(0.75, 0.95), rng)


GRAVEL = Material(pattern="stone", base=(176, 168, 154), second=(122, 112, 98), joint=(84, 78, 70), scale=0.07)
GRASS = Material(pattern="leaves", base=(62, 104, 42), second=(128, 152, 70), joint=(30, 52, 22), scale=0.03)
WHITE = Material(
    pattern="stone", base=(226, 224, 218), second=(220, 217, 210), joint=(216, 213, 206), scale=0.4, contrast=0.03
)


def garden() -> SyntheticScene:
    """Return the scene; cameras at the height of a person see most of the ground at 10 to 20 degrees."""
    bench = [box(1.1, 0.05, 0.36).move((0.9, 0.42, -1.2)), box(1.1, 0.3, 0.04).move((0.9, 0.55, -1.37))]
    bench += [box(0.06, 0.42, 0.3).move((0.9 + side * 0.48, 0.0, -1.2)) for side in (-1, 1)]
    bodies = (
        Body(_lying(_gravel, 0.0), GRAVEL),
        *(Body(_lying(_lawn, side * 1.5), GRASS) for side in (-1, 1)),
        *(Body(box(0.06, 0.09, 3.6).move((side * 0.75, -0.03, 0.0)), LIMESTONE) for side in (-1, 1)),
        Body(box(4.5, 1.25, 0.16).move((0.0, 0.0, -1.85)), WHITE),
        Body(box(4.6, 0.07, 0.26).move((0.0, 1.25, -1.85)), SANDSTONE),
        Body(assemble(bench), WOOD),
        Body(ball(0.34, bumps=0.1, seed=8).move((-1.3, 0.3, -1.1)), LEAVES),
        Body(box(0.3, 0.7, 0.3).move((-0.4, 0.0, -1.4), turn_deg=20.0), SANDSTONE),
    )
    return SyntheticScene("garden", bodies, to_light=(-0.5, 0.6, 0.7))


def garden_views(camera: Camera, seed: int = 0) -> Views:
    """Return 16 hand-held photos from the height of a person.

    Args:
        camera: of all photos.
        seed: same seed, same poses.
    """
    walk = ArcOptions(
        photos=16, sweep_deg=70.0, distance=(4.3, 5.2), height=(1.15, 1.6), aim=(0.0, 0.55, -0.5), aim_spread=0.25,
        roll_deg=5.0,
    )  # fmt: skip
    return arc(camera, walk, seed)


def _lying(height: Height, x: float) -> Shape:
    """Return a strip of ground with its middle at x; its texture is that of what faces up."""
    return assemble([relief(height, 1.5, 3.6, 0.007).move((x, 0.0, 1.8), tilt_deg=-90.0)])


def _gravel(x: FloatArray, y: FloatArray) -> FloatArray:
    return pebbles(x, y, (0.012, 0.035), 0.03, seed=1)


def _lawn(x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the height of grass that was cut: tufts of up to 5 cm, a centimeter wide."""
    return pebbles(x, y, (0.006, 0.012), 0.013, seed=2) * 2.5 + 0.012 * np.sin(5.0 * x + 1.0) * np.sin(4.0 * y)
