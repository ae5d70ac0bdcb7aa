"""Build the ground of a town, and what stands in its streets: lamps, trees, benches, boxes, parked cars.

Lengths are in meters; all numbers were chosen by hand, from looking at rendered streets.
"""

from collections.abc import Callable

import numpy as np

from sfm_app.synthetic.scenes.bodies import Body
from sfm_app.synthetic.scenes.shapes import Shape, Span, assemble, ball, box, ground, panels, revolve
from sfm_app.synthetic.scenes.textures import Color, Pattern
from sfm_app.synthetic.town.styles import BRIGHT, WALLS, draw_material
from sfm_app.synthetic.town_walk import BLOCK_M, PITCH_M, STREET_M

Random = np.random.Generator

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
