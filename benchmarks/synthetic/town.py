"""A town of streets in a grid, with houses on both sides, and photos of a walk through it.

Streets run along x and z at multiples of PITCH_M, around `blocks` blocks in each direction. A ring of blocks outside
gives every street houses on both sides; a house stands across each end of a street. Some houses stand in several
streets. A walk is taken once: smaller sets of photos are its first photos, in the same town.
"""

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.synthetic.houses import BRIGHT, DEPTH_M, WALLS, Span, assemble, draw_material, house, panels
from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import Camera, Views
from sfm_app.synthetic.shapes import Body, Color, Pattern, Shape, SyntheticScene, ball, box, ground, revolve

FloatArray = NDArray[np.float64]
Random = np.random.Generator

BLOCK_M, STREET_M = 40.0, 12.0
"""Side of a block of houses, and width of the streets between blocks."""
PITCH_M = BLOCK_M + STREET_M
WALKED_TWICE = 1.6
"""Length of the walk over that of all streets of the town: it crosses itself and passes streets again."""
GLANCE_DEG, GLANCE_M = 45.0, 18.0
"""The camera sways this far to both sides, from side to side and back on this length of the walk."""
TURN_M = 5.0
"""Before and behind a corner the camera turns over this length."""
EYE_M = 1.6


@dataclass(frozen=True, slots=True, eq=False)
class TownWalk:
    """Where photos are taken, and which way they look."""

    blocks: int
    """Blocks of the town along each side."""
    centers: FloatArray
    """(N, 3) in meters; y is up, streets run along x and z at multiples of PITCH_M."""
    yaw: FloatArray
    """(N,) direction of view in radians, from z to x."""
    pitch: FloatArray
    """(N,) upwards, in radians."""

    @property
    def rotations(self) -> FloatArray:
        """(N, 3, 3) camera from world: x right, y down, z forward."""
        (sy, cy), (sp, cp) = ((np.sin(angle), np.cos(angle)) for angle in (self.yaw, self.pitch))
        forward = np.column_stack([sy * cp, sp, cy * cp])
        right = np.column_stack([-cy, np.zeros_like(cy), sy])
        return np.stack([right, np.cross(forward, right), forward], axis=1)


def walk_town(photos: int, step_m: float, seed: int) -> TownWalk:
    """Return a walk from crossing to crossing, along streets not seen before where there are any.

    The town is as large as the walk can cover.

    Args:
        photos: taken at even steps.
        step_m: length of a step.
        seed: of the way and of the sway of the camera.
    """
    rng = np.random.default_rng([seed, 721])
    length = photos * step_m
    blocks = max(2, round(math.sqrt(length / WALKED_TWICE / (2.0 * PITCH_M))))
    corners = _walk_corners(blocks, length + TURN_M, rng)
    along = step_m * np.arange(photos)
    before, place, behind = (_route_points(corners, along + shift) for shift in (-TURN_M, 0.0, TURN_M))
    place += rng.normal(scale=0.4, size=(photos, 2))
    sway = np.radians(GLANCE_DEG) * np.sin(2 * np.pi * along / GLANCE_M)
    yaw = np.arctan2(*(behind - before).T) + sway + np.radians(rng.normal(scale=5.0, size=photos))
    centers = np.column_stack([place[:, 0], EYE_M + rng.normal(scale=0.1, size=photos), place[:, 1]])
    return TownWalk(blocks, centers, yaw, np.radians(8.0 + rng.normal(scale=3.0, size=photos)))


