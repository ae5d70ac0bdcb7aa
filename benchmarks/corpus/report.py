"""The corpus page: requirements on all runs, every run, and the same without sets that constants were chosen on."""

from collections.abc import Sequence

from benchmarks.cameras.methods import STOCK
from benchmarks.cameras.worker import INCREMENTAL
from benchmarks.common.results import Row, table
from benchmarks.corpus.bars import SLACK, behind, demands
from benchmarks.corpus.score import PARAMETERS, counted
from benchmarks.corpus.tuning_sets import groups_table, seen_sets, unseen

RUNS = (
    "photos", "method", "placed", "models", "AUC@1", "AUC@5", "axis", "distance", "jumps", "axis of the worst part",
    "distance of the worst part", "warned of folds", "median center cm", "90 % center cm", "reprojection px", "K known",
    "cameras", "exit code", "total", "/ incremental", "bar met", "behind stock", "made by", "failed",
)  # fmt: skip
BEFORE = (
    "photos", "method", "K known", *(f"{name} % before" for name in PARAMETERS), "worst in sd before",
    *(f"{name} % after" for name in PARAMETERS), *(f"sd {name} after" for name in PARAMETERS), "worst in sd after",
)  # fmt: skip
SECONDS = (
    "photos", "method", "read", "features + matches", "view graph", "K", "map + BA", "total", "/ incremental",
    "peak MB",
)  # fmt: skip
MISSES = (
    "photos", "method", "camera", "its photos", "when", "parameter", "identifiable", "found", "true", "sd", "error %",
    "in sd", "in sd, truth's doubt granted",
)  # fmt: skip


def compared(rows: Sequence[Row]) -> None:
    """Fill in the columns that compare a run with stock incremental on the same set."""
    for row in rows:
        stock = next((r for r in rows if r["photos"] == row["photos"] and r["method"] == INCREMENTAL), None)
        both = stock is not None and stock["total"] and row["total"]
        row["/ incremental"] = round(row["total"] / stock["total"], 3) if stock and both else None
        beside = stock if row["method"] not in STOCK else None
        row["behind stock"] = behind(row, beside) if beside else None
        row["clearly behind stock"] = behind(row, beside, SLACK) if beside else None


def corpus_page(about: str, rows: Sequence[Row], stated: Sequence[Row]) -> str:
    """Return the page.

    Args:
        about: the description of the measurement.
        rows: all runs.
        stated: one row per parameter of our cameras, with `photos` and `method`.
    """
    fresh, fresh_stated = unseen(rows, seen_sets()), unseen(stated, seen_sets())
    parts = [f"# The whole corpus\n\n{about}\n", "## What is asked of all runs\n", _demands(rows, stated)]
    parts += ["## Every set\n", columns_with(rows, RUNS), "## The cameras' errors and stated deviations\n"]
    parts += [columns_with(_ours(rows), BEFORE), "## Seconds\n", columns_with(rows, SECONDS)]
    if far := [row for row in stated if (row["in sd"] or 0) > 3 or _wrong(row)]:
        parts += ["## Parameters beyond 3 stated deviations, and focals confidently wrong\n", columns_with(far, MISSES)]
    if told := [row for row in _ours(rows) if row.get("said of folds")]:
        parts += ["## What was said of folds\n", table(told, ("photos", "method", "said of folds"))]
    parts += ["## Where the constants were chosen\n", table(groups_table(_ours(rows)))]
    parts += [f"## Only sets that no constant was chosen on\n\nLeft out: {', '.join(seen_sets())}.\n"]
    parts += [_demands(fresh, fresh_stated), columns_with(fresh, RUNS)] if fresh else ["None of those above.\n"]
    return "\n".join(parts)


def columns_with(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """Format the table without columns that are empty throughout."""
    return table(rows, [name for name in columns if any(row.get(name) not in (None, "") for row in rows)])


def _demands(rows: Sequence[Row], stated: Sequence[Row]) -> str:
    found = [
        {"asked": demand.asked, "found": demand.found, "met": "yes" if demand.met else "no"}
        for demand in demands(_ours(rows), stated)
    ]
    shares = ", ".join(f"{name}: {count}" for name, count in counted(stated).items())
    return f"{table(found)}\nParameters: {shares}.\n"


def _ours(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["method"] not in STOCK]


def _wrong(row: Row) -> bool:
    return row["identifiable"] == "yes" and row["parameter"] in ("fx", "fy") and row["error %"] > 3
