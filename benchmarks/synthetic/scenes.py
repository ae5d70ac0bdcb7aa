"""Scenes by name with typical views: a facade, a room's corner, a poster and a heap; a sheet with a marker."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from benchmarks.synthetic.detail_scenes import garden, garden_views, ornament, ornament_views, railing, railing_views
from benchmarks.synthetic.houses import assemble
from benchmarks.synthetic.town import TownPhotos, town, town_views
from benchmarks.synthetic.walks import WallWalkOptions, wall_walk
from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import ArcOptions, Camera, Views, arc, make_camera
from sfm_app.synthetic.scenes import (
    BRICK,
    GREEN_MARBLE,
    LEAVES,
    LIMESTONE,
    MARBLE,
    PAINT,
    PAVING,
    POTTERY,
    SANDSTONE,
    TERRACOTTA,
    WOOD,
    courtyard,
    statue,
    statue_views,
)
from sfm_app.synthetic.shapes import Body, Color, Material, Shape, SyntheticScene, ball, box, ground, revolve, torus

ASHLAR = Material(
    pattern="brick", base=(204, 190, 160), second=(178, 160, 128), joint=(112, 100, 82), scale=0.34, contrast=0.5
)
GLASS = Material(pattern="stone", base=(46, 54, 62), second=(74, 84, 92), joint=(40, 46, 54), scale=0.5, contrast=0.12)
CURTAIN = Material(
    pattern="stripes", base=(206, 200, 188), second=(178, 170, 158), joint=(150, 140, 126), scale=0.3, contrast=0.3
)
FRAME = Material(
    pattern="wood", base=(214, 208, 196), second=(190, 182, 168), joint=(150, 142, 130), scale=0.3, contrast=0.3
)
SHUTTER = Material(
    pattern="wood", base=(58, 104, 84), second=(42, 80, 64), joint=(22, 40, 32), scale=0.12, contrast=0.45
)
FLOWERS = Material(
    pattern="leaves", base=(58, 104, 44), second=(196, 60, 70), joint=(24, 40, 18), scale=0.05, contrast=0.5
)

WIDTH, THICKNESS, RECESS = 9.0, 0.5, 0.26
AXES = (-3.5, -1.75, 0.0, 1.75, 3.5)
"""Centers of the openings, in x."""
OPENING = 1.0
"""Width of an opening."""
FLOORS = ((0.0, 0.75, 2.45, 2.9), (2.9, 3.6, 5.2, 5.9))
"""Per floor: foot of the wall, sill, lintel, top of the wall, in y. The front of the wall is at z = 0."""


def facade() -> SyntheticScene:
    """Return the scene; it is best photographed from 5 to 7 units in front of it."""
    bodies = [
        Body(ground((-4.8, 4.8), (-0.6, 2.2), unevenness=0.012), replace(PAVING, scale=0.4)),
        Body(_wall(0), ASHLAR),
        Body(_wall(1), BRICK),
    ]
    return SyntheticScene(
        "facade", (*bodies, *_windows(), *_courses(), *_portal(), *_balcony(), *_street()), to_light=(-0.55, 0.7, 0.6)
    )


def facade_views(camera: Camera, seed: int = 0) -> Views:
    """Return 12 hand-held photos along the street.

    Args:
        camera: of all photos.
        seed: same seed, same poses.
    """
    return wall_walk(camera, WallWalkOptions(length=8.5, distance=(6.6, 8.4), height=(1.3, 2.6), aim=(2.5, 3.5)), seed)


def _wall(floor: int) -> Shape:
    """Return the wall of a floor around its openings."""
    foot, sill, lintel, top = FLOORS[floor]
    low = [(-WIDTH / 2, WIDTH / 2, lintel, top)]
    edges = [-WIDTH / 2, *(x + side * OPENING / 2 for x in AXES for side in (-1, 1)), WIDTH / 2]
    low += [(edges[k], edges[k + 1], foot, lintel) for k in range(0, len(edges), 2)]
    doors = (0.0,)  # on both floors: the door below, the balcony's above
    low += [(x - OPENING / 2, x + OPENING / 2, foot, sill) for x in AXES if x not in doors]
    return assemble([
        box(right - left, up - down, THICKNESS, spacing=0.12).move(((left + right) / 2, down, -THICKNESS / 2))
        for left, right, down, up in low
    ])  # fmt: skip


def _windows() -> list[Body]:
    """Return panes, bars and sills; curtains, shutters and flowers differ between the windows."""
    bodies = []
    for floor, (foot, sill, lintel, _) in enumerate(FLOORS):
        for k, x in enumerate(AXES):
            bottom = foot + 0.02 if x == 0.0 else sill
            bodies += _pane(x, bottom, lintel, curtain=(3 * k + 2 * floor) % 5)
            if x != 0.0:
                bodies.append(Body(box(OPENING + 0.3, 0.1, 0.22).move((x, sill - 0.1, 0.06)), LIMESTONE))
            if floor and k in (0, 1, 4):
                high = lintel - bottom
                for side, turn in ((-1.0, 14.0 + 6.0 * k), (1.0, -8.0 - 5.0 * k)):
                    leaf = box(0.48, high, 0.05, spacing=0.08).move((side * 0.26, 0.0, 0.0))
                    bodies.append(Body(leaf.move((x + side * OPENING / 2, bottom, 0.05), turn_deg=turn), SHUTTER))
            bodies.append(Body(box(OPENING + 0.3, 0.16, 0.12 + 0.04 * floor).move((x, lintel, 0.04)), SANDSTONE))
    for x, floor in ((-3.5, 1), (1.75, 1), (1.75, 0)):
        y = FLOORS[floor][1]
        bodies.append(Body(box(0.8, 0.16, 0.18, spacing=0.06).move((x, y, 0.08)), TERRACOTTA))
        bodies += [
            Body(
                ball(0.15, bumps=0.12, seed=round(10 * x) + j + 50).move((x - 0.27 + 0.27 * j, y + 0.22, 0.1)), FLOWERS
            )
            for j in range(3)
        ]
    return bodies


def _pane(x: float, bottom: float, top: float, curtain: int) -> list[Body]:
    high, z = top - bottom, -RECESS
    bars = [
        box(0.07, high, 0.08).move((x - OPENING / 2 + 0.035, bottom, z)),
        box(0.07, high, 0.08).move((x + OPENING / 2 - 0.035, bottom, z)),
        box(0.06, high, 0.08).move((x, bottom, z)),
        box(OPENING, 0.07, 0.08).move((x, bottom, z)),
        box(OPENING, 0.07, 0.08).move((x, top - 0.07, z)),
        box(OPENING, 0.05, 0.08).move((x, bottom + 0.62 * high, z)),
    ]
    bodies = [Body(box(OPENING, high, 0.02).move((x, bottom, z - 0.02)), GLASS), Body(assemble(bars), FRAME)]
    if curtain:
        width = 0.2 + 0.09 * curtain
        bodies.append(
            Body(box(width, high * 0.9, 0.01).move((x - 0.45 + width / 2, bottom + 0.08, z - 0.005)), CURTAIN)
        )
    return bodies


def _courses() -> list[Body]:
    """Return plinth, courses, quoins and cornice of the whole front."""
    top = FLOORS[1][3]
    plinth = assemble([box(3.85, 0.4, 0.14).move((side * 2.575, -0.02, 0.05)) for side in (-1.0, 1.0)])
    brackets = [box(0.14, 0.2, 0.3).move((x, top - 0.14, 0.12)) for x in np.linspace(-4.3, 4.3, 22)]
    quoins = [
        box(0.5 if k % 2 else 0.36, 0.3, 0.1).move(
            (side * (WIDTH / 2 - (0.25 if k % 2 else 0.18)), 3.02 + 0.31 * k, 0.03)
        )
        for k in range(9)
        for side in (-1.0, 1.0)
    ]
    return [
        Body(plinth, LIMESTONE),
        Body(box(WIDTH + 0.1, 0.16, 0.2).move((0.0, 2.84, 0.06)), SANDSTONE),
        Body(assemble(brackets), SANDSTONE),
        Body(assemble(quoins), LIMESTONE),
        Body(box(WIDTH + 0.3, 0.16, 0.66).move((0.0, top, 0.05)), SANDSTONE),
        Body(box(WIDTH + 0.2, 0.12, 0.5).move((0.0, top + 0.16, 0.0)), TERRACOTTA),
    ]


def _portal() -> list[Body]:
    column = revolve(np.array([[0.15, 0.0], [0.155, 0.6], [0.12, 1.9]]), segments=80, flutes=(18, 0.07))
    ring = revolve(np.array([[0.0, 0.0], [0.2, 0.0], [0.2, 0.07], [0.16, 0.12], [0.0, 0.12]]), segments=48, sharp=True)
    bodies = [
        Body(box(2.3, 0.14, 0.95).move((0.0, 0.0, 0.45)), LIMESTONE),
        Body(box(2.7, 0.07, 1.25).move((0.0, -0.01, 0.5)), SANDSTONE),
        Body(box(2.2, 0.2, 0.74).move((0.0, 2.4, 0.35)), SANDSTONE),
        Body(box(0.9, 2.2, 0.06, spacing=0.1).move((0.0, 0.14, -0.2)), WOOD),
        Body(ball(0.045, segments=32).move((0.3, 1.1, -0.14)), TERRACOTTA),
    ]
    for x in (-0.8, 0.8):
        bodies += [
            Body(ring.move((x, 0.14, 0.5)), LIMESTONE),
            Body(column.move((x, 0.26, 0.5)), LIMESTONE),
            Body(ring.move((x, 2.4, 0.5), tilt_deg=180.0), LIMESTONE),
        ]
    return bodies


def _balcony() -> list[Body]:
    """Return the balcony on the portal."""
    y = 2.6
    baluster = revolve(
        np.array(
            [[0.0, 0.0], [0.05, 0.0], [0.05, 0.04], [0.03, 0.1], [0.06, 0.22], [0.03, 0.42], [0.05, 0.5], [0.05, 0.55]]
        ),
        segments=32,
    )
    front = [baluster.move((x, y + 0.12, 0.8)) for x in np.linspace(-1.1, 1.1, 10)]
    sides = [baluster.move((x, y + 0.12, z)) for x in (-1.1, 1.1) for z in (0.2, 0.45)]
    rails = [box(2.4, 0.09, 0.14).move((0.0, y + 0.66, 0.8))]
    rails += [box(0.14, 0.09, 0.74).move((x, y + 0.66, 0.37)) for x in (-1.13, 1.13)]
    return [
        Body(box(2.5, 0.12, 0.95).move((0.0, y, 0.45)), SANDSTONE),
        Body(assemble([*front, *sides]), LIMESTONE),
        Body(assemble(rails), LIMESTONE),
    ]


def _street() -> list[Body]:
    pot = revolve(
        np.array([[0.0, 0.0], [0.2, 0.0], [0.3, 0.45], [0.33, 0.45], [0.33, 0.52], [0.27, 0.52], [0.0, 0.5]]),
        sharp=True,
    )
    return [
        Body(pot.move((-1.75, 0.0, 0.6)), TERRACOTTA),
        Body(ball(0.4, bumps=0.1, seed=4).move((-1.75, 0.82, 0.6)), replace(FLOWERS, second=(112, 142, 60))),
        Body(box(1.5, 0.09, 0.42).move((2.7, 0.42, 0.75), turn_deg=6.0), WOOD),
        Body(box(0.12, 0.42, 0.36).move((2.15, 0.0, 0.8), turn_deg=6.0), SANDSTONE),
        Body(box(0.12, 0.42, 0.36).move((3.25, 0.0, 0.7), turn_deg=6.0), SANDSTONE),
        Body(box(0.4, 0.5, 0.4, spacing=0.08).move((-3.3, 0.0, 0.7), turn_deg=32.0), WOOD),
    ]


PLASTER = Material(
    pattern="stone", base=(214, 208, 192), second=(205, 198, 182), joint=(208, 202, 186), scale=0.5, contrast=0.03
)
"""Painted plaster: its gray levels vary by about as much as the noise of a photo."""
PAPER = Material(
    pattern="leaves", base=(150, 164, 158), second=(186, 190, 172), joint=(122, 138, 136), scale=0.11, contrast=0.25
)
BOARDS = replace(WOOD, base=(166, 120, 74), second=(126, 84, 48), scale=0.26)
OAK = replace(WOOD, base=(150, 104, 60), second=(98, 62, 34), scale=0.2)
WHITE = Material(
    pattern="wood", base=(206, 202, 192), second=(186, 180, 168), joint=(160, 154, 142), scale=0.24, contrast=0.2
)
CLOTH = Material(
    pattern="leaves", base=(128, 52, 48), second=(168, 96, 74), joint=(84, 34, 34), scale=0.04, contrast=0.5
)
RUG = Material(
    pattern="paving", base=(140, 48, 44), second=(186, 140, 84), joint=(44, 40, 70), scale=0.16, contrast=0.6
)
CANVAS = (
    Material(pattern="marble", base=(70, 104, 140), second=(222, 196, 140), joint=(38, 58, 52), scale=0.16),
    Material(pattern="leaves", base=(196, 132, 60), second=(88, 110, 70), joint=(52, 36, 34), scale=0.07),
    Material(pattern="stone", base=(176, 84, 62), second=(232, 206, 150), joint=(40, 52, 84), scale=0.2),
)
SIDE, HEIGHT = 3.2, 2.5
"""Size of the room, in scene units; its corner is at x = z = 0."""
TURN_DEG, MIDDLE = -45.0, (0.0, 0.0, -1.9)
"""Rotation and translation that turn the corner towards +z and put it behind the origin, at which the photos aim."""


def corner() -> SyntheticScene:
    """Return the scene; the light comes over the photographer's shoulder."""
    bodies = [*_walls(), *_shelf(), *_pictures(), *_table(), *_armchair(), *_things()]
    placed = tuple(replace(body, shape=body.shape.move(MIDDLE, turn_deg=TURN_DEG)) for body in bodies)
    return SyntheticScene("corner", placed, to_light=(-0.25, 0.8, 0.75), sun=0.55, sky=0.75)


