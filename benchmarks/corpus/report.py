"""The corpus page: requirements on all runs, every run, and the same without sets that constants were chosen on."""

from collections.abc import Mapping, Sequence

from benchmarks.cameras.methods import STOCK
from benchmarks.cameras.worker import INCREMENTAL, OURS
from benchmarks.common.results import Row, table
from benchmarks.corpus.bars import SLACK, deficits, demands
from benchmarks.corpus.score import PARAMETERS, parameter_counts
from benchmarks.corpus.tuning_sets import groups_table, seen_sets, unseen_rows

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


def add_comparisons(rows: Sequence[Row]) -> None:
    """Fill in the columns that compare a run with stock incremental on the same set."""
    for row in rows:
        stock = next((r for r in rows if r["photos"] == row["photos"] and r["method"] == INCREMENTAL), None)
        both = stock is not None and stock["total"] and row["total"]
        row["/ incremental"] = round(row["total"] / stock["total"], 3) if stock and both else None
        beside = stock if row["method"] not in STOCK else None
        row["behind stock"] = deficits(row, beside) if beside else None
        row["clearly behind stock"] = deficits(row, beside, SLACK) if beside else None


def corpus_page(about: str, rows: Sequence[Row], stated: Sequence[Row]) -> str:
    """Return the page.

    Args:
        about: the description of the measurement.
        rows: all runs.
        stated: one row per parameter of our cameras, with `photos` and `method`.
    """
    fresh, fresh_stated = unseen_rows(rows, seen_sets()), unseen_rows(stated, seen_sets())
    parts = [f"# The whole corpus\n\n{about}\n", "## What is asked of all runs\n", _demands_table(rows, stated)]
    parts += ["## Every set\n", nonempty_table(rows, RUNS), "## The cameras' errors and stated deviations\n"]
    parts += [nonempty_table(_our_rows(rows), BEFORE), "## Seconds\n", nonempty_table(rows, SECONDS)]
    if far := [row for row in stated if (row["in sd"] or 0) > 3 or _is_confidently_wrong(row)]:
        parts += [
            "## Parameters beyond 3 stated deviations, and focals confidently wrong\n",
            nonempty_table(far, MISSES),
        ]
    if told := [row for row in _our_rows(rows) if row.get("said of folds")]:
        parts += ["## What was said of folds\n", table(told, ("photos", "method", "said of folds"))]
    if gains := hypothesis_rows(_our_rows(rows)):
        parts += ["## What each hypothesis gains\n", GAINS_TEXT, table(gains)]
    parts += ["## Where the constants were chosen\n", table(groups_table(_our_rows(rows)))]
    parts += [f"## Only sets that no constant was chosen on\n\nLeft out: {', '.join(seen_sets())}.\n"]
    parts += [_demands_table(fresh, fresh_stated), nonempty_table(fresh, RUNS)] if fresh else ["None of those above.\n"]
    return "\n".join(parts)


GAINS_TEXT = (
    "Sets where it was tried, and was accepted; seconds that it took; and what its absence costs on those sets: photos "
    "placed, AUC@1 and AUC@5 with it less those without it, summed over the sets that were run without it.\n"
)


def hypothesis_rows(rows: Sequence[Row]) -> list[Row]:
    """Return for each hypothesis where it was tried, what it cost, and what its absence costs."""
    tried: dict[str, list[tuple[Row, Row]]] = {}
    for row in rows:
        if row["method"] == OURS:
            for trial in row.get("trials") or []:
                tried.setdefault(trial["name"], []).append((row, trial))
    return [
        {
            "hypothesis": name,
            "sets": len({row["photos"] for row, _ in pairs}),
            "accepted": len({row["photos"] for row, trial in pairs if trial["accepted"]}),
            "seconds": round(sum(trial["seconds"] for _, trial in pairs), 1),
        }
        | _absence(name, {row["photos"]: row for row, _ in pairs}, rows)
        for name, pairs in sorted(tried.items())
    ]


def _absence(name: str, whole: Mapping[str, Row], rows: Sequence[Row]) -> Row:
    """Return what the absence of a hypothesis costs on the sets that were run without it."""
    both = [
        (whole[row["photos"]], row)
        for row in rows
        if row["method"] == f"{OURS}, without {name}" and row["photos"] in whole
    ]
    columns = {"photos": "registered", "AUC@1": "AUC@1", "AUC@5": "AUC@5", "s of scene": "map + BA"}
    return {"run without it": len(both)} | {
        title: round(sum((row.get(key) or 0) - (less.get(key) or 0) for row, less in both), 4)
        for title, key in columns.items()
    }


def nonempty_table(rows: Sequence[Row], columns: Sequence[str]) -> str:
    """Format the table without columns that are empty throughout."""
    return table(rows, [name for name in columns if any(row.get(name) not in (None, "") for row in rows)])


def _demands_table(rows: Sequence[Row], stated: Sequence[Row]) -> str:
    found = [
        {"asked": demand.asked, "found": demand.found, "met": "yes" if demand.met else "no"}
        for demand in demands(_our_rows(rows), stated)
    ]
    shares = ", ".join(f"{name}: {count}" for name, count in parameter_counts(stated).items())
    return f"{table(found)}\nParameters: {shares}.\n"


def _our_rows(rows: Sequence[Row]) -> list[Row]:
    return [row for row in rows if row["method"] not in STOCK]


def _is_confidently_wrong(row: Row) -> bool:
    return row["identifiable"] == "yes" and row["parameter"] in ("fx", "fy") and row["error %"] > 3
