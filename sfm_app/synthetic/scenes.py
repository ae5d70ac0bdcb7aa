"""Two detailed scenes: a courtyard with objects, and a bust on a plinth."""

from dataclasses import replace
from functools import cache

import numpy as np

from sfm_app.synthetic.cameras import ArcOptions, Camera, Views, arc
from sfm_app.synthetic.shapes import (
    Body,
    Material,
    Shape,
    SyntheticScene,
    arch,
    ball,
    box,
    carve,
    ground,
    revolve,
    torus,
    waves,
)
from sfm_app.types.arrays import FloatArray

SANDSTONE = Material(pattern="stone", base=(206, 186, 150), second=(158, 132, 98), scale=0.35)
LIMESTONE = Material(pattern="stone", base=(214, 208, 194), second=(166, 158, 142), scale=0.3, contrast=0.45)
PLASTER = Material(pattern="stone", base=(204, 164, 116), second=(178, 128, 88), scale=0.35)
TERRACOTTA = Material(pattern="stone", base=(192, 104, 66), second=(150, 72, 48), scale=0.2)
GLAZE = Material(pattern="stone", base=(60, 46, 40), second=(150, 84, 46), scale=0.15)
BRICK = Material(
    pattern="brick", base=(150, 76, 56), second=(188, 116, 84), joint=(190, 182, 168), scale=0.16, contrast=0.6
)
PAVING = Material(pattern="paving", base=(150, 146, 138), second=(116, 112, 108), scale=0.55, contrast=0.6)
POTTERY = Material(
    pattern="ceramic", base=(206, 122, 62), second=(44, 34, 32), joint=(226, 198, 150), scale=0.085, contrast=0.45
)
WOOD = Material(pattern="wood", base=(178, 132, 82), second=(120, 78, 42), joint=(48, 32, 20), scale=0.24)
MARBLE = Material(
    pattern="marble", base=(224, 220, 214), second=(88, 92, 104), joint=(180, 160, 130), scale=0.3, contrast=0.35
)
GREEN_MARBLE = replace(MARBLE, base=(70, 110, 88), second=(206, 214, 196), joint=(30, 52, 44))
LEAVES = Material(pattern="leaves", base=(46, 92, 34), second=(124, 156, 62), joint=(18, 34, 14), scale=0.055)
PAINT = Material(
    pattern="stripes", base=(38, 84, 140), second=(222, 206, 170), joint=(120, 92, 70), scale=0.2, contrast=0.4
)

BACK_WALL_Z = -2.6
PEDESTAL_TOP_Y = 1.36


def courtyard() -> SyntheticScene:
    """Return the scene; it is best photographed from about 5 units away on the side of +z."""
    floor = Body(ground((-5.2, 5.2), (-3.0, 7.0), unevenness=0.02), PAVING)
    bodies = [floor, *_back_wall(), *_arcade(), *_side_walls(), *_pedestal(), *_amphora(), *_leaning_objects()]
    return SyntheticScene("courtyard", (*bodies, *_round_objects()))


def _back_wall() -> list[Body]:
    z = BACK_WALL_Z
    wall = Body(box(10.4, 3.3, 0.4).move((0.0, 0.0, z - 0.2)), BRICK)
    plinth = Body(box(10.4, 0.35, 0.16).move((0.0, -0.05, z + 0.08)), SANDSTONE)
    cornice = Body(box(10.4, 0.22, 0.62).move((0.0, 3.3, z - 0.1)), SANDSTONE)
    brackets = [Body(box(0.16, 0.16, 0.2).move((x, 3.14, z + 0.1)), SANDSTONE) for x in np.linspace(-5.0, 5.0, 26)]
    return [wall, plinth, cornice, *brackets]


def _arcade() -> list[Body]:
    z = BACK_WALL_Z
    column = revolve(_profile((0.17, 0.13), (0.0, 1.35)), segments=80, flutes=(20, 0.06))
    ring = revolve(_profile((0.0, 0.2, 0.2, 0.16, 0.0), (0.0, 0.0, 0.07, 0.12, 0.12)), segments=48, sharp=True)
    # intermediate rings, so that shading under the arch is not interpolated across the disc
    rims = _profile((0.65, 0.65, 0.5, 0.35, 0.2, 0.0), (0.0, 0.06, 0.06, 0.06, 0.06, 0.06))
    half_disc = revolve(rims, segments=40, span_deg=180.0, sharp=True)
    bodies = []
    for x in (-3.6, -1.8, 0.0, 1.8, 3.6):
        bodies += [
            Body(box(0.5, 0.22, 0.42).move((x, 0.28, z + 0.2)), SANDSTONE),
            Body(ring.move((x, 0.5, z + 0.22)), LIMESTONE),
            Body(column.move((x, 0.6, z + 0.22)), LIMESTONE),
            Body(ring.move((x, 2.06, z + 0.22), tilt_deg=180.0), LIMESTONE),
            Body(box(0.52, 0.12, 0.44).move((x, 2.05, z + 0.2)), SANDSTONE),
        ]
    for x in (-2.7, -0.9, 0.9, 2.7):
        bodies += [
            Body(arch(0.68, 0.2, 0.3).move((x, 2.17, z)), SANDSTONE),
            Body(box(1.3, 1.92, 0.12).move((x, 0.25, z)), PLASTER),
            Body(half_disc.move((x, 2.17, z), tilt_deg=90.0), PLASTER),
        ]
    return bodies