def corner_views(camera: Camera, seed: int = 0) -> Views:
    """Return 14 hand-held photos from the other half of the room.

    Args:
        camera: of all photos.
        seed: same seed, same poses.
    """
    walk = ArcOptions(
        photos=14, sweep_deg=70.0, distance=(1.9, 2.9), height=(1.0, 1.9), aim=(0.0, 0.95, -0.9), aim_spread=0.3,
        roll_deg=4.0,
    )  # fmt: skip
    return arc(camera, walk, seed)


def _walls() -> list[Body]:
    # uneven ground turned upright, since plaster is not quite flat
    plain = ground((0.0, SIDE), (-HEIGHT, 0.0), unevenness=0.003, spacing=0.06).move(tilt_deg=90.0)
    papered = box(0.1, HEIGHT, SIDE, spacing=0.08).move((-0.05, 0.0, SIDE / 2))
    floor = box(SIDE, SIDE, 0.05, spacing=0.08).move((SIDE / 2, 0.0, 0.0), tilt_deg=90.0).move((0.0, -0.025, 0.0))
    skirting = assemble([
        box(SIDE, 0.12, 0.03).move((SIDE / 2, 0.0, 0.015)), box(0.03, 0.12, SIDE).move((0.015, 0.0, SIDE / 2))
    ])  # fmt: skip
    return [Body(plain, PLASTER), Body(papered, PAPER), Body(floor, BOARDS), Body(skirting, WHITE)]


