"""A carved wall: tendrils, cords, pyramids, beads and letters of some millimeters, between moldings with edges."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sfm_app.synthetic.cameras import ArcOptions, Camera, Views, arc
from sfm_app.synthetic.fine.fine_shapes import relief, ridge
from sfm_app.synthetic.scenes.bodies import Body, SyntheticScene
from sfm_app.synthetic.scenes.courtyard import LIMESTONE, PAVING, SANDSTONE
from sfm_app.synthetic.scenes.shapes import assemble, box, ground

FloatArray = NDArray[np.float64]

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