def _side_walls() -> list[Body]:
    bodies = []
    for x in (-5.0, 5.0):
        bodies.append(Body(box(0.5, 1.1, 6.4).move((x, 0.0, 0.5)), BRICK))
        bodies.append(Body(box(0.66, 0.12, 6.5).move((x, 1.1, 0.5)), SANDSTONE))
        bodies += [Body(ball(0.24, segments=48).move((x, 1.42, z)), LIMESTONE) for z in (-0.6, 1.4, 3.4)]
    return bodies


def _pedestal() -> list[Body]:
    steps = [(2.1, 0.18, 0.0), (1.6, 0.16, 0.18), (1.15, 0.16, 0.34)]
    bodies = [Body(box(w, h, w, spacing=0.1).move((0.0, y, 0.0)), LIMESTONE) for w, h, y in steps]
    radius = (0.0, 0.42, 0.42, 0.33, 0.3, 0.3, 0.4, 0.4, 0.0)
    height = (0.0, 0.0, 0.08, 0.14, 0.2, 0.68, 0.76, 0.86, 0.86)
    drum = revolve(_profile(radius, height), segments=8, sharp=True)
    return [*bodies, Body(drum.move((0.0, PEDESTAL_TOP_Y - 0.86, 0.0), turn_deg=22.5), GREEN_MARBLE)]


def _amphora() -> list[Body]:
    radius = (0.0, 0.15, 0.15, 0.08, 0.13, 0.25, 0.31, 0.29, 0.19, 0.105, 0.1, 0.13, 0.18, 0.16, 0.09, 0.07)
    height = (0.0, 0.0, 0.03, 0.07, 0.16, 0.36, 0.56, 0.72, 0.86, 0.95, 1.06, 1.13, 1.16, 1.19, 1.15, 0.9)
    body = revolve(_catmull_rom(_profile(radius, height), 6), segments=128)
    # an open ring, turned so that its gap faces -x, then set upright
    handle = torus(0.19, 0.026, span_deg=220.0).move(turn_deg=-110.0).move(tilt_deg=90.0)
    y = PEDESTAL_TOP_Y
    return [
        Body(body.move((0.0, y, 0.0)), POTTERY),
        Body(handle.move((0.19, y + 0.93, 0.0)), GLAZE),
        Body(handle.move((-0.19, y + 0.93, 0.0), turn_deg=180.0), GLAZE),
    ]


def _leaning_objects() -> list[Body]:
    drum = revolve(_profile((0.0, 0.27, 0.27, 0.0), (0.0, 0.0, 0.62, 0.62)), segments=96, sharp=True, flutes=(16, 0.08))
    small_brick = replace(BRICK, scale=0.1)
    return [
        Body(box(0.8, 0.62, 0.62, spacing=0.08).move((1.85, 0.0, 0.55), turn_deg=28.0), WOOD),
        Body(box(0.44, 0.36, 0.4, spacing=0.08).move((1.8, 0.62, 0.5), turn_deg=-15.0), WOOD),
        Body(torus(0.34, 0.11).move((1.42, 0.39, 1.15), turn_deg=28.0, tilt_deg=68.0), replace(SANDSTONE, scale=0.2)),
        Body(drum.move((0.75, 0.27, 2.0), turn_deg=65.0, tilt_deg=90.0), LIMESTONE),
        Body(box(0.5, 0.3, 0.36).move((-0.55, 0.0, 2.1), turn_deg=-20.0), small_brick),
    ]


def _round_objects() -> list[Body]:
    radius = (0.0, 0.22, 0.34, 0.39, 0.39, 0.33, 0.31, 0.0)
    height = (0.0, 0.0, 0.5, 0.5, 0.58, 0.58, 0.52, 0.52)
    pot = revolve(_profile(radius, height), sharp=True)
    bodies = [
        Body(ball(0.36).move((-1.75, 0.36, 1.2), turn_deg=20.0, tilt_deg=30.0), MARBLE),
        Body(ball(0.2, segments=64).move((-1.15, 0.2, 1.75), tilt_deg=70.0), PAINT),
    ]
    for k, x in enumerate((-2.9, 2.95)):
        bodies.append(Body(pot.move((x, 0.0, -1.3)), TERRACOTTA))
        bodies.append(Body(ball(0.55, bumps=0.09, seed=k).move((x, 0.98, -1.3)), LEAVES))
    return bodies


