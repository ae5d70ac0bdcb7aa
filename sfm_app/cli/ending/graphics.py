"""Pictures in a terminal: the kitty and iTerm2 protocols, sixel, and else half blocks in 24-bit colors.

What a terminal can do is told by environment variables alone: one that is asked may answer late, into the next command.
"""

import os
from base64 import b64encode
from collections.abc import Callable, Mapping
from enum import Enum
from io import BytesIO
from typing import TextIO

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

Pixels = NDArray[np.uint8]
ESCAPE = "\x1b"
CHUNK = 4096
"""Most characters of a message of the kitty protocol, as it says."""
CELL_PX = (10, 20)
"""Width and height of a character cell that a picture of pixels is drawn for: terminals scale the others themselves,
but not sixels."""
SIXEL_COLORS = 255
SOLID = 128
"""Least opacity of a pixel that is drawn where there is no transparency."""
KITTY_PROGRAMS, ITERM_PROGRAMS = ("ghostty", "WezTerm"), ("iTerm.app", "mintty")
"""Values of TERM_PROGRAM, as their manuals have them."""
SIXEL_TERMS = ("foot", "mlterm", "contour", "yaft")
"""First words of TERM of terminals that know sixels from the start."""
WINDOWS = "WT_SESSION"
"""Variable that Windows Terminal sets, which has no TERM."""
IN_BETWEEN = ("screen", "tmux")
"""First words of TERM inside a multiplexer, which passes no pictures on."""


class Graphics(Enum):
    """How a terminal shows pictures."""

    KITTY = "kitty"
    ITERM = "iterm"
    SIXEL = "sixel"
    BLOCKS = "blocks"


def graphics_of(stream: TextIO, environment: Mapping[str, str] | None = None) -> Graphics | None:
    """Return how the terminal that a stream ends in shows pictures; None where it ends in none, or it shows none.

    Args:
        stream: where the picture goes.
        environment: variables; those of this process if None.
    """
    known = os.environ if environment is None else environment
    term, program = known.get("TERM", ""), known.get("TERM_PROGRAM", "")
    if not stream.isatty() or term == "dumb" or not (term or WINDOWS in known):
        return None
    if "TMUX" not in known and not term.startswith(IN_BETWEEN):
        if "KITTY_WINDOW_ID" in known or term == "xterm-kitty" or program in KITTY_PROGRAMS:
            return Graphics.KITTY
        if program in ITERM_PROGRAMS or known.get("LC_TERMINAL") == "iTerm2":
            return Graphics.ITERM
        if "sixel" in term or term.split("-")[0] in SIXEL_TERMS:
            return Graphics.SIXEL
    colorful = known.get("COLORTERM") in ("truecolor", "24bit") or term.endswith("-direct") or WINDOWS in known
    return Graphics.BLOCKS if colorful and "NO_COLOR" not in known else None


def draw(picture: Pixels, kind: Graphics, rows: int, columns: int) -> str:
    """Return what a terminal shows as a picture, up to the end of its last line.

    Args:
        picture: (H, W, 4) RGBA, some of it opaque; what surrounds the rest is left out.
        kind: what the terminal knows.
        rows: most lines.
        columns: most columns.
    """
    cut = crop(picture)
    height, width = cut.shape[:2]
    # a cell is twice as high as wide
    scale = min(rows / height, columns / (2.0 * width))
    cells = max(1, round(scale * height)), max(1, round(2.0 * scale * width))
    return {Graphics.KITTY: _kitty, Graphics.ITERM: _iterm, Graphics.SIXEL: _sixel, Graphics.BLOCKS: _blocks}[kind](
        cut, cells
    )


