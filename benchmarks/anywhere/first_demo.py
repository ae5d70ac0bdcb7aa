"""Seconds and lines from an empty environment, without a compiler on PATH, to the end of the demo.

    python -m benchmarks.anywhere.first_demo WHEELS --pythons python3.11 python3.12

WHEELS is a folder with the wheels of sfm-app and of all it needs for each Python, as a warm cache of packages has them:
`python3.11 -m pip download -c constraints.txt -d WHEELS dist/sfm_app-*.whl`.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.anywhere.pythons import find_pythons
from benchmarks.common.command_line import add_results, new_parser
from benchmarks.common.results import Row, document, table, write

ABOUT = (
    "`pip install` from a folder of wheels into an empty environment, then `sfm-app demo` in an empty home, with no "
    "other programs on PATH: no compiler, and nothing compiled or cached before."
)
MOST_S, MOST_LINES = 240, 24
"""In all, and on the screen."""


def first_demo(minor: str, python: str, wheels: Path, work: Path) -> Row:
    """Install and run the demo with one Python, and return seconds and lines.

    Args:
        minor: its version.
        python: the interpreter.
        wheels: the folder of wheels.
        work: an empty folder.
    """
    start = time.perf_counter()
    subprocess.run([python, "-m", "venv", str(work / "venv")], check=True)
    environment = {"PATH": str(work / "venv" / "bin"), "HOME": str(work), "COLUMNS": "80", "TMPDIR": str(work)}
    install = ["python", "-m", "pip", "install", "-q", "--no-index", "--find-links", str(wheels), "sfm-app"]
    steps = {"install": install, "demo": ["sfm-app", "demo", "-o", "demo"]}
    row: Row = {"method": f"Python {minor}"}
    for name, (program, *arguments) in steps.items():
        command = [str(work / "venv" / "bin" / program), *arguments]
        done = subprocess.run(command, cwd=work, env=environment, capture_output=True, text=True, check=False)
        row[f"{name} s"] = round(time.perf_counter() - start - sum(row.get(f"{key} s", 0) for key in steps), 1)
        row["lines"] = len((done.stdout + done.stderr).splitlines())
        row["longest line"] = max(map(len, (done.stdout + done.stderr).splitlines()), default=0)
        if done.returncode != 0:
            print(done.stdout, done.stderr, file=sys.stderr)
            return {**row, "result": f"{name} failed"}
    print(done.stdout, done.stderr, flush=True)
    seconds = row["install s"] + row["demo s"]
    said = [f"{seconds:.0f} s"] if seconds > MOST_S else []
    said += [f"{row['lines']} lines"] if row["lines"] > MOST_LINES else []
    size = subprocess.run(["du", "-smx", str(work / "venv")], capture_output=True, text=True, check=True).stdout
    return {**row, "MB": int(size.split()[0]), "result": "too much: " + ", ".join(said) if said else "as it has to be"}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = new_parser("anywhere.first_demo", __doc__)
    parser.add_argument("wheels", type=Path, help="folder with all wheels")
    parser.add_argument("--pythons", nargs="*", default=[], help="interpreters, instead of those on PATH")
    add_results(parser, "anywhere-first-demo")
    args = parser.parse_args(arguments)
    rows = []
    for minor, python in find_pythons(args.pythons).items():
        with tempfile.TemporaryDirectory() as work:
            rows.append(first_demo(minor, python, args.wheels.resolve(), Path(work)))
    page = f"# The first demo\n\n{ABOUT}\n\n{table(rows)}"
    write(args.results, args.name, document(args.name, ABOUT, {}, {}, rows), page)
    print(table(rows))
    sys.exit(0 if rows and all(row["result"] == "as it has to be" for row in rows) else 1)


if __name__ == "__main__":
    main()