def _shelf() -> list[Body]:
    """Return a shelf of books against the papered wall."""
    rng = np.random.default_rng(17)
    boards = [box(0.28, 0.03, 1.0).move((0.15, y, 2.2)) for y in (0.02, 0.42, 0.82, 1.22)]
    boards += [box(0.28, 1.25, 0.03).move((0.15, 0.0, z)) for z in (1.7, 2.7)]
    bodies = [Body(assemble(boards), OAK), Body(box(0.01, 1.22, 1.0).move((0.01, 0.0, 2.2)), OAK)]
    covers = [(148, 40, 38), (44, 70, 110), (58, 92, 60), (196, 168, 110), (92, 54, 88), (52, 48, 46), (206, 196, 180)]
    for y in (0.05, 0.45, 0.85):
        z = 1.73
        while z < 2.52:
            thick, high, deep = rng.uniform((0.025, 0.2, 0.14), (0.06, 0.31, 0.2))
            color = covers[rng.integers(len(covers))]
            cover = Material(pattern="stone", base=color, second=(180, 150, 90), joint=(60, 50, 40), scale=0.06)
            book = box(deep, high, thick, spacing=0.05).move((0.03 + deep / 2, y, z + thick / 2))
            bodies.append(Body(book, cover))
            z += thick + 0.002
    return [*bodies, Body(ball(0.12).move((0.16, 1.37, 2.0)), MARBLE), Body(_vase(0.6).move((0.15, 1.25, 2.45)), PAINT)]


