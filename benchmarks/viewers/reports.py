"""Open report.html of finished and failed runs from the disk in headless Chromium, without a network, at two widths.

    python -m benchmarks.viewers.reports OUT OUT --pictures FOLDER [--served]

Needs Node and `npm install` in benchmarks/viewers. Each report is written again first, and the seconds of that are
counted. With --served, the pages of `sfm-app view` are opened instead. The screenshots are to be looked at.
"""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks.common.command_line import new_parser
from benchmarks.common.results import RESULTS, Row, document, table, write
from sfm_app.api import write_report

ABOUT = (
    "report.html opened from the disk with the network off, or the page of `sfm-app view`. seconds: to write it. "
    "colors, covered: of the 3D view, how many colors it has, and the share of its pixels that are not background. "
    "chosen: the photo after a click on its row; moved: whether the view changed; measured: what two clicks or taps, "
    "and two marks by keyboard, gave. said: what the console says. requests: that left the page. beyond: pixels "
    "by which the page is wider than the screen. axe: rules of accessibility that axe-core finds broken."
)
COLUMNS = (
    "run", "width", "MB", "seconds", "colors", "covered", "chosen", "moved", "measured", "said", "requests", "beyond",
    "axe",
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
    about = {"run": out.name, "MB": report.stat().st_size / 1e6, "seconds": seconds}
    return [about | row for row in visit(str(report), pictures / out.name)]


def check_view(out: Path, pictures: Path) -> list[Row]:
    """Serve a run, open its page, and return one row for each width.

    Args:
        out: output folder of the run.
        pictures: folder for the screenshots.
    """
    start = time.perf_counter()
    command = [sys.executable, "-m", "sfm_app", "view", str(out), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            address = (server.stdout.readline() if server.stdout else "").partition(" ")[0]
            seconds = time.perf_counter() - start
            rows = visit(address, pictures / f"{out.name}-served")
        finally:
            server.send_signal(signal.SIGINT)
            ended = server.wait(timeout=60)
    about = {"run": f"{out.name}, served", "MB": None, "seconds": seconds}
    return [about | row | ({"said": f"exit code {ended}"} if ended else {}) for row in rows]


def visit(page: str, pictures: Path) -> list[Row]:
    """Open a page at both widths, and return what the browser has seen.

    Args:
        page: file or address.
        pictures: folder for the screenshots.
    """
    command = ["node", str(BROWSER / "report.mjs"), page, str(pictures)]
    said = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    found: dict[str, dict[str, Any]] = json.loads(said)
    return [{"width": width} | figures(one) for width, one in found.items()]


def figures(seen: dict[str, Any]) -> Row:
    """Return what the browser has seen at one width."""
    view, there = seen["view"] or {}, seen.get("atPhoto") or {}
    return {
        "colors": view.get("colors"),
        "covered": view.get("covered"),
        "chosen": seen.get("flown", ""),
        "moved": "yes" if view and there != view else "",
        "measured": "; ".join(texts[0] for texts in seen.get("measured", {}).values() if texts),
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
    parser.add_argument("--served", action="store_true", help="open the pages of `sfm-app view`")
    parser.add_argument("--results", type=Path, default=RESULTS)
    options = parser.parse_args()
    check, name = (check_view, "viewers-served") if options.served else (check_report, "viewers-reports")
    rows = [row for out in options.runs for row in check(out, options.pictures)]
    text = table(rows, COLUMNS)
    write(options.results, name, document("viewers", ABOUT, {}, {}, rows), f"# Reports\n\n{ABOUT}\n\n{text}")
    print(text)
    return (
        0
        if all(not row["said"] and not row["requests"] and not row["beyond"] and not row["axe"] for row in rows)
        else 1
    )


if __name__ == "__main__":
    sys.exit(main())
