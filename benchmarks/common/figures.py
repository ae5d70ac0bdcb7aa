"""Curves for the result pages."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

STYLE: Any = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "figure.constrained_layout.use": True,
    "figure.dpi": 110,
    "font.size": 9,
    "grid.alpha": 0.3,
    "legend.fontsize": 8,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "lines.markersize": 5,
}
MARKERS = "osD^vP*Xhd<>"


def pyplot() -> Any:
    """Return matplotlib's pyplot without a display, in our style; it is imported only where a figure is drawn."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update(STYLE)
    from matplotlib import pyplot as plt

    return plt


def draw_curves(
    axes: Any,
    x: Sequence[float],
    lines: Mapping[str, Sequence[float]],
    heavy: Sequence[str] = (),
    order: Sequence[str] = (),
) -> None:
    """Draw one line per name, bolder for those in `heavy`; markers shrink from line to line, so none hides another.

    Names in `order` keep their color and marker from figure to figure, whichever of them are drawn.
    """
    places = {name: n for n, name in enumerate(dict.fromkeys([*order, *lines]))}
    for name, y in lines.items():
        n = places[name]
        style, width = MARKERS[n % len(MARKERS)] + "-", 2.4 if name in heavy else 1.2
        axes.plot(x, y, style, label=name, color=f"C{n % 10}", linewidth=width, markersize=max(7.0 - 0.7 * n, 3.0))


def label(axes: Any, x: str, y: str, title: str = "", *, log: bool = False) -> None:
    """Label the axes; on a logarithmic axis numbers near 1 are written out, not as powers."""
    axes.set(xlabel=x, ylabel=y, title=title)
    if log:
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        if low > 1e-4 and high < 1e5:
            labeled = "25" if high / low < 100 else ""
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
            axes.yaxis.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in labeled else "")


def add_legend(figure: Any, axes: Any) -> None:
    """Add one legend to the right of all plots of a figure."""
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center")


def save(figure: Any, folder: Path, name: str) -> None:
    """Write NAME.png."""
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / f"{name}.png", metadata={"Software": None})
    pyplot().close(figure)
