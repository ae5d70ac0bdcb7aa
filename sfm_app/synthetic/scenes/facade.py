"""A house front with depth in it: windows set back, sills, a balcony, a portal with columns, a cornice."""

from dataclasses import replace

import numpy as np

from sfm_app.synthetic.cameras import Camera, Views, WallWalkOptions, wall_walk
from sfm_app.synthetic.scenes.bodies import Body, SyntheticScene
from sfm_app.synthetic.scenes.courtyard import BRICK, LIMESTONE, PAVING, SANDSTONE, TERRACOTTA, WOOD
from sfm_app.synthetic.scenes.shapes import Shape, assemble, ball, box, ground, revolve
from sfm_app.synthetic.scenes.textures import Material

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
    bodies = [
        Body(box(OPENING, high, 0.02).move((x, bottom, z - 0.02)), GLASS),
        Body(assemble(bars), FRAME),
    ]
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
