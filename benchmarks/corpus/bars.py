"""Bars for every set of the corpus, and for the corpus as a whole."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from benchmarks.cameras.bars import BARS, Bar, lower_bound, upper_bound
from benchmarks.cameras.worker import INCREMENTAL
from benchmarks.common.results import Row
from benchmarks.corpus.score import parameter_counts

ONE_MODEL = upper_bound("models", 1)
NOT_FOLDED = upper_bound("folded without a word", 0)
CORPUS_BARS: Mapping[str, tuple[Bar, ...]] = {
    "fox50": (
        lower_bound("registered", 50), upper_bound("claimed focal %", 1.5), upper_bound("claimed center %", 2.0),
        lower_bound("AUC@1", 0.47),
        lower_bound("AUC@5", 0.90),
    ),
    "oats23": (NOT_FOLDED,),
    "books21": (NOT_FOLDED,),
    "dinoSparseRing": (lower_bound("registered", 14),),
    "kitchen25": (lower_bound("registered", 24), lower_bound("registered", INCREMENTAL)),
    "kitti51": (lower_bound("AUC@5", INCREMENTAL), upper_bound("focal of 3 % or 3 sd", 1.0)),
    "kitchen1000 every:5": (lower_bound("registered", 200), upper_bound("median center cm", 2.4), ONE_MODEL),
    "castle-P19": (ONE_MODEL,),
    "temple16": (ONE_MODEL,),
    "fountain-P11": (ONE_MODEL,),
}  # fmt: skip
"""In addition to the bars of the cameras' table."""
PADDED_BARS = (lower_bound("AUC@5", 0.60), lower_bound("cameras", 2))
"""For reichstag10 with all photos brought to one size: they must not be taken for one camera."""
UNFOLDED_AT: Mapping[str, tuple[str, float]] = {
    "oats23": ("axis of the worst part", 0.95),
    "books21": ("distance of the worst part", 0.8),
}
"""The score below which a walk, or its worst part, counts as folded."""
PADDED = "pad:"
SLACK = 0.01
"""AUC varies by this much from seed to seed (CONTRIBUTING.md)."""


def required_bars(title: str) -> tuple[Bar, ...]:
    """Return all bars of a set with its change."""
    own = PADDED_BARS if title.startswith("reichstag10 ") and PADDED in title else ()
    return (*BARS.get(title, ()), *CORPUS_BARS.get(title, ()), *own)


def unreported_fold(name: str, row: Row) -> int | None:
    """Return 1 where a walk is folded and no warning is given, else 0; None where it is unknown."""
    column, bound = UNFOLDED_AT.get(name, ("", 0.0))
    value = row.get(column)
    return None if value is None else int(value < bound and row.get("warned of folds") != "yes")


def deficits(row: Row, stock: Row, slack: float = 0.0) -> str:
    """List the figures in which a run is worse than stock on the same pixels by more than the slack; empty if none."""
    figures = [(name, row.get(name) or 0, stock.get(name) or 0) for name in ("registered", "AUC@1", "AUC@5")]
    return "; ".join(f"{name} {ours:g}, stock {theirs:g}" for name, ours, theirs in figures if ours < theirs - slack)


class Demand(NamedTuple):
    """A requirement on all runs together."""

    asked: str
    found: str
    met: bool


def demands(rows: Sequence[Row], stated: Sequence[Row]) -> list[Demand]:
    """Check what is required of the whole corpus: of our runs, and of the parameters that they state.

    Args:
        rows: our runs.
        stated: the parameters of all our runs.
    """
    seen = parameter_counts(stated)
    codes = [row["exit code"] for row in rows]
    judged = [row for row in rows if row.get("bar met")]
    met = sum(row["bar met"] == "yes" for row in judged)
    compared = [row for row in rows if row.get("behind stock") is not None]
    worse = [row["photos"] for row in compared if row["clearly behind stock"]]
    hair = sum(bool(row["behind stock"]) for row in compared) - len(worse)
    allowed = seen["stated"] / 20
    off, granted = seen["beyond 3 sd"], seen["beyond 3 sd, truth's doubt granted"]
    return [
        Demand(
            "every run ends by itself, with exit code 0 or 4",
            _format_codes(codes),
            all(code in (0, 4) for code in codes),
        ),
        Demand(
            "at most one parameter of twenty beyond 3 stated deviations",
            f"{off} of {seen['stated']}; {granted} if the truth's own doubt is granted",
            off <= allowed,
        ),
        Demand(
            "no focal called identifiable and over 3 % off",
            f"{seen['of them over 3 % off']} of {seen['focals called identifiable']}",
            seen["of them over 3 % off"] == 0,
        ),
        Demand(
            f"never fewer photos, or an AUC lower by more than {SLACK:g}, than stock incremental",
            f"behind on {len(worse)} of {len(compared)}"
            + (f": {', '.join(worse)}" if worse else "")
            + (f"; by less on {hair}" if hair else ""),
            not worse,
        ),
        Demand("all bars of the sets", f"{met} of {len(judged)} sets", met == len(judged)),
    ]


def _format_codes(codes: Sequence[int | None]) -> str:
    found = {code: codes.count(code) for code in codes}
    return ", ".join(f"{count} x {'none' if code is None else code}" for code, count in found.items()) or "no runs"
