"""Draw a page of markers to print."""

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.atomic_io import replace_atomically
from sfm_app.errors import ConfigError, InputError
from sfm_app.lengths import format_length
from sfm_app.scale.markers import FAMILIES, draw_pattern, marker_count

PAGES_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
"""Width and height of a sheet of paper, by its name."""
MARGIN_MM, LABEL_MM, RULER_MM = 10.0, 6.0, 100.0
MOST_PER_PAGE = 12
FloatArray = NDArray[np.float64]

SUFFIXES = (".pdf", ".svg")
MM_PER_INCH = 25.4


def write_marker_page(
    path: Path, side_m: float, family: str = "apriltag-36h11", first: int = 0, paper: str = "a4"
) -> int:
    """Write a page of markers to print, true to scale, with a ruler to check the printer by.

    Args:
        path: PDF or SVG file.
        side_m: side of the dark square of each marker, in meters.
        family: one of `FAMILIES`.
        first: number of the first marker.
        paper: a4, a3 or letter.

    Returns:
        how many markers are on it.

    Raises:
        ConfigError: no marker of that size fits on the page, or a name is unknown.
        InputError: the file cannot be written.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"a page of markers is a PDF or SVG file, not {path.name}", hint="write -o markers.pdf")
    if family not in FAMILIES or paper not in PAGES_MM:
        raise ConfigError(
            f"no family of markers is named '{family}'" if family not in FAMILIES else f"no paper is named '{paper}'",
            hint=f"known: {', '.join(FAMILIES if family not in FAMILIES else PAGES_MM)}",
        )
    places = marker_places(side_m, len(draw_pattern(family, 0)), paper)
    places = places[: max(min(MOST_PER_PAGE, marker_count(family) - first), 0)]
    if not places:
        size = format_length(side_m)
        raise ConfigError(
            f"no marker of {size} fits on {paper}, or none has number {first}", hint="choose smaller ones"
        )
    data = _draw(places, side_m * 1000.0, family, first, paper, path.suffix.lower().removeprefix("."))
    try:
        with replace_atomically(path) as target:
            target.write_bytes(data)
    except OSError as err:
        raise InputError(f"cannot write {path}: {err.strerror}", hint="name another file with -o") from err
    return len(places)


def marker_places(side_m: float, cells: int, paper: str) -> list[tuple[float, float]]:
    """Return the lower left corners in millimeters of as many markers as fit on a page, with a light cell around each.

    Args:
        side_m: side of a marker, in meters.
        cells: along a side of its pattern.
        paper: name in `PAGES_MM`.
    """
    width, height = PAGES_MM[paper]
    side = side_m * 1000.0
    step = side * (1.0 + 2.0 / cells)
    across = int((width - 2 * MARGIN_MM) / step)
    down = int((height - 3 * MARGIN_MM - LABEL_MM) / (step + LABEL_MM))
    left = (width - across * step) / 2 + side / cells
    tops = [height - MARGIN_MM - row * (step + LABEL_MM) - step + side / cells for row in range(down)]
    return [(left + column * step, top) for top in tops for column in range(across)]


def _draw(places: list[tuple[float, float]], side: float, family: str, first: int, paper: str, suffix: str) -> bytes:
    from matplotlib import rc_context
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    width, height = PAGES_MM[paper]
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH))
    (FigureCanvasPdf if suffix == "pdf" else FigureCanvasSVG)(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    axes.set_axis_off()
    for number, (x, y) in enumerate(places, start=first):
        pattern = draw_pattern(family, number)
        axes.fill(*_dark_bars(pattern, x, y, side), color="black", linewidth=0)
        label = f"{family} {number}, side {format_length(side / 1000.0)}"
        axes.text(x, y - side / len(pattern) - 1.0, label, fontsize=7, va="top")
    axes.plot([MARGIN_MM, MARGIN_MM + RULER_MM], [MARGIN_MM] * 2, color="black", linewidth=0.5)
    for tick in range(0, int(RULER_MM) + 1, 10):
        axes.plot([MARGIN_MM + tick] * 2, [MARGIN_MM, MARGIN_MM + 2.0], color="black", linewidth=0.5)
    note = (
        f"Print at 100 %. This ruler has {RULER_MM:.0f} mm: measure it, and the dark squares. Glue them to stiff card."
    )
    axes.text(MARGIN_MM, MARGIN_MM + 3.0, note, fontsize=7)
    file = io.BytesIO()
    undated = {"CreationDate": None} if suffix == "pdf" else {"Date": None}
    with rc_context({"svg.hashsalt": family}):  # else names in it are random
        figure.savefig(file, format=suffix, metadata=undated)
    return file.getvalue()


def _dark_bars(pattern: NDArray[np.uint8], x: float, y: float, side: float) -> list[FloatArray]:
    """Return x and y of the dark bars of a marker, in turn, as `Axes.fill` takes them.

    Bars along rows and along columns cover the seams of each other, which viewers would show as light lines.
    """
    cells = len(pattern)
    bars = [(row, row + 1, *bar) for row in range(cells) for bar in _runs(pattern[row] < 128)]
    bars += [(*bar, column, column + 1) for column in range(cells) for bar in _runs(pattern[:, column] < 128)]
    drawn: list[FloatArray] = []
    for top, bottom, left, right in bars:
        drawn.append(x + side / cells * np.array([left, right, right, left], np.float64))
        drawn.append(y + side / cells * (cells - np.array([top, top, bottom, bottom], np.float64)))
    return drawn


def _runs(dark: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return begin and end of each run of dark cells."""
    steps = np.diff(np.concatenate([[0], dark.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(steps > 0).tolist(), np.flatnonzero(steps < 0).tolist(), strict=True))
