"""Build the image of docker/Dockerfile without Docker, run the demo in it, and check what comes out.

    python -m benchmarks.anywhere --cache CACHE

Needs root, debootstrap, unshare and 8 GB. Size, exit code, seconds, lines on the screen, and whose the files are.
"""

import argparse
import os
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.anywhere.bare_root import Image, build, run
from benchmarks.anywhere.dockerfile import read_stages
from benchmarks.common.command_line import add_results, new_parser
from benchmarks.common.processes import ROOT
from benchmarks.common.results import Row, document, table, write

DOCKERFILE = ROOT / "docker" / "Dockerfile"
ABOUT = (
    "The steps of docker/Dockerfile, read from the file and run in bare Debian roots; then `sfm-app demo` in what "
    "comes out, as a user that the image does not know, without a network, with a folder of that user as /data."
)
USER = 54321
"""Ids of a user and a group that no system has."""
MOST_MB, MOST_LINES = 1600, 25
COLUMNS = ["method", "MB", "exit code", "seconds", "lines", "files", "files of others", "problems"]


def try_demo(image: Image, data: Path) -> Row:
    """Run the demo as an ordinary user, and return what came of it."""
    shutil.rmtree(data, ignore_errors=True)
    data.mkdir(parents=True)
    os.chown(data, USER, USER)
    start = time.perf_counter()
    done = run(image, ["demo", "-o", "demo"], data, f"{USER}:{USER}")
    seconds = time.perf_counter() - start
    files = [path for path in data.rglob("*") if path.is_file()]
    lines = (done.stdout + done.stderr).splitlines()
    (data.parent / "demo.log").write_text("\n".join(lines), encoding="utf-8")
    row: Row = {"method": "image", "MB": round(image.size_mb()), "exit code": done.returncode}
    row |= {"seconds": round(seconds, 1), "lines": len(lines), "files": len(files)}
    row["files of others"] = sum(path.lstat().st_uid != USER or path.lstat().st_gid != USER for path in files)
    return {**row, "problems": "; ".join(problems(row, data))}


def problems(row: Row, data: Path) -> list[str]:
    """Return what is not as it has to be."""
    found = [] if row["MB"] <= MOST_MB else [f"more than {MOST_MB} MB"]
    found += [] if row["exit code"] == 0 else [f"exit code {row['exit code']}"]
    found += [] if row["lines"] < MOST_LINES else [f"{row['lines']} lines"]
    found += [] if row["files of others"] == 0 else ["files of others"]
    return found + ([] if list(data.rglob("model.glb")) else ["no model.glb"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = new_parser("anywhere", __doc__)
    parser.add_argument("--cache", type=Path, required=True, help="where the roots are made")
    parser.add_argument("--built", action="store_true", help="try the image that an earlier call has built")
    add_results(parser, "anywhere-image")
    args: argparse.Namespace = parser.parse_args(arguments)
    stages = read_stages(DOCKERFILE)
    args.cache.mkdir(parents=True, exist_ok=True)
    image = build(stages, ROOT, args.cache, reuse=args.built)
    row = try_demo(image, args.cache / "data")
    page = f"# The image\n\n{ABOUT}\n\n{table([row], COLUMNS)}"
    write(args.results, args.name, document(args.name, ABOUT, {}, {}, [row]), page)
    print(table([row], COLUMNS))
    sys.exit(1 if row["problems"] else 0)
