"""Bars that the cameras must meet on each photo set, and whether they do."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from benchmarks.cameras.worker import INCREMENTAL
from benchmarks.common.results import Row


class Bar(NamedTuple):
    """A bound on one column."""

    column: str
    bound: float | str
    """A number, or the method whose value in that column is the bound."""
    at_most: bool


def lower_bound(column: str, bound: float | str) -> Bar:
    """Make a bar that is a lower bound."""
    return Bar(column, bound, at_most=False)


def upper_bound(column: str, bound: float | str) -> Bar:
    """Make a bar that is an upper bound."""
    return Bar(column, bound, at_most=True)


ALL_REGISTERED = upper_bound("unregistered", 0)
WITHIN_3_SD = upper_bound("worst in sd", 3.0)
"""The truth lies within three stated standard deviations."""
NOT_SLOWER = upper_bound("/ incremental", 1.0)
ACCURATE_K = (upper_bound("e_focal %", 0.3), upper_bound("e_OC %", 0.5))
BARS: Mapping[str, tuple[Bar, ...]] = {
    "fountain-P11": (
        lower_bound("AUC@1", 0.84),
        upper_bound("center rms %", 0.08),
        *ACCURATE_K,
        WITHIN_3_SD,
        NOT_SLOWER,
    ),
    "Herz-Jesus-P8": (
        lower_bound("AUC@1", 0.82),
        upper_bound("center rms %", 0.10),
        *ACCURATE_K,
        WITHIN_3_SD,
        NOT_SLOWER,
    ),
    "castle-P19": (lower_bound("AUC@1", 0.48), upper_bound("center rms %", 0.70), WITHIN_3_SD, NOT_SLOWER),
    "fountain-P11 crop:460,200": (lower_bound("AUC@1", 0.80), WITHIN_3_SD),
    "castle-P19 crop:460,200": (lower_bound("AUC@5", 0.52), WITHIN_3_SD),
    "fountain-P11 scale:0.75,1": (lower_bound("AUC@1", 0.82), WITHIN_3_SD),
    "castle-P19 scale:0.75,1": (lower_bound("AUC@5", 0.86), WITHIN_3_SD),
    "fountain-P11 window:512,256,512,512+scale:2,2": (lower_bound("AUC@1", 0.64), WITHIN_3_SD),
    "temple16": (ALL_REGISTERED, lower_bound("AUC@5", 0.70)),
    "merton1": (lower_bound("AUC@5", 0.85),),
    "reichstag10": (ALL_REGISTERED, lower_bound("AUC@5", 0.78)),
    "lund-door12": (ALL_REGISTERED, upper_bound("reprojection px", INCREMENTAL)),
    "kermit11": (ALL_REGISTERED, upper_bound("reprojection px", INCREMENTAL)),
}
"""By photo set, with its change. Where the truth is itself uncertain, the standard deviations have no bar."""


def verdict(row: Row, of_methods: Mapping[str, Row], bars: Sequence[Bar]) -> str:
    """Return "yes", or which bars are missed and by how much; empty where the set has no bars.

    Args:
        row: one method on one set.
        of_methods: all methods on that set, by name.
        bars: the bars of that set.
    """
    missed = [text for text in (_shortfall(row, of_methods, bar) for bar in bars) if text]
    return f"no: {'; '.join(missed)}" if missed else "yes" if bars else ""


def _shortfall(row: Row, of_methods: Mapping[str, Row], bar: Bar) -> str:
    bound = of_methods.get(bar.bound, {}).get(bar.column) if isinstance(bar.bound, str) else bar.bound
    value, sign = row.get(bar.column), "at most" if bar.at_most else "at least"
    if value is None or bound is None:
        return f"{bar.column} not measured" if value is None else f"{bar.column} has no {bar.bound} beside it"
    reached = value <= bound if bar.at_most else value >= bound
    return "" if reached else f"{bar.column} {value:.4g}, {sign} {bound:.4g}"
