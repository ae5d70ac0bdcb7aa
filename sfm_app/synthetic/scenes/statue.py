"""Build a colossal bust on a plinth, seen all round: a closed body, smooth in the face, fine in hair and folds."""

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from sfm_app.synthetic.cameras import ArcOptions, Camera, Views, arc
from sfm_app.synthetic.scenes.bodies import Body, SyntheticScene
from sfm_app.synthetic.scenes.courtyard import GREEN_MARBLE, LIMESTONE, PAVING, SANDSTONE, TERRACOTTA
from sfm_app.synthetic.scenes.shapes import Shape, ball, box, carve, ground, revolve, torus, waves
from sfm_app.synthetic.scenes.textures import Material

FloatArray = NDArray[np.float64]

STONE = Material(pattern="stone", base=(222, 214, 198), second=(168, 158, 140), joint=(92, 86, 76), scale=0.22)
BRONZE = Material(
    pattern="leaves", base=(74, 96, 66), second=(132, 118, 66), joint=(40, 44, 30), scale=0.035, contrast=0.4
)
SHARPNESS = 2.6
"""Falloff of the blobs; larger values blend neighbors less."""
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
    """Return hand-held photos all round.

    Args:
        camera: of all photos.
        seed: same seed, same poses.
        photos: how many, >= 2.
    """
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
    parts = weights * np.exp(SHARPNESS * (1.0 - squares))
    hair = np.clip(parts[:, HAIR].sum(axis=1), 0.0, 1.0)
    x, y, z = points.T
    # rings about one shoulder, as cloth hangs from it
    folds = np.cos(46.0 * np.hypot(x - 0.42, y - 0.62) + 4.0 * z) * np.clip((0.52 - y) / 0.1, 0.0, 1.0)
    found = parts.sum(axis=1) - 1.0 + 0.2 * np.clip((y - 0.06) / 0.04, 0.0, 1.0) * folds
    curly = hair > 0.01
    found[curly] += 0.22 * hair[curly] * waves(9.0 * points[curly], 3)
    return np.asarray(found)


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
        Body(ball(0.24, bumps=0.09, seed=2).move((-1.2, 0.5, 0.9)), LEAVES_OF_BOX),
        Body(box(0.5, 0.22, 0.34, spacing=0.06).move((-1.0, 0.0, -1.1), turn_deg=25.0), SANDSTONE),
        Body(ball(0.2).move((1.2, 0.2, -1.05), turn_deg=40.0, tilt_deg=20.0), GREEN_MARBLE),
    ]


LEAVES_OF_BOX = Material(pattern="leaves", base=(50, 88, 38), second=(112, 142, 66), joint=(20, 34, 16), scale=0.045)