def _pictures() -> list[Body]:
    bodies = []
    for canvas, (y, z, high, wide) in zip(
        CANVAS, ((1.3, 1.0, 0.6, 0.75), (0.75, 0.45, 0.42, 0.34), (1.62, 2.15, 0.5, 0.7)), strict=True
    ):
        rails = [box(0.04, 0.05, wide).move((0.02, at, z)) for at in (y, y + high - 0.05)]
        rails += [box(0.04, high, 0.05).move((0.02, y, z + side * (wide / 2 - 0.025))) for side in (-1.0, 1.0)]
        bodies += [
            Body(assemble(rails), OAK),
            Body(box(0.02, high - 0.06, wide - 0.06).move((0.01, y + 0.03, z)), canvas),
        ]
    return bodies


def _table() -> list[Body]:
    """Return a table in front of the plain wall, which is visible above and beside it."""
    legs = [box(0.05, 0.6, 0.05).move((1.35 + x, 0.0, 0.45 + z)) for x in (-0.4, 0.4) for z in (-0.22, 0.22)]
    top = box(0.95, 0.04, 0.56, spacing=0.06).move((1.35, 0.6, 0.45))
    lamp = revolve(np.array([[0.1, 0.0], [0.1, 0.02], [0.02, 0.04], [0.02, 0.3], [0.0, 0.3]]), segments=40, sharp=True)
    shade = revolve(np.array([[0.16, 0.0], [0.09, 0.2], [0.0, 0.2]]), segments=64, sharp=True)
    return [
        Body(assemble([*legs, top]), OAK),
        Body(_vase(0.8).move((1.2, 0.64, 0.42)), POTTERY),
        Body(lamp.move((1.65, 0.64, 0.4)), TERRACOTTA),
        Body(shade.move((1.65, 0.88, 0.4)), replace(CLOTH, base=(206, 176, 120), second=(176, 132, 84))),
        Body(box(0.24, 0.05, 0.18, spacing=0.05).move((1.4, 0.64, 0.58), turn_deg=24.0), CANVAS[2]),
        Body(box(0.2, 0.04, 0.15, spacing=0.05).move((1.41, 0.69, 0.57), turn_deg=-11.0), CANVAS[0]),
    ]


