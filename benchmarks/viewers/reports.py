"""Open report.html of finished and failed runs from the disk in headless Chromium, without a network, at two widths.

    python -m benchmarks.viewers.reports OUT OUT --pictures FOLDER

Needs Node and `npm install` in benchmarks/viewers. Each report is written again first, and the seconds of that are
counted. The screenshots are to be looked at.
"""

import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.common.command_line import new_parser
from benchmarks.common.results import RESULTS, Row, document, table, write
from sfm_app.api import write_report

ABOUT = (
    "report.html opened from the disk with the network off. seconds: to write it. colors, covered: of the 3D view, how "
    "many colors it has, and the share of its pixels that are not background. chosen: the photo after a click on its "
    "row; moved: whether the view changed. said: what the console says. requests: that left the page. beyond: pixels "
    "by which the page is wider than the screen. axe: rules of accessibility that axe-core finds broken."
)
COLUMNS = (
    "run", "width", "MB", "seconds", "colors", "covered", "chosen", "moved", "said", "requests", "beyond", "axe",
)  # fmt: skip
BROWSER = Path(__file__).parent


def check_report(out: Path, pictures: Path) -> list[Row]:
    """Write the report of a run, open it, and return one row for each width.

    Args:
        out: output folder of the run.
        pictures: folder for the screenshots.
    """
    start = time.perf_counter()
    report = write_report(out)
    seconds = time.perf_counter() - start
    command = ["node", str(BROWSER / "report.mjs"), str(report), str(pictures / out.name)]
    said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    found: dict[str, dict[str, Any]] = json.loads(said)
    return [
        {"run": out.name, "width": width, "MB": report.stat().st_size / 1e6, "seconds": seconds} | figures(one)
        for width, one in found.items()
    ]


def figures(seen: dict[str, Any]) -> Row:
    """Return what the browser has seen at one width."""
    view, there = seen["view"] or {}, seen.get("atPhoto") or {}
    return {
        "colors": view.get("colors"),
        "covered": view.get("covered"),
        "chosen": seen.get("flown", ""),
        "moved": "yes" if view and there != view else "",
        "said": "; ".join(seen["said"]),
        "requests": len(seen["requests"]),
        "beyond": seen["overflow"],
        "axe": "; ".join(seen["axe"]),
    }


def main() -> int:
    """Check all reports, write the results, and return exit code 0 if nothing is wrong, else 1."""
    parser = new_parser("viewers.reports", __doc__)
    parser.add_argument("runs", nargs="+", type=Path, metavar="OUT", help="output folders of runs")
    parser.add_argument("--pictures", type=Path, required=True, help="folder for the screenshots")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    rows = [row for out in options.runs for row in check_report(out, options.pictures)]
    text = table(rows, COLUMNS)
    write(
        options.results, "viewers-reports", document("viewers", ABOUT, {}, {}, rows), f"# Reports\n\n{ABOUT}\n\n{text}"
    )
    print(text)
    return (
        0
        if all(not row["said"] and not row["requests"] and not row["beyond"] and not row["axe"] for row in rows)
        else 1
    )


if __name__ == "__main__":
    sys.exit(main())
