"""Houses of a town: their styles and their parts."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sfm_app.synthetic.shapes import Body, Color, Material, Pattern, Shape

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Random = np.random.Generator

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


def assemble(parts: Sequence[Shape], keep_texture: bool = False) -> Shape:
    """Join several shapes; with `keep_texture`, equal parts look equal, else the texture continues across them."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts[:-1], strict=True)])
    texture = np.concatenate([part.texture for part in parts]) if keep_texture else vertices
    return Shape(vertices, faces, np.concatenate([part.normals for part in parts]), texture)


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


WALLS: tuple[Color, ...] = (
    (214, 196, 160), (190, 120, 90), (160, 84, 64), (205, 180, 180), (150, 168, 140), (120, 140, 165),
    (224, 216, 202), (190, 152, 92), (128, 124, 122), (204, 150, 130), (226, 200, 130), (170, 185, 195),
)  # fmt: skip
BRIGHT: tuple[Color, ...] = (
    (196, 50, 44), (34, 84, 150), (30, 110, 70), (230, 180, 40), (236, 232, 220), (40, 42, 50), (130, 60, 120),
    (220, 120, 40), (60, 150, 170), (110, 60, 40),
)  # fmt: skip
"""Colors of doors, shutters, signs, awnings and goods."""
MASONRY: tuple[tuple[Pattern, float], ...] = (("stone", 0.35), ("masonry", 0.14), ("masonry", 0.34), ("wood", 0.4))
"""Patterns of walls, and their scales."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HouseStyle:
    """What the fronts of one house have in common."""

    ground_m: float
    """Height of the ground floor."""
    floor_m: float
    """Height of the other floors."""
    floors: int
    axis_m: float
    """Distance between windows."""
    opening: tuple[float, float]
    """Width and height of windows."""
    sill_m: float
    """Height of window sills above the floor."""
    surround_m: float
    """Width of the surrounds of windows, 0 without."""
    hood: bool
    """Whether windows have hoods."""
    bars: tuple[int, float]
    """Panes next to each other in a window, and height of its crossbar as a share, 0 without."""
    shutters: float
    """Share of windows with shutters."""
    balconies: float
    """Share of windows with balconies."""
    shop: bool
    roof_m: float
    """Height of the roof; 0 for a flat one."""
    materials: Mapping[str, Material]

    @property
    def height_m(self) -> float:
        """Up to the eaves."""
        return self.ground_m + (self.floors - 1) * self.floor_m + 0.5


def draw_style(rng: Random) -> HouseStyle:
    """Draw the proportions, the decoration and the materials of a house."""
    tall = float(rng.uniform(1.3, 1.9))
    return HouseStyle(
        ground_m=float(rng.uniform(3.1, 4.0)),
        floor_m=float(rng.uniform(1.0, 1.4)) + tall,
        floors=int(rng.choice((2, 3, 3, 4, 4))),
        axis_m=float(rng.uniform(1.7, 2.9)),
        opening=(float(rng.uniform(0.8, 1.3)), tall),
        sill_m=float(rng.uniform(0.6, 0.9)),
        surround_m=float(rng.choice((0.0, 0.12, 0.2))),
        hood=bool(rng.uniform() < 0.4),
        bars=(int(rng.integers(1, 4)), float(rng.choice((0.0, 0.5, 0.7)))),
        shutters=float(rng.choice((0.0, 0.0, 0.8, 0.95))),
        balconies=float(rng.choice((0.0, 0.1, 0.4))),
        shop=bool(rng.uniform() < 0.5),
        roof_m=float(rng.choice((0.0, 1.6, 2.4, 3.2))),
        materials=_draw_materials(rng),
    )


def draw_color(colors: Sequence[Color], rng: Random) -> Color:
    """Draw one of some colors, and vary it.

    Args:
        colors: to choose from.
        rng: random generator.
    """
    base = np.array(colors[int(rng.integers(len(colors)))]) + rng.normal(0.0, 10.0) + rng.normal(0.0, 5.0, 3)
    r, g, b = np.clip(base, 12, 240).round().astype(int).tolist()
    return r, g, b


def draw_material(pattern: Pattern, colors: Sequence[Color], scale: float, rng: Random) -> Material:
    """Draw a material with a pattern: a main color, a darker or lighter second, and joints of another.

    Args:
        pattern: see `Material`.
        colors: to choose the main color from.
        scale: of the pattern, before it is varied.
        rng: random generator.
    """
    base = draw_color(colors, rng)
    second = draw_color([_scale_color(base, float(rng.choice((0.62, 0.75, 1.18))))], rng)
    # pale joints between small leaves and planks would flicker in the distance
    pale = [(200, 194, 182)] if pattern in ("masonry", "paving") else []
    joint = draw_color([_scale_color(base, 0.55), *pale], rng)
    contrast = float(rng.uniform(0.4, 0.7))
    size = scale * float(rng.uniform(0.8, 1.3))
    return Material(pattern=pattern, base=base, second=second, joint=joint, scale=size, contrast=contrast)


def _scale_color(color: Color, factor: float) -> Color:
    r, g, b = (min(240, round(factor * value)) for value in color)
    return r, g, b


def _draw_materials(rng: Random) -> dict[str, Material]:
    def draw_wall() -> Material:
        pattern, scale = MASONRY[int(rng.integers(len(MASONRY)))]
        return draw_material(pattern, WALLS, scale, rng)

    upper = draw_wall()
    return {
        "wall": upper,
        "foot": draw_wall() if rng.uniform() < 0.5 else upper,
        "party": draw_material("stone", WALLS, 0.4, rng),
        "trim": draw_material("stone", WALLS, 0.3, rng),
        "frame": draw_material("wood", (*BRIGHT[2:6], (224, 220, 210), (228, 224, 216)), 0.3, rng),
        "glass": draw_material("stone", ((46, 54, 62), (60, 70, 84), (36, 40, 44)), 0.5, rng),
        "curtain": draw_material("marble", (*BRIGHT, (206, 200, 188), (206, 200, 188)), 0.3, rng),
        "door": draw_material("wood", BRIGHT, 0.25, rng),
        "shutter": draw_material("wood", BRIGHT, 0.24, rng),
        "sign": draw_material("marble", BRIGHT, 0.5, rng),
        "letters": draw_material("stone", ((236, 232, 220), (30, 30, 34), (230, 190, 60)), 0.2, rng),
        "goods": draw_material("stripes", BRIGHT, 0.3, rng),
        "iron": draw_material("stone", ((40, 42, 46), (70, 76, 70)), 0.2, rng),
        "roof": draw_material("masonry", ((170, 86, 60), (96, 92, 96), (140, 70, 56)), 0.22, rng),
    }


Hole = tuple[float, float, float, float]
"""From and to along x, and along y."""
Spans = defaultdict[str, list[Span]]
"""Boxes of a front by the name of their material."""

DEPTH_M, RECESS_M = 8.0, 0.25
"""From the front of a house to its back, and from its front to the panes of its windows."""
EDGE_M = 0.02
"""Panes and frames reach this far into the wall: surfaces in one plane would flicker."""
DIVISION_M = 1.0
"""Largest side of a division of a wall."""
SEGMENTS = ((0, 1, 0, 0.2), (0, 1, 0.4, 0.6), (0, 1, 0.8, 1), (0, 0.25, 0, 1), (0.75, 1, 0, 1), (0.38, 0.62, 0, 1))
"""Strokes that letters are made of: from and to, as shares of width and height."""


def house(width: float, sides: tuple[bool, bool], rng: Random) -> tuple[Body, ...]:
    """Return the bodies of a house whose front faces +z at z = 0, in the middle of x.

    Args:
        width: along x.
        sides: whether it has fronts towards -x and +x, too, as at a corner.
        rng: same state, same house.
    """
    style = draw_style(rng)
    fronts = [_front(style, width, True, rng)]
    for shown, turn in zip(sides, (-1, 1), strict=True):
        if shown:
            front = _front(style, DEPTH_M, False, rng)
            at = (turn * width / 2, 0.0, -DEPTH_M / 2)
            fronts.append({name: part.move(at, turn_deg=90.0 * turn) for name, part in front.items()})
    fronts.append(_hull(style, width, sides, rng))
    names = sorted({name for front in fronts for name in front})
    return tuple(
        Body(assemble([front[name] for front in fronts if name in front]), style.materials[name]) for name in names
    )


def _front(style: HouseStyle, width: float, is_main: bool, rng: Random) -> dict[str, Shape]:
    """Return a front by material, around the middle of x; only the main one has a door and a shop."""
    spans: Spans = defaultdict(list)
    half, ground_m, top = width / 2, style.ground_m, style.height_m
    below = _ground_floor(style, width, is_main, rng)
    above = _windows(style, width, range(1, style.floors), rng)
    for kind, hole in [*below, *(("window", hole) for hole in above)]:
        if kind == "window":
            _dress_window(hole, hole[2] > ground_m, style, rng, spans)
        elif kind == "door":
            _dress_door(hole, rng, spans)
        else:
            _dress_shop(hole, style, rng, spans)
    _add_courses(style, width, rng, spans)
    _add_things(style, width, rng, spans)
    found = {name: panels(boxes) for name, boxes in spans.items()}
    holes = np.array([hole for _, hole in below]).reshape(-1, 4)
    found["foot"] = plate((-half, half, 0.0, ground_m), holes, RECESS_M, DIVISION_M)
    found["wall"] = plate((-half, half, ground_m, top), np.array(above).reshape(-1, 4), RECESS_M, DIVISION_M)
    return found


def _windows(style: HouseStyle, width: float, floors: range, rng: Random) -> list[Hole]:
    count = max(1, int((width - 0.7) / style.axis_m))
    across, tall = style.opening
    centers = (np.arange(count) - (count - 1) / 2) * (width - 0.7) / count
    found = []
    for floor in floors:
        foot = style.sill_m + (style.ground_m + (floor - 1) * style.floor_m if floor else 0.0)
        shown = centers[rng.uniform(size=count) < 0.93].tolist()
        found += [(x - across / 2, x + across / 2, foot, foot + tall) for x in shown]
    return found


def _ground_floor(style: HouseStyle, width: float, is_main: bool, rng: Random) -> list[tuple[str, Hole]]:
    """Return the openings of the ground floor, each with what it is."""
    if not is_main:
        return [("window", hole) for hole in _windows(style, width, range(1), rng)]
    side = float(rng.choice((-1.0, 1.0)))
    door = side * (width / 2 - 1.2)
    found: list[tuple[str, Hole]] = [("door", (door - 0.5, door + 0.5, 0.0, 2.3))]
    start, end = sorted((-side * (width / 2 - 0.4), door - 0.9 * side))
    if style.shop:
        found.append(("shop", (start, end, 0.5, 2.5)))
    else:
        shift = (start + end) / 2
        for left, right, low, high in _windows(style, end - start + 0.4, range(1), rng):
            found.append(("window", (left + shift, right + shift, low, min(high, style.ground_m - 0.5))))
    return found


def _dress_window(hole: Hole, is_above: bool, style: HouseStyle, rng: Random, spans: Spans) -> None:
    """Add pane, frame, sill and decoration of a window; curtains, shutters and flowers differ from window to window."""
    left, right, low, _ = hole
    _add_pane(hole, style.bars, rng, spans)
    balcony = is_above and rng.uniform() < style.balconies
    if balcony:
        _add_balcony(left - 0.4, right + 0.4, low, rng, spans)
    else:
        spans["trim"].append((left - 0.1, right + 0.1, low - 0.1, low + 0.02, -0.2, 0.14))
    _decorate_window(hole, style, rng, spans)
    if not balcony and rng.uniform() < 0.25:
        spans["goods"].append((left + 0.05, right - 0.05, low, low + 0.16, 0.0, 0.2))
        for x in np.arange(left + 0.1, right - 0.15, 0.13).tolist():
            tall = float(rng.uniform(0.2, 0.45))
            spans["sign"].append((x, x + 0.1, low + 0.1, low + tall, 0.02, 0.14))


def _decorate_window(hole: Hole, style: HouseStyle, rng: Random, spans: Spans) -> None:
    """Add surround, hood and shutters of a window."""
    left, right, low, high = hole
    edge = style.surround_m
    if edge:
        spans["trim"] += [
            (left - edge, left, low, high, 0.0, 0.06),
            (right, right + edge, low, high, 0.0, 0.06),
            (left - edge, right + edge, high, high + edge, 0.0, 0.06),
        ]
    if style.hood:
        spans["trim"].append((left - 0.2, right + 0.2, high + edge, high + edge + 0.14, 0.0, 0.24))
    if rng.uniform() < style.shutters:
        leaf = (right - left) * float(rng.uniform(0.35, 0.5))
        gap = edge + 0.02
        spans["shutter"] += [
            (left - gap - leaf, left - gap, low, high, -0.02, 0.07),
            (right + gap, right + gap + leaf, low, high, -0.02, 0.07),
        ]


def _add_pane(hole: Hole, bars: tuple[int, float], rng: Random, spans: Spans) -> None:
    """Add glass, frame, bars and curtains of an opening."""
    left, right, low, high = hole
    z, thick = -RECESS_M, 0.07
    spans["glass"].append((left - EDGE_M, right + EDGE_M, low - EDGE_M, high + EDGE_M, z - 0.05, z))
    columns = np.linspace(left - EDGE_M, right + EDGE_M - thick, bars[0] + 1).tolist()
    spans["frame"] += [(x, x + thick, low, high, z - 0.02, z + 0.06) for x in columns]
    rows = [low - EDGE_M, high + EDGE_M - thick, *([low + bars[1] * (high - low)] if bars[1] else [])]
    spans["frame"] += [(left - EDGE_M, right + EDGE_M, y, y + thick, z - 0.02, z + 0.06) for y in rows]
    for side in (0, 1):
        if rng.uniform() < 0.5:
            width, drop = (right - left) * float(rng.uniform(0.15, 0.5)), (high - low) * float(rng.uniform(0.0, 0.5))
            ends = (left + thick, left + width) if side == 0 else (right - width, right - thick)
            spans["curtain"].append((*ends, low + drop, high - thick, z - 0.01, z + 0.015))


def _add_balcony(left: float, right: float, low: float, rng: Random, spans: Spans) -> None:
    reach = float(rng.uniform(0.6, 1.0))
    spans["trim"].append((left, right, low - 0.16, low, 0.0, reach))
    spans["iron"].append((left, right, low + 0.9, low + 0.96, reach - 0.06, reach))
    for x in np.arange(left, right, 0.16).tolist():
        spans["iron"].append((x, x + 0.03, low, low + 0.9, reach - 0.05, reach - 0.02))
    for x in (left, right - 0.05):
        spans["iron"].append((x, x + 0.05, low + 0.9, low + 0.96, 0.0, reach))
        spans["iron"] += [
            (x, x + 0.03, low, low + 0.9, z, z + 0.03) for z in np.arange(0.1, reach - 0.1, 0.16).tolist()
        ]
    if rng.uniform() < 0.5:
        x = float(rng.uniform(left + 0.1, right - 0.5))
        spans["goods"].append((x, x + 0.35, low, low + float(rng.uniform(0.3, 0.7)), 0.1, 0.4))


def _dress_door(hole: Hole, rng: Random, spans: Spans) -> None:
    """Add leaf, panels, frame and step of a door, its number, and a light above it."""
    left, right, low, high = hole
    z = -RECESS_M
    leaf = high - (0.45 if rng.uniform() < 0.5 else 0.0)
    spans["door"].append((left - EDGE_M, right + EDGE_M, low, leaf, z - 0.05, z + 0.03))
    if leaf < high:
        _add_pane((left, right, leaf, high), (int(rng.integers(1, 5)), 0.0), rng, spans)
    rows = np.linspace(low + 0.15, leaf - 0.1, int(rng.integers(2, 5))).tolist()
    for y, above in pairwise(rows):
        for x in (left + 0.1, (left + right) / 2 + 0.04):
            spans["frame"].append((x, x + 0.36, y, above - 0.1, z, z + 0.06))
    spans["trim"] += [
        (left - 0.3, right + 0.3, low, low + 0.14, -0.2, 0.35),
        (left - 0.22, left, low, high, 0.0, 0.1),
        (right, right + 0.22, low, high, 0.0, 0.1),
        (left - 0.35, right + 0.35, high, high + 0.22, 0.0, 0.2),
    ]
    _add_letters((right + 0.3, right + 0.65, 1.6, 1.85), 2, rng, spans)
    spans["iron"].append((left - 0.45, left - 0.3, 1.9, 2.25, -0.02, 0.18))


def _dress_shop(hole: Hole, style: HouseStyle, rng: Random, spans: Spans) -> None:
    """Add the window of a shop with goods in it, and the sign above."""
    left, right, low, high = hole
    _add_pane(hole, (max(1, round((right - left) / 1.4)), 0.0), rng, spans)
    spans["door"].append((left - 0.1, right + 0.1, 0.0, low, 0.0, 0.08))
    x = left + 0.1
    while x < right - 0.4:
        width, tall = float(rng.uniform(0.12, 0.4)), float(rng.uniform(0.15, 1.1))
        spans[str(rng.choice(("goods", "letters", "curtain")))].append((x, x + width, low, low + tall, -0.22, -0.06))
        x += width + float(rng.uniform(0.03, 0.3))
    foot, top = high + 0.1, min(high + 0.75, style.ground_m - 0.1)
    spans["sign"].append((left - 0.1, right + 0.1, foot, top, -0.05, 0.12))
    count = int((right - left) / (top - foot) / 0.8)
    start = left + float(rng.uniform(0.0, 0.2)) * (right - left)
    _add_letters((start, right - 0.1, foot + 0.1, top - 0.1), count, rng, spans)
    if rng.uniform() < 0.6:
        spans["goods"].append((left - 0.1, right + 0.1, high + 0.02, high + 0.1, 0.0, float(rng.uniform(0.7, 1.1))))


def _add_letters(reach: Hole, count: int, rng: Random, spans: Spans) -> None:
    """Add letters made of random strokes, each in one of `count` parts of a board; some parts are blank."""
    left, right, low, high = reach
    pitch = (right - left) / max(count, 1)
    for k in range(count):
        chosen = rng.choice(len(SEGMENTS), int(rng.integers(2, 5)), replace=False)
        if rng.uniform() < 0.12:
            continue
        x, across, tall = left + k * pitch, 0.78 * pitch, high - low
        for a, b, c, d in (SEGMENTS[int(one)] for one in chosen):
            spans["letters"].append((x + a * across, x + b * across, low + c * tall, low + d * tall, 0.0, 0.16))


def _add_courses(style: HouseStyle, width: float, rng: Random, spans: Spans) -> None:
    """Add plinth, courses between floors, cornice with brackets, and stones or strips at the edges."""
    half, top = width / 2, style.height_m
    spans["trim"].append((-half, half, top - 0.25, top, -0.1, 0.35))
    step = float(rng.uniform(0.35, 0.9))
    if rng.uniform() < 0.7:
        brackets = np.arange(-half + 0.15, half - 0.15, step).tolist()
        spans["trim"] += [(x, x + 0.14, top - 0.5, top - 0.25, -0.02, 0.26) for x in brackets]
    for floor in range(1, style.floors):
        if floor == 1 or step < 0.6:
            y = style.ground_m + (floor - 1) * style.floor_m
            spans["trim"].append((-half, half, y, y + 0.14, -0.05, 0.09))
    kind = int(rng.integers(3))
    if kind == 0:
        for k, y in enumerate(np.arange(0.3, top - 0.8, 0.38).tolist()):
            deep = 0.5 if k % 2 else 0.3
            spans["trim"] += [
                (-half, -half + deep, y, y + 0.32, -0.05, 0.05),
                (half - deep, half, y, y + 0.32, -0.05, 0.05),
            ]
    elif kind == 1:
        spans["iron"].append((half - 0.22, half - 0.12, 0.1, top, 0.0, 0.12))


def _add_things(style: HouseStyle, width: float, rng: Random, spans: Spans) -> None:
    """Add a sign across the street, boxes of air conditioners and posters, each where chance has it."""
    half = width / 2
    if rng.uniform() < 0.5:
        x, y = float(rng.uniform(-half + 0.5, half - 0.5)), style.ground_m - 0.1
        spans["sign"].append((x, x + 0.08, y - 0.7, y + 0.3, 0.15, float(rng.uniform(0.6, 1.0))))
        spans["letters"].append((x - 0.01, x + 0.09, y - 0.45, y + 0.05, 0.3, 0.5))
    for _ in range(int(rng.integers(0, 3))):
        x, y = float(rng.uniform(-half + 0.1, half - 0.9)), style.ground_m + float(rng.uniform(0.2, 2.5))
        if y < style.height_m - 1.2:
            spans["frame"].append((x, x + 0.7, y, y + 0.5, 0.0, 0.3))
            spans["iron"].append((x + 0.1, x + 0.45, y + 0.08, y + 0.42, 0.0, 0.31))
    for name in rng.choice(("goods", "curtain", "sign", "letters"), int(rng.integers(0, 4))):
        x, y = float(rng.uniform(-half, half - 0.6)), float(rng.uniform(0.6, 1.6))
        spans[str(name)].append((x, x + float(rng.uniform(0.3, 0.6)), y, y + float(rng.uniform(0.4, 0.8)), 0.0, 0.03))


def _hull(style: HouseStyle, width: float, sides: tuple[bool, bool], rng: Random) -> dict[str, Shape]:
    """Return the walls where there is no front, and the roof with its chimneys."""
    half, top, back = width / 2, style.height_m, -DEPTH_M
    reach = ((-half, back), (-half, -RECESS_M), (half, -RECESS_M), (half, back))
    walls = [[(x, 0, z), (u, 0, w), (u, top, w), (x, top, z)] for (x, z), (u, w) in pairwise(reach)]
    walls = [wall for wall, is_front in zip(walls, (sides[0], True, sides[1]), strict=True) if not is_front]
    walls.append([(half, 0, back), (-half, 0, back), (-half, top, back), (half, top, back)])
    ridge, middle, eaves = top + style.roof_m, back / 2, 0.3
    slopes = [
        [(-half, top, eaves), (half, top, eaves), (half, ridge, middle), (-half, ridge, middle)],
        [(half, top, back), (-half, top, back), (-half, ridge, middle), (half, ridge, middle)],
    ]
    if style.roof_m:
        for x, (start, end) in ((-half, (back, eaves)), (half, (eaves, back))):
            walls.append([(x, top, start), (x, top, end), (x, ridge, middle), (x, ridge, middle)])
    stacks = []
    for _ in range(int(rng.integers(0, 3))):
        x, z = float(rng.uniform(-half + 0.2, half - 0.9)), float(rng.uniform(back + 1.0, -1.5))
        stacks.append((x, x + 0.6, top, ridge + float(rng.uniform(0.5, 1.4)), z, z + 0.6))
    found = {"party": quads(np.array(walls, np.float64)), "roof": quads(np.array(slopes))}
    if stacks:
        found["foot"] = panels(stacks)
    return found