def _walk_corners(blocks: int, length: float, rng: np.random.Generator) -> FloatArray:
    """Return (N, 2) the crossings that a walk of some length comes to."""
    at, stops, walked = (0, 0), [(0, 0)], set[frozenset[tuple[int, int]]]()
    while (len(stops) - 1) * PITCH_M < length:
        ways = [(at[0] + dx, at[1] + dz) for dx, dz in ((1, 0), (0, 1), (-1, 0), (0, -1))]
        ways = [way for way in ways if min(way) >= 0 and max(way) <= blocks and way != (stops[-2:] or [at])[0]]
        fresh = [way for way in ways if frozenset((at, way)) not in walked] or ways
        chosen = fresh[int(rng.integers(len(fresh)))]
        walked.add(frozenset((at, chosen)))
        stops.append(chosen)
        at = chosen
    return PITCH_M * np.array(stops, np.float64)


def _route_points(corners: FloatArray, along: NDArray[np.floating]) -> FloatArray:
    """Return (N, 2) points of a route at some lengths from its start; it goes on straight at its ends."""
    leg = np.clip(along // PITCH_M, 0, len(corners) - 2).astype(np.int64)
    start, end = corners[leg], corners[leg + 1]
    return np.asarray(start + (along / PITCH_M - leg)[:, None] * (end - start), np.float64)


Reach = tuple[float, float]
"""From and to along an axis."""

PAVEMENT_M, KERB_M = 2.1, 0.12
"""Width and height of pavements."""
SPACING_M = 1.2
"""Side of a division of the ground: light changes this slowly on it."""
CAR_M = 3.05
"""From a front to the middle of a parked car."""
STREETS: tuple[tuple[Pattern, float], ...] = (("stone", 0.3), ("paving", 0.24), ("paving", 0.5))
"""Patterns of streets, and their scales."""
BOXES: tuple[Pattern, ...] = ("wood", "marble", "stripes", "stone")
"""Patterns of boxes."""
GRAYS: tuple[Color, ...] = ((104, 102, 100), (128, 124, 118), (90, 92, 98), (140, 128, 112), (118, 108, 100))
GREENS: tuple[Color, ...] = ((46, 92, 34), (70, 110, 50), (96, 120, 50), (60, 84, 60), (130, 110, 50))
WOODS: tuple[Color, ...] = ((150, 110, 70), (110, 84, 60), (176, 140, 96), (90, 70, 54))
IRON: tuple[Color, ...] = ((44, 48, 50), (60, 76, 66), (84, 84, 90))


def town_ground(blocks: int, rng: Random) -> list[Body]:
    """Return streets and pavements, each stretch of another material.

    Args:
        blocks: of the town along each side, without the outer ring.
        rng: random generator.
    """
    half = STREET_M / 2
    bodies = []
    for a in range(blocks + 1):
        line = (PITCH_M * a - half, PITCH_M * a + half)
        for b in range(-1, blocks + 1):
            stretch = (PITCH_M * b + half, PITCH_M * b + half + BLOCK_M)
            bodies += [*_street(stretch, line, rng), *_street(line, stretch, rng)]
        for b in range(blocks + 1):
            bodies += _street(line, (PITCH_M * b - half, PITCH_M * b + half), rng)
    for a in range(-1, blocks + 1):
        for b in range(-1, blocks + 1):
            bodies += _pavements(a, b, blocks, rng)
    return bodies


def street_things(length: float, rng: Random) -> list[Body]:
    """Return things along the front of a row of houses, which faces +z at z = 0 and is `length` long around x = 0.

    Args:
        length: of the row, along x.
        rng: random generator.
    """
    bodies: list[Body] = []
    kinds = list(THINGS)
    x = -length / 2 + float(rng.uniform(1.0, 3.0))
    while x < length / 2 - 1.0:
        kind = kinds[int(rng.integers(len(kinds)))]
        z = PAVEMENT_M - 0.5 if kind in (_lamp, _tree, _post) else float(rng.uniform(0.6, 1.5))
        at = (x, KERB_M, z)
        bodies += [Body(body.shape.move(at, float(rng.uniform(-8.0, 8.0))), body.material) for body in kind(rng)]
        x += float(rng.uniform(2.0, 4.5))
    x = -length / 2 + float(rng.uniform(3.0, 12.0))
    while x < length / 2 - 3.0:
        bodies += [Body(body.shape.move((x, 0.0, CAR_M)), body.material) for body in _car(rng)]
        x += float(rng.uniform(5.5, 18.0))
    return bodies


def _street(x: Reach, z: Reach, rng: Random) -> list[Body]:
    """Return a stretch of street with patches and covers on it, and stripes across it."""
    pattern, scale = STREETS[int(rng.integers(len(STREETS)))]
    bodies = [Body(ground(x, z, 0.01, SPACING_M), draw_material(pattern, GRAYS, scale, rng))]
    patches: list[Span] = []
    for _ in range(int(rng.integers(3, 9))):
        across, deep = rng.uniform(0.4, 2.0, 2).tolist()
        a, b = float(rng.uniform(x[0], x[1] - across)), float(rng.uniform(z[0], z[1] - deep))
        patches.append((a, a + across, 0.0, 0.025, b, b + deep))
    bodies.append(Body(panels(patches), draw_material("paving", GRAYS, 0.3, rng)))
    if max(x[1] - x[0], z[1] - z[0]) > STREET_M and rng.uniform() < 0.7:
        bodies.append(Body(panels(_stripes(x, z)), draw_material("stone", ((214, 210, 200),), 0.3, rng)))
    return bodies


def _stripes(x: Reach, z: Reach) -> list[Span]:
    """Return the stripes of the crossings at both ends of a stretch."""
    along_x = x[1] - x[0] > z[1] - z[0]
    reach, other = (x, z) if along_x else (z, x)
    found: list[Span] = []
    for start in (reach[0] + 1.0, reach[1] - 3.4):
        for edge in np.arange(other[0] + PAVEMENT_M + 0.3, other[1] - PAVEMENT_M - 0.4, 1.0).tolist():
            bar = (start, start + 2.4), (edge, edge + 0.5)
            (a, b), (c, d) = bar if along_x else bar[::-1]
            found.append((a, b, 0.0, 0.03, c, d))
    return found


def _pavements(a: int, b: int, blocks: int, rng: Random) -> list[Body]:
    """Return the pavements and kerbs of a block, on its sides with streets."""
    x, z = (PITCH_M * k + STREET_M / 2 for k in (a, b))
    west, east, south, north = (0 <= k <= blocks for k in (a, a + 1, b, b + 1))
    low, high = x - PAVEMENT_M * west, x + BLOCK_M + PAVEMENT_M * east
    sides = [
        (south, (low, high), (z - PAVEMENT_M, z)),
        (north, (low, high), (z + BLOCK_M, z + BLOCK_M + PAVEMENT_M)),
        (west, (x - PAVEMENT_M, x), (z, z + BLOCK_M)),
        (east, (x + BLOCK_M, x + BLOCK_M + PAVEMENT_M), (z, z + BLOCK_M)),
    ]
    return [body for is_street, across, along in sides if is_street for body in _pavement(across, along, rng)]


def _pavement(x: Reach, z: Reach, rng: Random) -> list[Body]:
    flags = ground(x, z, 0.0, SPACING_M).move((0.0, KERB_M, 0.0))
    kerb = box(x[1] - x[0] + 0.1, KERB_M - 0.005, z[1] - z[0] + 0.1, spacing=3.0)
    return [
        Body(flags, draw_material("paving", GRAYS, float(rng.choice((0.25, 0.4, 0.7))), rng)),
        Body(kerb.move(((x[0] + x[1]) / 2, 0.0, (z[0] + z[1]) / 2)), draw_material("stone", GRAYS, 0.2, rng)),
    ]


def _lamp(rng: Random) -> list[Body]:
    tall = float(rng.uniform(3.0, 4.5))
    profile = [[0.0, 0.0], [0.16, 0.0], [0.14, 0.35], [0.06, 0.45], [0.05, tall], [0.0, tall]]
    pole = revolve(np.array(profile), segments=8)
    head = revolve(np.array([[0.0, 0.0], [0.1, 0.0], [0.24, 0.45], [0.3, 0.5], [0.0, 0.7]]), segments=6, sharp=True)
    return [
        Body(pole, draw_material("stone", IRON, 0.2, rng)),
        Body(head.move((0.0, tall, 0.0)), draw_material("stone", ((220, 214, 190), *IRON), 0.2, rng)),
    ]


def _tree(rng: Random) -> list[Body]:
    tall = float(rng.uniform(2.4, 3.4))
    trunk = revolve(np.array([[0.2, 0.0], [0.13, 0.5], [0.1, tall + 0.4]]), segments=8)
    leaves = draw_material("leaves", GREENS, 0.08, rng)
    crown = []
    for k in range(int(rng.integers(3, 6))):
        size = float(rng.uniform(0.5, 0.95))
        x, y, z = rng.uniform((-0.6, 0.0, -0.6), (0.6, 1.5, 0.6)).tolist()
        seed = int(rng.integers(10_000))
        crown.append(ball(size, segments=16, bumps=0.22, seed=seed).move((x, tall + y, z), turn_deg=40.0 * k))
    return [Body(trunk, draw_material("wood", WOODS, 0.2, rng)), Body(assemble(crown), leaves)]


def _bench(rng: Random) -> list[Body]:
    width = float(rng.uniform(1.3, 2.0))
    planks = [box(width, 0.05, 0.12, spacing=1.0).move((0.0, 0.42, 0.15 * k)) for k in range(-1, 2)]
    planks += [box(width, 0.12, 0.05, spacing=1.0).move((0.0, y, -0.25)) for y in (0.55, 0.75)]
    legs = [box(0.08, 0.42, 0.4, spacing=1.0).move((side * (width / 2 - 0.2), 0.0, 0.0)) for side in (-1, 1)]
    return [
        Body(assemble(planks), draw_material("wood", (*WOODS, *BRIGHT), 0.2, rng)),
        Body(assemble(legs), draw_material("stone", IRON, 0.2, rng)),
    ]


def _column(rng: Random) -> list[Body]:
    """Return a column for posters, or a low one: a bin."""
    radius, tall = (0.5, 2.4) if rng.uniform() < 0.4 else (0.26, 0.9)
    profile = [[0.0, 0.0], [radius, 0.0], [radius, tall], [1.1 * radius, tall], [1.1 * radius, 1.06 * tall]]
    body = revolve(np.array([*profile, [0.0, 1.2 * tall]]), segments=16, sharp=True)
    return [Body(body, draw_material("marble" if radius > 0.4 else "stripes", BRIGHT, 0.3, rng))]


def _boxes(rng: Random) -> list[Body]:
    """Return a heap of boxes, or a bed of flowers."""
    bodies, y = [], 0.0
    for _ in range(int(rng.integers(2, 5))):
        width, tall, deep = rng.uniform((0.35, 0.25, 0.3), (0.9, 0.7, 0.6)).tolist()
        at = (float(rng.uniform(-0.15, 0.15)), y, 0.0)
        shape = box(width, tall, deep, spacing=0.5).move(at, turn_deg=float(rng.uniform(-25.0, 25.0)))
        pattern = BOXES[int(rng.integers(len(BOXES)))]
        colors = WOODS if pattern == "wood" else BRIGHT
        bodies.append(Body(shape, draw_material(pattern, colors, 0.25, rng)))
        y += tall
    if rng.uniform() < 0.5:
        bush = ball(0.4, segments=16, bumps=0.25, seed=int(rng.integers(10_000))).move((0.0, y + 0.2, 0.0))
        bodies.append(Body(bush, draw_material("leaves", (*GREENS, *BRIGHT), 0.08, rng)))
    return bodies


def _post(rng: Random) -> list[Body]:
    """Return a post with a board."""
    tall, side = float(rng.uniform(2.0, 2.8)), float(rng.uniform(0.35, 0.7))
    pole = box(0.07, tall, 0.07, spacing=1.0)
    board = box(side, side * float(rng.uniform(0.7, 1.4)), 0.03, spacing=0.5).move((0.0, tall - 0.5, 0.05))
    mark = box(0.6 * side, 0.25 * side, 0.05, spacing=0.5).move((0.0, tall - 0.3, 0.05))
    return [
        Body(pole, draw_material("stone", IRON, 0.2, rng)),
        Body(board.move(turn_deg=90.0), draw_material("marble", BRIGHT, 0.4, rng)),
        Body(mark.move(turn_deg=90.0), draw_material("stone", BRIGHT, 0.2, rng)),
    ]


def _car(rng: Random) -> list[Body]:
    """Return a car or a van, along x around the origin."""
    length, tall = float(rng.uniform(3.6, 4.6)), float(rng.choice((0.62, 0.7, 1.25)))
    start, end = -0.28 * length, (0.36 if tall < 1.0 else 0.48) * length
    middle, across, high = (start + end) / 2, end - start, 0.6 * min(tall, 0.8)
    body = [
        box(length, 0.55, 1.66, spacing=0.8).move((0.0, 0.3, 0.0)),
        box(across, tall, 1.5, spacing=0.8).move((middle, 0.85, 0.0)),
    ]
    glass = [
        box(0.42 * across, high, 1.54, spacing=0.8).move((middle + 0.24 * side * across, 0.95, 0.0)) for side in (-1, 1)
    ]
    glass.append(box(across + 0.03, high, 1.3, spacing=0.8).move((middle, 0.95, 0.0)))
    lights = [box(0.1, 0.14, 0.3, spacing=1.0).move((x * length, 0.6, z)) for x in (-0.49, 0.49) for z in (-0.6, 0.6)]
    paint = draw_material("marble" if rng.uniform() < 0.5 else "stone", (*BRIGHT, *WALLS[6:9]), 0.6, rng)
    return [
        Body(assemble(body), paint),
        Body(assemble(glass), draw_material("stone", IRON[:1], 0.4, rng)),
        Body(_wheels(length), draw_material("stone", IRON[:1], 0.1, rng)),
        Body(assemble(lights), draw_material("stone", ((230, 220, 190),), 0.1, rng)),
    ]


def _wheels(length: float) -> Shape:
    profile = np.array([[0.0, 0.0], [0.31, 0.0], [0.31, 0.16], [0.18, 0.18], [0.0, 0.16]])
    disc = revolve(profile, segments=12, sharp=True)
    return assemble([
        disc.move((x * length, 0.31, side * 0.7), turn_deg=0.0 if side > 0 else 180.0, tilt_deg=90.0)
        for x in (-0.32, 0.32)
        for side in (-1, 1)
    ])  # fmt: skip


THINGS: tuple[Callable[[Random], list[Body]], ...] = (_lamp, _tree, _bench, _column, _boxes, _post)
"""What stands on pavements."""

WIDTHS_M = (6, 7, 8, 9, 10, 11)
"""Widths of houses, chosen by hand; any length from 6 on is a sum of them."""
COPIES = 4
"""Streets in which a look-alike stands at most; chosen by hand."""


@dataclass(frozen=True, slots=True)
class HousePlace:
    """Where a house stands."""

    model: int
    """Which house; look-alikes have the same number."""
    width: float
    sides: tuple[bool, bool]
    """Whether it has fronts towards its own -x and +x, too."""
    to: tuple[float, float, float]
    """Middle of its front, on the ground."""
    turn_deg: float
    """About y; the front faces +z before."""
    street: tuple[int, int]
    """Street that it stands in: direction, 0 for x and 1 for z, and number."""


@dataclass(frozen=True, slots=True)
class _Row:
    """A row of houses, by the middle of its front."""

    to: tuple[float, float, float]
    turn_deg: float
    length: float
    street: tuple[int, int]
    sides: tuple[bool, bool] = (False, False)
    """Whether its ends have fronts towards its own -x and +x, too."""
    is_end: bool = False
    """Whether it stands across the end of its street."""


def town(blocks: int = 2, look_alikes: float = 0.1, seed: int = 0) -> SyntheticScene:
    """Return the scene; it is photographed from its streets.

    Args:
        blocks: of the town along each side, without the outer ring.
        look_alikes: share of houses that stand in several streets, the same in shape and texture.
        seed: same seed, same town.

    Raises:
        ConfigError: a value is out of range.
    """
    places = defaultdict(list)
    for place in plan_houses(blocks, look_alikes, seed):
        places[place.model].append(place)
    rng = np.random.default_rng([seed, 732])
    bodies = town_ground(blocks, rng)
    for row in _rows(blocks):
        if not row.is_end:
            things = street_things(row.length, rng)
            bodies += [Body(body.shape.move(row.to, row.turn_deg), body.material) for body in things]
    for model in sorted(places):
        bodies += place_house(places[model], np.random.default_rng([seed, 733, model]))
    return SyntheticScene("town", tuple(bodies), to_light=(0.5, 0.75, 0.35), sky=0.8, bounced=0.3)


def place_house(places: list[HousePlace], rng: Random) -> list[Body]:
    """Return the bodies of one house in all its places.

    Args:
        places: of the same model.
        rng: same state, same house.
    """
    return [
        Body(
            assemble([body.shape.move(place.to, place.turn_deg) for place in places], keep_texture=True), body.material
        )
        for body in house(places[0].width, places[0].sides, rng)
    ]


def plan_houses(blocks: int, look_alikes: float, seed: int) -> tuple[HousePlace, ...]:
    """Return where the houses of a town stand, and which of them are the same.

    Args:
        blocks: of the town along each side, without the outer ring.
        look_alikes: share of houses that stand in several streets; less where too few have equal widths.
        seed: same seed, same plan.

    Raises:
        ConfigError: a value is out of range.
    """
    if blocks < 1 or not 0 <= look_alikes <= 1:
        raise ConfigError("synthetic town: blocks or look_alikes is out of range")
    rng = np.random.default_rng([seed, 734])
    places: list[HousePlace] = []
    for row in _rows(blocks):
        places += _fill_row(row, len(places), rng)
    return tuple(_repeat_houses(places, round(look_alikes * len(places)), rng))


def _repeat_houses(places: list[HousePlace], count: int, rng: Random) -> list[HousePlace]:
    """Return the places with look-alikes in `count` of them."""
    repeated = list(places)
    for group in _equal_widths(places, rng):
        alike = group[:count]
        if len(alike) > 1:
            count -= len(alike)
            for k in alike:
                repeated[k] = replace(places[k], model=alike[0])
    return repeated


def _fill_row(row: _Row, first: int, rng: Random) -> list[HousePlace]:
    """Return houses side by side along a row; their models are numbered from `first` on."""
    widths: list[int] = []
    while (left := round(row.length) - sum(widths)) > 0:
        fitting = [width for width in WIDTHS_M if left == width or left - width >= WIDTHS_M[0]]
        widths.append(int(rng.choice(fitting)))
    start, turn = -row.length / 2, np.radians(row.turn_deg)
    found = []
    for k, width in enumerate(widths):
        x = start + width / 2
        to = (row.to[0] + x * float(np.cos(turn)), 0.0, row.to[2] - x * float(np.sin(turn)))
        sides = row.sides[0] and k == 0, row.sides[1] and k == len(widths) - 1
        found.append(HousePlace(first + k, width, sides, to, row.turn_deg, row.street))
        start += width
    return found


def _equal_widths(places: list[HousePlace], rng: Random) -> list[list[int]]:
    """Return groups of places of houses with equal widths, without fronts at their sides, each in another street."""
    free = [k for k in rng.permutation(len(places)).tolist() if not any(places[k].sides)]
    groups: list[list[int]] = []
    for k in free:
        for group in groups:
            streets = {places[other].street for other in group}
            if len(group) < COPIES and places[group[0]].width == places[k].width and places[k].street not in streets:
                group.append(k)
                break
        else:
            groups.append([k])
    return groups


def _rows(blocks: int) -> list[_Row]:
    """Return all rows: on the sides of blocks where streets are, and across the ends of streets."""
    half, found = STREET_M / 2, []
    for i in range(-1, blocks + 1):
        for j in range(-1, blocks + 1):
            found += _block_rows(i, j, blocks)
    low, high = half - PITCH_M, PITCH_M * blocks + half + BLOCK_M
    for line in range(blocks + 1):
        across = PITCH_M * line
        found += [
            _Row((low, 0.0, across), 90.0, STREET_M, (0, line), is_end=True),
            _Row((high, 0.0, across), -90.0, STREET_M, (0, line), is_end=True),
            _Row((across, 0.0, low), 0.0, STREET_M, (1, line), is_end=True),
            _Row((across, 0.0, high), 180.0, STREET_M, (1, line), is_end=True),
        ]
    return found


def _block_rows(i: int, j: int, blocks: int) -> list[_Row]:
    """Return the rows of a block; those along x have the houses at the corners."""
    x, z = (PITCH_M * k + STREET_M / 2 for k in (i, j))
    west, east, south, north = (0 <= k <= blocks for k in (i, i + 1, j, j + 1))
    start, end = z + DEPTH_M * south, z + BLOCK_M - DEPTH_M * north
    along = (x + BLOCK_M / 2, (start + end) / 2)
    found = []
    if south:
        found.append(_Row((along[0], 0.0, z), 180.0, BLOCK_M, (0, j), (east, west)))
    if north:
        found.append(_Row((along[0], 0.0, z + BLOCK_M), 0.0, BLOCK_M, (0, j + 1), (west, east)))
    if west:
        found.append(_Row((x, 0.0, along[1]), -90.0, end - start, (1, i)))
    if east:
        found.append(_Row((x + BLOCK_M, 0.0, along[1]), 90.0, end - start, (1, i + 1)))
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class TownPhotos:
    """A town, and the walk through it.

    Raises:
        ConfigError: a value is out of range.
    """

    photos: int = 1000
    """Of the whole walk, >= 2; the town is as large as the walk can cover."""
    step_m: float = 1.2
    """Length of a step from photo to photo."""
    look_alikes: float = 0.1
    """Share of houses that stand in several streets, 0..1."""
    seed: int = 0
    """Same seed, same town and same walk."""

    def __post_init__(self) -> None:
        if self.photos < 2 or not 0 < self.step_m < 50 or not 0 <= self.look_alikes <= 1:
            raise ConfigError("synthetic town: photos, step_m or look_alikes is out of range")


def town_of(options: TownPhotos) -> SyntheticScene:
    """Return the town that a walk leads through.

    Args:
        options: the walk.
    """
    blocks = walk_town(options.photos, options.step_m, options.seed).blocks
    return town(blocks, options.look_alikes, options.seed)


def town_views(camera: Camera, options: TownPhotos, count: int | None = None) -> Views:
    """Return the photos of a walk in their order, named street_0000.jpg and so on.

    Args:
        camera: of all photos.
        options: the walk.
        count: photos from its beginning that are taken; all if None.
    """
    walk = walk_town(options.photos, options.step_m, options.seed)
    poses = [np.column_stack([R, -R @ center]) for R, center in zip(walk.rotations, walk.centers, strict=True)][:count]
    named = {f"street_{k:04d}.jpg": pose for k, pose in enumerate(poses)}
    return Views(dict.fromkeys(named, camera), named)