def _profile(radius: tuple[float, ...], height: tuple[float, ...]) -> FloatArray:
    return np.column_stack([radius, height])


def _catmull_rom(knots: FloatArray, steps: int) -> FloatArray:
    # Catmull-Rom through the knots, ends doubled
    p = np.concatenate([knots[:1], knots, knots[-1:]])
    u = np.linspace(0.0, 1.0, steps, endpoint=False)[None, :, None]
    a, b, c, d = (p[k : len(p) - 3 + k, None] for k in range(4))
    curve = 0.5 * (2 * b + (c - a) * u + (2 * a - 5 * b + 4 * c - d) * u**2 + (3 * b - a - 3 * c + d) * u**3)
    points = np.concatenate([curve.reshape(-1, 2), knots[-1:]])
    return np.column_stack([np.maximum(points[:, 0], 0.0), points[:, 1]])


STONE = Material(pattern="stone", base=(222, 214, 198), second=(168, 158, 140), joint=(92, 86, 76), scale=0.22)
BOX_LEAVES = Material(pattern="leaves", base=(50, 88, 38), second=(112, 142, 66), joint=(20, 34, 16), scale=0.045)
BRONZE = Material(
    pattern="leaves", base=(74, 96, 66), second=(132, 118, 66), joint=(40, 44, 30), scale=0.035, contrast=0.4
)
PLINTH_TOP_Y = 1.02
BLOBS = np.array([
    # middle x, y, z; half axes x, y, z; weight
    (0.0, 0.30, 0.00, 0.40, 0.31, 0.24, 1.0),  # chest
    (0.32, 0.35, -0.03, 0.20, 0.20, 0.19, 1.0),  # shoulders
    (-0.32, 0.35, -0.03, 0.20, 0.20, 0.19, 1.0),
    (0.0, 0.60, -0.02, 0.13, 0.22, 0.13, 1.0),  # neck
    (0.0, 0.880, 0.02, 0.165, 0.24, 0.20, 1.0),  # head
    (0.0, 0.730, 0.12, 0.10, 0.075, 0.09, 0.9),  # jaw
    (0.09, 0.800, 0.13, 0.07, 0.07, 0.07, 0.5),  # cheeks
    (-0.09, 0.800, 0.13, 0.07, 0.07, 0.07, 0.5),
    (0.0, 0.865, 0.235, 0.028, 0.085, 0.045, 0.9),  # nose
    (0.0, 0.820, 0.262, 0.032, 0.022, 0.03, 0.7),
    (0.075, 0.943, 0.20, 0.075, 0.018, 0.035, 0.5),  # brows
    (-0.075, 0.943, 0.20, 0.075, 0.018, 0.035, 0.5),
    (0.078, 0.900, 0.225, 0.05, 0.03, 0.05, -0.6),  # sockets
    (-0.078, 0.900, 0.225, 0.05, 0.03, 0.05, -0.6),
    (0.076, 0.895, 0.19, 0.034, 0.024, 0.03, 0.8),  # eyes
    (-0.076, 0.895, 0.19, 0.034, 0.024, 0.03, 0.8),
    (0.0, 0.764, 0.215, 0.06, 0.012, 0.03, 0.7),  # lips
    (0.0, 0.738, 0.21, 0.046, 0.012, 0.03, 0.7),
    (0.2, 0.870, -0.01, 0.026, 0.065, 0.045, 1.0),  # ears
    (-0.2, 0.870, -0.01, 0.026, 0.065, 0.045, 1.0),
    (0.0, 0.960, -0.07, 0.20, 0.20, 0.19, 1.0),  # hair
    (0.0, 0.860, -0.27, 0.10, 0.11, 0.09, 1.0),
])  # fmt: skip
HAIR = slice(-2, None)


def statue() -> SyntheticScene:
    """Return the scene; the bust looks towards +z, and the terrace is small, so that the bust fills the scene."""
    return SyntheticScene("statue", (*_terrace(), *_plinth(), *_bust()), to_light=(0.5, 0.75, 0.42), sky=0.6)


def statue_views(camera: Camera, seed: int = 0, photos: int = 22) -> Views:
    """Return hand-held photos all round."""
    walk = ArcOptions(
        photos=photos, sweep_deg=344.0, distance=(3.3, 4.3), height=(1.0, 2.9), aim=(0.0, 1.2, 0.0), aim_spread=0.2,
        roll_deg=5.0,
    )  # fmt: skip
    return arc(camera, walk, seed)


