"""Compute procedural surface colors in compiled kernels, with detail at every scale for feature detectors.

A color depends only on the position on the body, so it is the same from every side. Detail finer than a pixel is faded
out, since it would alias.
"""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numba import uint32
from numpy.typing import NDArray

from sfm_app.jit import kernel

FloatArray = NDArray[np.float64]
Color = tuple[int, int, int]
Pattern = Literal["stone", "brick", "paving", "ceramic", "wood", "marble", "leaves", "stripes", "masonry"]
PATTERNS: tuple[str, ...] = get_args(Pattern)


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """Procedural color of a body. Colors are sRGB, 0..255."""

    pattern: Pattern
    base: Color
    second: Color
    """Color of veins, bands, grain and dirt."""
    joint: Color = (70, 66, 60)
    """Color between bricks and slabs, and of thin lines."""
    scale: float = 0.3
    """Size of a brick, slab, leaf or band, in scene units."""
    contrast: float = 0.5
    """Strength of the fine grain, 0..1."""

    def row(self, seed: int) -> FloatArray:
        """Return the (13,) parameters for the kernels: pattern, scale, contrast, seed, then three linear RGB colors."""
        colors = [(np.array(c) / 255.0) ** 2.2 for c in (self.base, self.second, self.joint)]
        return np.concatenate([[PATTERNS.index(self.pattern), self.scale, self.contrast, seed], *colors])


@kernel
def lattice(ix: int, iy: int, iz: int, seed: int) -> float:
    """Return a pseudo-random number in [0, 1) for a lattice point; wraps after 2^32.

    Args:
        ix: step along x.
        iy: step along y.
        iz: step along z.
        seed: another seed, other numbers.
    """
    h = uint32(ix) * uint32(0x8DA6B343) ^ uint32(iy) * uint32(0xD8163841)
    h = uint32(h ^ uint32(iz) * uint32(0xCB1AB31F) ^ uint32(seed) * uint32(0x165667B1))
    h = uint32((h ^ (h >> uint32(15))) * uint32(0x2C1B3C6D))
    h = uint32((h ^ (h >> uint32(12))) * uint32(0x297A2D39))
    h = uint32(h ^ (h >> uint32(15)))
    return float(h) * (1.0 / 4294967296.0)


@kernel
def value_noise(x: float, y: float, z: float, seed: int) -> float:
    """Return smooth noise in [-1, 1) on the unit lattice (Perlin's interpolation of lattice values).

    Args:
        x: in lattice steps.
        y: in lattice steps.
        z: in lattice steps.
        seed: another seed, another noise.
    """
    fx, fy, fz = math.floor(x), math.floor(y), math.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    u, v, w = x - fx, y - fy, z - fz
    u, v, w = u * u * (3.0 - 2.0 * u), v * v * (3.0 - 2.0 * v), w * w * (3.0 - 2.0 * w)
    total = 0.0
    for dz in range(2):
        low = lattice(ix, iy, iz + dz, seed) * (1.0 - u) + lattice(ix + 1, iy, iz + dz, seed) * u
        high = lattice(ix, iy + 1, iz + dz, seed) * (1.0 - u) + lattice(ix + 1, iy + 1, iz + dz, seed) * u
        total += (low * (1.0 - v) + high * v) * (w if dz else 1.0 - w)
    return 2.0 * total - 1.0


@kernel
def octaves(p: tuple[float, float, float], size: float, gain: float, footprint: float, seed: int) -> float:
    """Return noise summed over halving sizes, from `size` down to the size of a pixel; about -1..1.

    Args:
        p: position (x, y, z).
        size: of the broadest noise, > 0.
        gain: amplitude of each octave over the one before, in (0, 1).
        footprint: size of a pixel on the surface; octaves fade out between twice that size and that size.
        seed: another seed, another noise.
    """
    total = 0.0
    amplitude = 1.0
    turn = seed
    while size > footprint and turn < seed + 10:
        fade = min(1.0, size / footprint - 1.0)
        total += amplitude * fade * value_noise(p[0] / size, p[1] / size, p[2] / size, turn)
        amplitude *= gain
        size *= 0.5
        turn += 1
    return total * (1.0 - gain) * 2.0