def _armchair() -> list[Body]:
    parts = [
        box(0.66, 0.3, 0.62, spacing=0.06).move((0.0, 0.12, 0.0)),
        box(0.66, 0.5, 0.16, spacing=0.06).move((0.0, 0.36, -0.26), tilt_deg=-9.0),
        box(0.13, 0.5, 0.62, spacing=0.06).move((-0.34, 0.1, 0.0)),
        box(0.13, 0.5, 0.62, spacing=0.06).move((0.34, 0.1, 0.0)),
    ]
    cushion = ball(0.2, bumps=0.03, seed=3).move((0.02, 0.56, -0.06))
    feet = assemble([box(0.06, 0.12, 0.06).move((x, 0.0, z)) for x in (-0.32, 0.32) for z in (-0.24, 0.24)])
    spot = (2.45, 0.0, 0.75)
    return [
        Body(assemble(parts).move(spot, turn_deg=-28.0), CLOTH),
        Body(cushion.move(spot, turn_deg=-28.0), replace(PAINT, scale=0.12)),
        Body(feet.move(spot, turn_deg=-28.0), OAK),
    ]


def _things() -> list[Body]:
    pot = revolve(
        np.array([[0.0, 0.0], [0.13, 0.0], [0.19, 0.28], [0.21, 0.28], [0.21, 0.33], [0.17, 0.33], [0.0, 0.31]]),
        sharp=True,
    )
    return [
        Body(box(1.5, 0.015, 1.1, spacing=0.06).move((1.5, 0.0, 1.6), turn_deg=8.0), RUG),
        Body(pot.move((0.4, 0.0, 0.42)), TERRACOTTA),
        Body(ball(0.27, bumps=0.13, seed=9).move((0.4, 0.55, 0.42)), LEAVES),
        Body(torus(0.12, 0.04).move((1.9, 0.055, 1.5), turn_deg=20.0), replace(PAINT, scale=0.1)),
        Body(ball(0.11).move((1.1, 0.125, 1.4), turn_deg=50.0, tilt_deg=30.0), MARBLE),
    ]


