"""Results of every benchmark: one JSON document with all that is needed to repeat it, and Markdown tables.

The document:

    {"schema": 1, "task": str, "about": str, "options": {...}, "data": {...},
     "machine": {"machine", "cores", "python"}, "versions": {package: version},
     "rows": [{"method": str, column: str, number or null, ...}, ...]}
"""

import csv
import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from sfm_app.engine.stage import versions as program_versions

SCHEMA = 1
RESULTS = Path(__file__).parents[1] / "results"
_KEYS = {
    "schema": int, "task": str, "about": str, "options": dict, "data": dict, "machine": dict, "versions": dict,
    "rows": list,
}  # fmt: skip

Row = dict[str, Any]


def document(task: str, about: str, options: Mapping[str, Any], data: Mapping[str, Any], rows: Sequence[Row]) -> Row:
    """Build the JSON document, with machine and versions."""
    machine = {
        "machine": platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "python": platform.python_version(),
    }
    return {
        "schema": SCHEMA,
        "task": task,
        "about": about,
        "options": dict(options),
        "data": dict(data),
        "machine": machine,
        "versions": program_versions() | _installed_version("poselib") | _installed_version("pysuperansac"),
        "rows": list(rows),
    }


def finite_or_none(value: object) -> object:
    """Return the value, or None where it is a number that JSON does not allow."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def problems(found: Mapping[str, Any]) -> list[str]:
    """List where a document is not as described above; empty when it is valid."""
    wrong = [f"{key} is not {kind.__name__}" for key, kind in _KEYS.items() if not isinstance(found.get(key), kind)]
    wrong += [f"unknown key {key}" for key in found if key not in _KEYS]
    if wrong:
        return wrong
    for number, row in enumerate(found["rows"]):
        if not isinstance(row.get("method"), str):
            wrong.append(f"row {number} names no method")
        if not all(value is None or isinstance(value, (str, int, float)) for value in row.values()):
            wrong.append(f"row {number} holds more than text and numbers")
    return wrong if found["rows"] else ["there are no rows"]


def write(folder: Path, name: str, found: Row, page: str) -> None:
    """Write NAME.json and NAME.md."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    (folder / f"{name}.md").write_text(page, encoding="utf-8")


def write_csv(folder: Path, name: str, rows: Sequence[Row]) -> None:
    """Write NAME.csv."""
    with (folder / f"{name}.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def table(rows: Sequence[Row], columns: Sequence[str] | None = None) -> str:
    """Format rows as a Markdown table."""
    names = list(columns or dict.fromkeys(key for row in rows for key in row))
    lines = ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]
    lines += ["| " + " | ".join(_format_cell(row.get(name)) for name in names) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def pivot(rows: Sequence[Row], across: str, value: str) -> list[Row]:
    """Return one row per method with one column per value of `across`."""
    found: dict[str, Row] = {}
    for row in rows:
        found.setdefault(row["method"], {"method": row["method"]})[str(row[across])] = row[value]
    return list(found.values())


def _format_cell(value: object) -> str:
    if value is None:
        return ""
    return (
        f"{value:.4g}"
        if isinstance(value, float) and abs(value) < 1000
        else f"{value:.0f}"
        if isinstance(value, float)
        else str(value)
    )


def _installed_version(name: str) -> dict[str, str]:
    try:
        return {name: version(name)}
    except PackageNotFoundError:
        return {}
