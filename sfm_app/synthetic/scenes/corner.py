"""The corner of a room, photographed from inside: a floor, a papered wall, and a plain painted one."""

from dataclasses import replace

import numpy as np

from sfm_app.synthetic.cameras import ArcOptions, Camera, Views, arc
from sfm_app.synthetic.scenes.bodies import Body, SyntheticScene
from sfm_app.synthetic.scenes.courtyard import LEAVES, MARBLE, PAINT, POTTERY, TERRACOTTA, WOOD
from sfm_app.synthetic.scenes.shapes import Shape, assemble, ball, box, ground, revolve, torus
from sfm_app.synthetic.scenes.textures import Material

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
    return [
        *bodies,
        Body(ball(0.12).move((0.16, 1.37, 2.0)), MARBLE),
        Body(_vase(0.6).move((0.15, 1.25, 2.45)), PAINT),
    ]


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
