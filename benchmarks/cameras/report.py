"""The result page of camera poses: medians over the repetitions, tables, and one figure."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks.cameras.bars import BARS, verdict
from benchmarks.cameras.methods import is_stock
from benchmarks.cameras.score import FILES
from benchmarks.cameras.worker import INCREMENTAL
from benchmarks.common.figures import pyplot, save
from benchmarks.common.results import Row, table

ACCURACY = (
    "photos", "method", "placed", "models", "e_focal %", "e_OC %", "e_OC_w %", "center rms %", "AUC@1", "AUC@3",
    "AUC@5", "AUC@10", "AUC@5 of each model", "points", "observations", "reprojection px", "bar met", "failed",
)  # fmt: skip
TIME = (
    "photos", "method", "read", "features + matches", "view graph", "K", "map + BA", "total", "/ incremental",
    "fastest", "slowest", "CPU seconds", "peak MB",
)  # fmt: skip
SPREAD = ("f", "fx", "fy", "cx", "cy")
DEVIATIONS = (
    "photos", "method", "K known", "e_focal % before", "e_focal %", "e_OC_w % before", "e_OC_w %",
    *(f"sd {name} px" for name in SPREAD), *(f"{name} in sd" for name in SPREAD), "in 3 sd",
)  # fmt: skip


def medians(runs: Sequence[Row]) -> list[Row]:
    """Return one row per set and method: medians of figures, differing texts side by side, and the bars."""
    add_ratios(runs)
    together: dict[tuple[str, str], list[Row]] = {}
    for run in runs:
        together.setdefault((run["photos"], run["method"]), []).append(run)
    rows = [_median_row(repeated) for repeated in together.values()]
    for row in rows:
        of_methods = {other["method"]: other for other in rows if other["photos"] == row["photos"]}
        bars = () if is_stock(row["method"]) else BARS.get(row["photos"], ())
        row["bar met"] = verdict(row, of_methods, bars)
    return rows


def add_ratios(runs: Sequence[Row]) -> None:
    """Add the total time divided by that of stock incremental in the same repetition."""
    base = {(run["photos"], run["repetition"]): run["total"] for run in runs if run["method"] == INCREMENTAL}
    for run in runs:
        of = base.get((run["photos"], run["repetition"]))
        run["/ incremental"] = round(run["total"] / of, 3) if of and run["total"] else None


def _median_row(repeated: Sequence[Row]) -> Row:
    row: Row = {}
    for name in dict.fromkeys(key for run in repeated for key in run if key not in ("repetition", *FILES)):
        values = [run[name] for run in repeated if run.get(name) not in (None, "")]
        if not values:
            row[name] = None
        elif isinstance(values[0], str):
            row[name] = " / ".join(dict.fromkeys(values))
        else:
            row[name] = median(values)
    totals = [run["total"] for run in repeated if run["total"] is not None]
    worst = row.get("worst in sd")
    return row | {
        "repetitions": len(repeated),
        "placed": f"{row['registered']:g}/{row['of']:g}",
        "fastest": min(totals, default=None),
        "slowest": max(totals, default=None),
        "in 3 sd": None if worst is None else "yes" if worst <= 3 else "no",
        "same bytes": compare_bytes(repeated),
    }


def compare_bytes(repeated: Sequence[Row]) -> str | None:
    """Return whether all repetitions wrote the same model, and if not, which files differ."""
    known = [name for name in FILES if all(run.get(name) for run in repeated)]
    if len(repeated) < 2 or not known:
        return None
    differ = [name for name in known if len({run[name] for run in repeated}) > 1]
    return "no: " + ", ".join(differ) if differ else "yes"


def page(about: str, rows: Sequence[Row], picture: str = "") -> str:
    """Return the page with its tables, without columns that are empty throughout, and a picture by its name."""
    ours = [row for row in rows if not is_stock(row["method"])]
    repeated = [row for row in ours if row["same bytes"]]
    parts = [
        f"# Cameras\n\n{about}\n",
        f"## Accuracy\n\n{_table(rows, ACCURACY)}",
        f"## Seconds\n\n{_table(rows, TIME)}",
    ]
    parts.append(f"## The camera before and after bundle adjustment, and what it states\n\n{_table(ours, DEVIATIONS)}")
    if repeated:
        parts.append(f"## The same bytes in every run\n\n{_table(repeated, ('photos', 'method', 'same bytes'))}")
    if picture:
        parts.append(f"## Picture\n\n![AUC of every method]({picture}.png)\n")
    return "\n".join(parts)


def _table(rows: Sequence[Row], columns: Sequence[str]) -> str:
    return table(rows, [name for name in columns if any(row.get(name) not in (None, "") for row in rows)])


def draw(rows: Sequence[Row], folder: Path, name: str) -> bool:
    """Draw AUC@1 and AUC@5 of every method on every set that has a truth; a stroke marks the bar where there is one.

    Returns:
        Whether there is such a set.
    """
    known = [row for row in rows if row.get("AUC@1") is not None]
    sets = list(dict.fromkeys(row["photos"] for row in known))
    methods = list(dict.fromkeys(row["method"] for row in known))
    if not sets:
        return False
    height = 0.8 / len(methods)
    figure, panels = pyplot().subplots(1, 2, sharey=True, figsize=(9, 1.4 + 0.42 * len(sets)))
    for axes, column in zip(panels, ("AUC@1", "AUC@5"), strict=True):
        for number, method in enumerate(methods):
            of_set = {row["photos"]: row[column] for row in known if row["method"] == method}
            places = np.arange(len(sets)) + (number - (len(methods) - 1) / 2) * height
            bars = axes.barh(places, [of_set.get(photos, 0.0) for photos in sets], height, label=method)
            axes.bar_label(bars, fmt=" %.2f", fontsize=6)
        axes.vlines([], [], [], "k", label="bar to meet")
        for place, bound in _bounds(sets, column):
            axes.vlines(bound, place - 0.45, place + 0.45, "k")
        axes.set(xlabel=f"{column}, higher is better", xlim=(0, 1.05))
        axes.margins(y=0.01)
        axes.grid(visible=False, axis="y")
    panels[0].set_yticks(range(len(sets)), [photos.replace(" ", "\n") for photos in sets])
    panels[0].invert_yaxis()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=len(methods) + 1)
    save(figure, folder, name)
    return True


def _bounds(sets: Sequence[str], column: str) -> Iterator[tuple[int, float]]:
    for place, photos in enumerate(sets):
        yield from ((place, float(bar.bound)) for bar in BARS.get(photos, ()) if bar.column == column)