@cache
def bust() -> Shape:
    """Return the shape of the bust, standing on y = 0."""
    return carve(bust_field, (0.02, 1.24), reach=0.62)


def bust_field(points: FloatArray) -> FloatArray:
    """Return the implicit function of the bust at (N, 3) points, positive inside.

    Blended blobs (Blinn, ACM TOG 1982), with curls in the hair and folds in the cloth.
    """
    middles, axes, weights = BLOBS[:, :3], BLOBS[:, 3:6], BLOBS[:, 6]
    # squared distances to all blob centers, in half axes, as matrix products
    squares = points**2 @ axes.T**-2.0 - 2.0 * points @ (middles / axes**2).T + ((middles / axes) ** 2).sum(axis=1)
    parts = weights * np.exp(2.6 * (1.0 - squares))  # a larger factor blends neighbors less
    hair = np.clip(parts[:, HAIR].sum(axis=1), 0.0, 1.0)
    x, y, z = points.T
    # rings about one shoulder, as cloth hangs from it
    folds = np.cos(46.0 * np.hypot(x - 0.42, y - 0.62) + 4.0 * z) * np.clip((0.52 - y) / 0.1, 0.0, 1.0)
    value = parts.sum(axis=1) - 1.0 + 0.2 * np.clip((y - 0.06) / 0.04, 0.0, 1.0) * folds
    curly = hair > 0.01
    value[curly] += 0.22 * hair[curly] * waves(9.0 * points[curly], 3)
    return np.asarray(value)


def _bust() -> list[Body]:
    foot = revolve(
        np.array([[0.0, 0.0], [0.36, 0.0], [0.36, 0.05], [0.26, 0.08], [0.2, 0.14], [0.2, 0.24], [0.0, 0.24]]),
        segments=72,
        sharp=True,
    )
    wreath = torus(0.205, 0.026).move((0.0, PLINTH_TOP_Y + 1.14, -0.04), tilt_deg=12.0)
    return [
        Body(foot.move((0.0, PLINTH_TOP_Y, 0.0)), GREEN_MARBLE),
        Body(bust().move((0.0, PLINTH_TOP_Y + 0.12, 0.0)), STONE),
        Body(wreath, BRONZE),
    ]


def _plinth() -> list[Body]:
    blocks = [(1.5, 0.14, 0.0), (1.2, 0.14, 0.14), (0.84, 0.6, 0.28), (1.0, 0.08, 0.86), (0.9, 0.08, 0.94)]
    bodies = [Body(box(width, high, width, spacing=0.08).move((0.0, y, 0.0)), SANDSTONE) for width, high, y in blocks]
    # each side has its own relief: with four equal sides, photos could be matched to the wrong side
    shield = revolve(np.array([[0.21, 0.0], [0.19, 0.03], [0.1, 0.07], [0.0, 0.09]]), segments=48)
    plaque = box(0.5, 0.3, 0.06, spacing=0.06)
    rosette = ball(0.17, bumps=0.08, seed=5)
    return [
        *bodies,
        Body(plaque.move((0.0, 0.42, 0.42)), GREEN_MARBLE),
        Body(shield.move((0.42, 0.57, 0.0), tilt_deg=90.0, turn_deg=90.0), replace(TERRACOTTA, scale=0.1)),
        Body(rosette.move((-0.40, 0.57, 0.0)), LIMESTONE),
        Body(torus(0.17, 0.05).move((0.0, 0.57, -0.44), tilt_deg=90.0), LIMESTONE),
    ]


def _terrace() -> list[Body]:
    drum = revolve(
        np.array([[0.0, 0.0], [0.17, 0.0], [0.17, 0.5], [0.0, 0.5]]), segments=72, sharp=True, flutes=(14, 0.1)
    )
    pot = revolve(
        np.array([[0.0, 0.0], [0.13, 0.0], [0.2, 0.3], [0.22, 0.3], [0.22, 0.35], [0.17, 0.35], [0.0, 0.33]]),
        sharp=True,
    )
    return [
        Body(ground((-1.7, 1.7), (-1.7, 1.7), unevenness=0.015), replace(PAVING, scale=0.35)),
        Body(drum.move((1.15, 0.17, 0.95), turn_deg=35.0, tilt_deg=90.0), LIMESTONE),
        Body(pot.move((-1.2, 0.0, 0.9)), TERRACOTTA),
        Body(ball(0.24, bumps=0.09, seed=2).move((-1.2, 0.5, 0.9)), BOX_LEAVES),
        Body(box(0.5, 0.22, 0.34, spacing=0.06).move((-1.0, 0.0, -1.1), turn_deg=25.0), SANDSTONE),
        Body(ball(0.2).move((1.2, 0.2, -1.05), turn_deg=40.0, tilt_deg=20.0), GREEN_MARBLE),
    ]