@kernel
def cells(a: float, b: float, seed: int) -> tuple[float, float]:
    """Return border distance and number of the cell at a point, for random cells in the plane.

    The distance is in cells; the number, in [0, 1), identifies the cell.

    Args:
        a: across, in cells.
        b: up, in cells.
        seed: another seed, other cells.
    """
    ia, ib = math.floor(a), math.floor(b)
    first, second, name = 9.0, 9.0, 0.0
    for i in range(ia - 1, ia + 2):
        for j in range(ib - 1, ib + 2):
            da = i + 0.15 + 0.7 * lattice(i, j, 1, seed) - a
            db = j + 0.15 + 0.7 * lattice(i, j, 2, seed) - b
            d = math.sqrt(da * da + db * db)
            if d < first:
                first, second, name = d, first, lattice(i, j, 3, seed)
            elif d < second:
                second = d
    return 0.5 * (second - first), name


@kernel
def bricks(a: float, b: float, seed: int) -> tuple[float, float]:
    """Return border distance and number as `cells` does, for bricks twice as long as high in running bond.

    Args:
        a: along the row, in brick heights.
        b: up, in brick heights.
        seed: another seed, other names.
    """
    row = math.floor(b)
    a = 0.5 * a + 0.5 * (row % 2.0)
    column = math.floor(a)
    border = min(2.0 * (a - column), 2.0 * (column + 1.0 - a), b - row, row + 1.0 - b)
    return border, lattice(column, row, 4, seed)


@kernel
def _ramp(x: float, low: float, high: float) -> float:
    """Return 0 below `low`, 1 above `high`, linear in between."""
    return min(1.0, max(0.0, (x - low) / (high - low)))


@kernel
def tiles(
    kind: int, p: tuple[float, float, float], n: tuple[float, float, float], scale: float, seed: int
) -> tuple[float, float]:
    """Return border distance and number as `cells` does, for the tile pattern of a kind.

    Bricks on upright walls (1), slabs on the ground (2), leaves along the axis they face most (6), and bricks of bodies
    that may have been turned (8), whose walls run along x or z.

    Args:
        kind: 1, 2, 6 or 8, as above.
        p: position on the body before it was moved.
        n: unit normal there.
        scale: size of a tile, > 0.
        seed: another seed, other tiles.
    """
    if kind == 6:
        if abs(n[1]) >= max(abs(n[0]), abs(n[2])):
            return cells(p[0] / scale, p[2] / scale, seed)
        return cells(p[1] / scale, (p[2] if abs(n[0]) >= abs(n[2]) else p[0]) / scale, seed)
    wobble = 0.06 * value_noise(3.0 * p[0] / scale, 3.0 * p[1] / scale, 3.0 * p[2] / scale, seed)
    if kind == 2:
        return cells(p[0] / scale + wobble, p[2] / scale + wobble, seed)
    along = p[0] if abs(n[2]) >= abs(n[0]) else p[2]
    if kind == 8:  # the normal turns with the body, and its texture does not
        along = p[0] + p[2]
    return bricks(along / scale + wobble, p[1] / scale + wobble, seed)


@kernel
def ceramic(p: tuple[float, float, float], scale: float) -> tuple[float, float]:
    """Return the shares of the second color (glaze) and of the thin lines on Greek pottery.

    Bands follow the height, figures the angle about the y axis.

    Args:
        p: position on the body before it was moved.
        scale: height of a band, > 0.
    """
    band = p[1] / scale
    row = math.floor(band)
    inside = band - row
    turn = (math.atan2(p[2], p[0]) / (2.0 * math.pi) + 0.5) * 24.0
    line = 1.0 - _ramp(min(inside, 1.0 - inside), 0.03, 0.06)
    part = turn - math.floor(turn)
    kind = row % 4
    if kind == 0:
        return 1.0, line
    if kind == 1:  # zigzag
        return _ramp(abs(2.0 * part - 1.0) - inside, -0.05, 0.05), line
    if kind == 2:  # rays and dots of uneven size
        reach = 0.22 + 0.2 * lattice(math.floor(turn), row, 5, 17)
        return 1.0 - _ramp(math.hypot(part - 0.5, inside - 0.5) - reach, -0.04, 0.04), line
    steps = math.floor(4.0 * part)  # meander
    wall = (steps == 0.0) or (steps == 2.0 and inside > 0.3) or (inside > 0.75 and steps < 3.0)
    return 1.0 if wall else 0.0, line


