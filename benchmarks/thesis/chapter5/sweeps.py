"""Errors of all calibrators over a level (Figures 5.6, 5.10, 5.17 to 5.22)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.common.figures import add_legend, draw_curves, label, pyplot
from benchmarks.common.results import Row
from benchmarks.thesis.chapter5 import setups
from benchmarks.thesis.chapter5.contests import (
    GEOMETRIC,
    KRUPPA,
    MULTI_START,
    NON_ROBUST,
    PERTURBATION,
    PRODUCTION,
    ZERO_CURVES,
)
from benchmarks.thesis.chapter5.lab import FigureResult, Lab
from benchmarks.thesis.chapter5.sweep_claims import judge_claims, value

STANDARD = (NON_ROBUST, GEOMETRIC)
ROBUST = (ZERO_CURVES, MULTI_START, PERTURBATION)
TITLES = {"e_focal": "mean e_focal, %", "e_OC": "mean e_OC, %", "ms": "median time, ms"}


@dataclass(frozen=True, slots=True)
class Plot:
    """One experiment drawn by one column."""

    part: str
    """Number of the figure and letter."""
    experiment: str
    """Name of a function of `setups`."""
    axis: str
    methods: Sequence[str]
    column: str = "e_focal"
    sequence: str = ""

    @property
    def title(self) -> str:
        """Title of the plot."""
        return self.part if self.sequence in self.part else f"{self.part} {self.sequence}"


SHARES, DEVIATION = "outliers in two of ten F's, %", "focal of one frame longer by, %"
OUTLYING = "outlying F's of ten"
ALL = (PRODUCTION, *ROBUST, *STANDARD, KRUPPA)
FIGURES = {
    **{
        number: (
            Plot(f"{number}a", "matching_outliers", SHARES, (own, *STANDARD)),
            Plot(f"{number}b", "focal_deviation", DEVIATION, (own, *STANDARD)),
        )
        for number, own in (("5.6", MULTI_START), ("5.10", PERTURBATION), ("5.17", ZERO_CURVES))
    },
    "5.18": (
        Plot("5.18a", "matching_outliers", SHARES, ALL),
        Plot("5.18b", "focal_deviation", DEVIATION, ALL),
        Plot("5.18c", "matching_outliers", SHARES, ALL, "e_OC"),
        Plot("5.18d", "focal_deviation", DEVIATION, ALL, "e_OC"),
    ),
    "5.19": (
        Plot("5.19a", "outlying_matrices", OUTLYING, ALL),
        Plot("5.19b", "outlying_corners", OUTLYING, ALL, sequence="Wadham"),
    ),
    "5.20": tuple(
        Plot(f"5.20 {name}", "raw_pairs", "F's fitted to all raw matches", ALL, sequence=name)
        for name in ("Castle-P19", "Fountain-P11")
    ),
    "5.21": (
        Plot("5.21a", "gaussian_noise", "noise, px", ALL),
        Plot("5.21b", "gaussian_noise", "noise, px", ALL, "e_OC"),
    ),
    "5.22": (
        Plot("5.22a", "noisy_frame", "frames, one of them outlying", ALL),
        Plot("5.22b", "clean_frames", "frames", ALL, "ms"),
    ),
}
TIMED_TESTS = 5
"""Seeds of Figure 5.22b."""


def draw_sweep(lab: Lab, number: str) -> FigureResult:
    """Draw a figure and judge its claims."""
    plots = FIGURES[number]
    found = {plot.part: _rows(lab, plot) for plot in plots}
    wide = len(plots) > 2
    figure, axes = pyplot().subplots(2 if wide else 1, 2, figsize=(10, 7 if wide else 3.8))
    for axis, plot in zip(np.ravel(axes), plots, strict=True):
        rows = found[plot.part]
        levels = sorted({row["x"] for row in rows})
        lines = {name: [value(rows, name, level, plot.column) for level in levels] for name in _methods(rows)}
        draw_curves(axis, levels, lines, [PRODUCTION] if PRODUCTION in lines else [plot.methods[0]], ALL)
        label(axis, plot.axis, TITLES[plot.column], plot.title, log=True)
    add_legend(figure, np.ravel(axes)[0])
    rows = [{"part": part, **row} for part, several in found.items() for row in several]
    lab.keep(number, figure, rows)
    return FigureResult(judge_claims(found), rows)


def _rows(lab: Lab, plot: Plot) -> list[Row]:
    tests = TIMED_TESTS if plot.column == "ms" else None
    rows = lab.run_contest(getattr(setups, plot.experiment), plot.sequence, tests)
    return [row for name in plot.methods for row in rows if row["method"] == name]


def _methods(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["method"] for row in rows))