def crop(picture: Pixels) -> Pixels:
    """Return the part of a picture (H, W, 4) in which something is opaque."""
    rows, columns = (np.flatnonzero((picture[..., 3] >= SOLID).any(axis=axis)) for axis in (1, 0))
    if not len(rows):
        return picture
    return picture[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def resize(picture: Pixels, width: int, height: int) -> Pixels:
    """Return a picture at another size; transparent pixels do not darken an outline.

    Args:
        picture: (H, W, 4) RGBA.
        width, height: in pixels.
    """
    alpha = picture[..., 3:].astype(np.float32)
    method = cv2.INTER_AREA if height < len(picture) else cv2.INTER_LINEAR
    opaque = cv2.resize(alpha, (width, height), interpolation=method)[..., None]
    colors = cv2.resize(picture[..., :3] * alpha, (width, height), interpolation=method) / np.maximum(opaque, 1e-3)
    return np.asarray(np.round(np.clip(np.concatenate([colors, opaque], axis=2), 0.0, 255.0)), np.uint8)


def _png(picture: Pixels) -> str:
    data = BytesIO()
    Image.fromarray(picture).save(data, "PNG")
    return b64encode(data.getvalue()).decode("ascii")


def _kitty(picture: Pixels, cells: tuple[int, int]) -> str:
    text = _png(picture)
    parts = [text[start : start + CHUNK] for start in range(0, len(text), CHUNK)]
    # q=2: the terminal does not answer
    heads = [f"a=T,f=100,q=2,c={cells[1]},r={cells[0]},", *[""] * (len(parts) - 1)]
    last = len(parts) - 1
    sent = (
        f"{ESCAPE}_G{head}m={int(number < last)};{part}{ESCAPE}\\"
        for number, (head, part) in enumerate(zip(heads, parts, strict=True))
    )
    return "".join(sent) + "\n"


def _iterm(picture: Pixels, cells: tuple[int, int]) -> str:
    return f"{ESCAPE}]1337;File=inline=1;width={cells[1]};height={cells[0]};preserveAspectRatio=1:{_png(picture)}\a\n"


def _sixel(picture: Pixels, cells: tuple[int, int]) -> str:
    """Return six rows of pixels after the other, in each of them color after color."""
    small = resize(picture, cells[1] * CELL_PX[0], cells[0] * CELL_PX[1])
    colors = Image.fromarray(small[..., :3]).quantize(SIXEL_COLORS, dither=Image.Dither.FLOYDSTEINBERG)
    index = np.where(small[..., 3] >= SOLID, np.asarray(colors, np.int64), -1)
    palette = np.array(colors.getpalette() or (), np.int64).reshape(-1, 3)
    shades = "".join(f"#{k};2;{r};{g};{b}" for k, (r, g, b) in enumerate(np.round(palette / 2.55).astype(int).tolist()))
    height, width = index.shape
    # the 1: pixels of no color stay as they are
    lines = [_sixel_line(index[top : top + 6]) for top in range(0, height, 6)]
    return f'{ESCAPE}P0;1;0q"1;1;{width};{height}{shades}{"-".join(lines)}{ESCAPE}\\\n'


def _sixel_line(index: NDArray[np.int64]) -> str:
    """Return at most six rows of pixels: for each color, which of the six has it, from left to right."""
    weights = (1 << np.arange(len(index)))[:, None]
    found = []
    for color in np.unique(index[index >= 0]).tolist():
        bits = ((index == color) * weights).sum(axis=0)
        found.append(f"#{color}" + _runs(bits.tolist(), lambda value: chr(63 + value)))
    return "$".join(found)


def _runs(values: list[int], character: Callable[[int], str]) -> str:
    """Return the characters of values, equal ones counted."""
    text, start = [], 0
    for end in range(1, len(values) + 1):
        if end == len(values) or values[end] != values[start]:
            count, one = end - start, character(values[start])
            text.append(f"!{count}{one}" if count > 3 else one * count)
            start = end
    return "".join(text)


def _blocks(picture: Pixels, cells: tuple[int, int]) -> str:
    """Return lines of half blocks: the upper pixel in the color of the letter, the lower one in that behind it."""
    small = resize(picture, cells[1], 2 * cells[0])
    lines = []
    for row in range(cells[0]):
        text, before = "  ", ""
        for upper, lower in zip(small[2 * row].tolist(), small[2 * row + 1].tolist(), strict=True):
            style, letter = _half_block(upper, lower)
            text += (f"{ESCAPE}[0{style}m" if style != before else "") + letter
            before = style
        lines.append(f"{text}{ESCAPE}[0m" if before else text.rstrip())
    return "\n".join(lines) + "\n"


def _half_block(upper: list[int], lower: list[int]) -> tuple[str, str]:
    """Return the colors of two pixels in one cell, and its letter; what is transparent has no color."""
    over, under = (";".join(map(str, pixel[:3])) if pixel[3] >= SOLID else "" for pixel in (upper, lower))
    if over and under:
        return f";38;2;{over};48;2;{under}", "▀"
    if over or under:
        return f";38;2;{over or under}", "▀" if over else "▄"
    return "", " "
