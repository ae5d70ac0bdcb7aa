"""A terrace with thin things against a wall and the sky: a railing, a bare tree, a lamp, a wire."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.synthetic.cameras import ArcOptions, Camera, Views, arc
from sfm_app.synthetic.fine.fine_shapes import tube
from sfm_app.synthetic.scenes.bodies import Body, SyntheticScene
from sfm_app.synthetic.scenes.courtyard import BRICK, LIMESTONE, PAVING, SANDSTONE, TERRACOTTA
from sfm_app.synthetic.scenes.shapes import assemble, ball, box, ground, revolve
from sfm_app.synthetic.scenes.textures import Material

FloatArray = NDArray[np.float64]

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
