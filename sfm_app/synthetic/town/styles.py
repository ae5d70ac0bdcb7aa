"""Draw the proportions, materials and colors of houses and of what stands in the streets.

Lengths are in meters and colors in sRGB; all numbers were chosen by hand, from looking at rendered streets.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sfm_app.synthetic.scenes.textures import Color, Material, Pattern

Random = np.random.Generator

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
