"""Plots side by side, and their points as rows for a CSV file."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.figures import label, pyplot
from benchmarks.common.results import Row

Values = Sequence[float] | NDArray[np.float64]


class Panel(NamedTuple):
    """Lines over one axis."""

    title: str
    x: Values
    lines: Mapping[str, Values]
    truth: Sequence[float] = ()
    """Positions of the true values on the x axis."""


def draw(panels: Sequence[Panel], x: str, y: str, *, log: bool = False, columns: int = 0) -> Any:
    """Draw a figure with the panels in rows of `columns`, or in one row.

    The first panel has a legend, and so has each whose lines have other names.
    """
    across = columns or len(panels)
    down = -(-len(panels) // across)
    figure, axes = pyplot().subplots(
        down, across, figsize=((4.6 if across < 3 else 3.6) * across, 3.3 * down), squeeze=False
    )
    for n, (axis, panel) in enumerate(zip(axes.ravel(), panels, strict=True)):
        for k, (name, values) in enumerate(panel.lines.items()):
            # a line that an earlier one may hide is thinner and dashed
            axis.plot(
                panel.x, values, "--" if k > 1 else "-", label=name, color=f"C{k}", linewidth=2.0 - 0.4 * min(k, 2)
            )
        for k, truth in enumerate(panel.truth):
            axis.axvline(truth, color="0.35", linestyle=":", label="" if k else "truth")
        label(axis, x, y if n % across == 0 else "", panel.title, log=log)
        if n == 0 or list(panel.lines) != list(panels[0].lines):
            axis.legend()
    return figure


def panel_rows(panels: Sequence[Panel]) -> list[Row]:
    """Return one row per point of every line, to six digits."""
    return [
        {"panel": panel.title, "line": name, "x": round_significant(x), "y": round_significant(y)}
        for panel in panels
        for name, values in panel.lines.items()
        for x, y in zip(panel.x, values, strict=True)
    ]


def minimum_x(panel: Panel, line: str) -> float:
    """Return the x of the lowest point of a line."""
    return float(panel.x[int(np.nanargmin(panel.lines[line]))])


def round_significant(value: float, digits: int = 6) -> float:
    """Round to a number of significant digits."""
    return float(f"{value:.{digits}g}")