def _vase(scale: float) -> Shape:
    profile = np.array([
        [0.0, 0.0], [0.08, 0.0], [0.07, 0.03], [0.13, 0.14], [0.15, 0.24], [0.1, 0.36], [0.06, 0.42], [0.09, 0.47],
        [0.07, 0.45], [0.04, 0.3],
    ])  # fmt: skip
    return revolve(scale * profile, segments=96)


def poster() -> SyntheticScene:
    """Return a flat wall of veined marble across the view, facing +z."""
    return SyntheticScene("poster", (Body(box(9.0, 6.0, 0.1).move((0.0, -1.5, -0.1)), MARBLE),))


def heap() -> SyntheticScene:
    """Return boxes and balls strewn over leaves."""
    rng = np.random.default_rng(3)
    materials = (WOOD, MARBLE, PAINT, TERRACOTTA, GREEN_MARBLE, LEAVES)
    bodies = [Body(ground((-4.0, 4.0), (-3.0, 5.0), unevenness=0.05), LEAVES)]
    for k in range(18):
        x, z = rng.uniform((-2.5, -2.0), (2.5, 2.0))
        width, height, depth = rng.uniform(0.4, 1.2, 3)
        stood = box(width, height, depth).move((x, 0.0, z), turn_deg=rng.uniform(0.0, 90.0))
        bodies += [
            Body(stood, materials[k % len(materials)]),
            Body(ball(0.3).move((x + 0.4, rng.uniform(1.0, 2.0), z)), materials[(k + 1) % len(materials)]),
        ]
    return SyntheticScene("heap", tuple(bodies))


INK: Color = (22, 22, 24)
SHEET: Color = (232, 230, 224)