@kernel
def mixture(
    row: NDArray[np.float64], p: tuple[float, float, float], n: tuple[float, float, float], footprint: float
) -> tuple[float, float, float]:
    """Return share of the second color, share of the joint color, and brightness (about 1) at a point of a body.

    Args:
        row: from `Material.row()`.
        p: position on the body before it was moved.
        n: unit normal there.
        footprint: size of a pixel on the surface.
    """
    kind, scale, contrast, seed = int(row[0]), row[1], row[2], int(row[3])
    fine = octaves(p, 0.4 * scale, 0.72, footprint, seed + 20)
    broad = octaves(p, 3.0 * scale, 0.5, max(footprint, 0.7 * scale), seed + 40)
    bright = 1.0 + contrast * (1.7 * fine + 0.4 * broad)
    if kind == 0:  # stone: stains and dark pores
        second = _ramp(broad + 0.6 * fine, -0.3, 0.9)
        joint = 0.8 * _ramp(octaves(p, 0.09 * scale, 0.75, footprint, seed + 60), 0.3, 0.55)
    elif kind <= 2 or kind == 8:
        border, name = tiles(kind, p, n, scale, seed)
        blur = footprint / scale
        joint = 1.0 - _ramp(border, 0.04 - 0.5 * blur, 0.06 + 0.5 * blur)
        second = name + 0.4 * fine
        bright *= 0.8 + 0.4 * ((7.0 * name) % 1.0)
    elif kind == 3:
        second, joint = ceramic(p, scale)
        second *= 1.0 - 0.25 * _ramp(fine, 0.1, 0.5)
    elif kind == 4:  # wood: rings about the z axis, bent by noise; planks by height
        r = math.hypot(p[0] + 0.3 * scale * broad, p[1] - 2.0 * scale) / scale
        rings = 6.0 * r + 1.5 * octaves((p[0], p[1], 0.2 * p[2]), 0.5 * scale, 0.6, footprint, seed)
        second = 0.5 + 0.5 * math.sin(2.0 * math.pi * rings) + 0.3 * fine
        plank = 2.0 * p[1] / scale
        joint = 1.0 - _ramp(min(plank - math.floor(plank), math.floor(plank) + 1.0 - plank), 0.02, 0.05)
        bright *= 0.8 + 0.4 * lattice(math.floor(plank), 3, 0, seed)
    elif kind == 5:  # marble: thin veins where bent planes cross the body
        wave = (p[0] + 0.7 * p[1] + 0.4 * p[2]) / scale + 2.2 * octaves(p, scale, 0.6, footprint, seed)
        second = (1.0 - abs(math.sin(math.pi * wave))) ** 3
        joint = 0.5 * _ramp(octaves(p, 0.5 * scale, 0.6, footprint, seed + 80), 0.3, 0.7)
    elif kind == 6:
        border, name = tiles(kind, p, n, scale, seed)
        second, joint = name, 1.0 - _ramp(border, 0.0, 0.14)
        bright *= 0.7 + 0.6 * ((5.0 * name) % 1.0)
    else:  # stripes around the y axis, worn off in places
        turn = (math.atan2(p[2], p[0]) / (2.0 * math.pi) + 0.5) * 8.0
        second = float(math.floor(turn) % 2)
        joint = 0.8 * _ramp(broad + fine, 0.25, 0.5)
    return min(1.0, max(0.0, second)), joint, max(0.15, bright)