def marker_sheet(
    pattern: NDArray[np.uint8],
    side: float,
    to: tuple[float, float, float],
    turn_deg: float = 0.0,
    tilt_deg: float = 0.0,
) -> tuple[Body, Body]:
    """Return a marker on a sheet of paper, which has a light cell around it: dark cells, and light ones.

    Args:
        pattern: (N, N) cells with the dark border, 0 or 255; its first row is the far one.
        side: of the dark square, in scene units.
        to: where its middle is.
        turn_deg: about y, right-handed; without tilt it lies flat and faces up.
        tilt_deg: about x, right-handed, before the turn; 90: it stands upright and faces z.
    """
    cells = np.pad(pattern > 127, 1, constant_values=True)
    size = side / len(pattern)
    return (
        Body(_squares(~cells, size).move(to, turn_deg, tilt_deg), _plain(INK)),
        Body(_squares(cells, size).move(to, turn_deg, tilt_deg), _plain(SHEET)),
    )


def _squares(chosen: NDArray[np.bool_], size: float) -> Shape:
    """Return the chosen cells of a grid about the origin, flat on y = 0; rows run towards z."""
    places = np.argwhere(chosen)[:, ::-1] - len(chosen) / 2  # x and z of each cell's corner
    corners = np.array([[0, 0], [0, 1], [1, 1], [1, 0]])
    flat = size * (places[:, None] + corners).reshape(-1, 2)
    vertices = np.column_stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]])
    first = 4 * np.arange(len(places), dtype=np.int64)[:, None]
    faces = np.concatenate([first + np.array(half) for half in ([0, 1, 2], [0, 2, 3])])
    return Shape(vertices, faces, np.tile([0.0, 1.0, 0.0], (len(vertices), 1)), vertices)


def _plain(color: Color) -> Material:
    """Return a material of one color."""
    return Material(pattern="ceramic", base=color, second=color, joint=color, contrast=0.0)


SCENES: Mapping[str, Callable[[], SyntheticScene]] = MappingProxyType({
    "courtyard": courtyard, "poster": poster, "heap": heap, "statue": statue, "facade": facade, "corner": corner,
    "town": town, "ornament": ornament, "railing": railing, "garden": garden,
})  # fmt: skip
WALKS: Mapping[str, Callable[[int], Views]] = MappingProxyType({
    "courtyard": lambda seed: arc(make_camera(960, 640), seed=seed),
    "statue": lambda seed: statue_views(make_camera(800, 1152, focal_widths=1.35), seed),
    "facade": lambda seed: facade_views(make_camera(1152, 768), seed),
    "corner": lambda seed: corner_views(make_camera(1152, 768, focal_widths=0.9), seed),
    "town": lambda seed: town_views(
        make_camera(1200, 900, focal_widths=0.8), TownPhotos(photos=40, step_m=1.5, seed=seed)
    ),
    "ornament": lambda seed: ornament_views(make_camera(1800, 1350, focal_widths=1.0), seed),
    "railing": lambda seed: railing_views(make_camera(1800, 1350, focal_widths=0.95), seed),
    "garden": lambda seed: garden_views(make_camera(1800, 1200, focal_widths=1.0), seed),
})  # fmt: skip
"""By scene: a walk with a suitable camera; the seed varies the poses."""

Item = TypeVar("Item")


def build_scene(name: str = "courtyard") -> SyntheticScene:
    """Return the scene of that name.

    Raises:
        ConfigError: there is no such scene; the message names the known ones.
    """
    return _look_up(name, SCENES)()


def scene_views(name: str = "courtyard", seed: int = 0) -> Views:
    """Return the photos of the walk through that scene.

    Args:
        name: of a scene in `WALKS`.
        seed: same seed, same poses.

    Raises:
        ConfigError: there is no such scene; the message names the known ones.
    """
    return _look_up(name, WALKS)(seed)


def _look_up(name: str, known: Mapping[str, Item]) -> Item:
    if name not in known:
        raise ConfigError(f"no synthetic scene is named '{name}'", hint=f"known: {', '.join(known)}")
    return known[name]
