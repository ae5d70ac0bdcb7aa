"""Cost of hundreds of 12-megapixel photos: seconds and memory of every stage, beside those of half as many photos.

python -m benchmarks.hundred --cache CACHE
python -m benchmarks.hundred --cache CACHE --counts 50 100 --set quality=draft
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from benchmarks.common.command_line import new_parser
from benchmarks.common.photo_sets import link_or_copy
from benchmarks.common.results import RESULTS, Row, document, table, write
from sfm_app.pipeline import NAMES
from sfm_app.synthetic.cameras import make_camera
from sfm_app.synthetic.photo_folder import write_photo_folder
from sfm_app.synthetic.scenes import statue, statue_views

ABOUT = (
    "`sfm-app run` as a user types it, on two cores: photos of the rendered statue from all round, enlarged to 3000 x "
    "4000 pixels (JPEG, quality 90). CPU: seconds of both cores together, which other work changes least. "
    "Seconds: as in the manifest. MB: most memory held at any moment of the stage by the one process that goes through "
    "all stages, with the processes that it starts."
)
PHOTOS, SMALL, LARGE, QUALITY = 200, (750, 1000), (3000, 4000), 90
SAMPLING_INTERVAL_S = 0.1
"""Interval between readings of the memory."""


def photo_folder(count: int, cache: Path) -> Path:
    """Return a folder with `count` evenly spaced photos from all round; all are rendered once into the cache."""
    whole = cache / "hundred" / "photos"
    if not whole.exists():
        beside = whole.with_name("rendering")
        write_photo_folder(beside, statue(), statue_views(make_camera(*SMALL, focal_widths=1.35), photos=PHOTOS))
        for path in beside.iterdir():
            with Image.open(path) as image:
                image.resize(LARGE, Image.Resampling.BICUBIC).save(path, quality=QUALITY)
        beside.rename(whole)
    part = cache / "hundred" / f"photos-{count}"
    part.mkdir(exist_ok=True)
    for path in sorted(whole.iterdir())[:: PHOTOS // count][:count]:
        link_or_copy(path, part)
    return part


def measure_stages(command: Sequence[str]) -> tuple[dict[str, int], dict[str, float]]:
    """Run `sfm-app run`, and return the peak memory of each stage, in MB, and its CPU seconds. Linux only."""
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    stage, peaks, spent = [NAMES[0]], dict.fromkeys(NAMES, 0), dict.fromkeys(NAMES, 0.0)

    def read(lines: Iterable[str]) -> None:
        for line in lines:
            print(line, end="", file=sys.stderr, flush=True)
            if found := re.match(r"(\d+)/\d+ ", line):
                Path(f"/proc/{process.pid}/clear_refs").write_text("5")  # resets its peak memory
                stage[0] = NAMES[int(found[1]) - 1]

    reader = threading.Thread(target=read, args=(process.stderr,))
    reader.start()
    while process.poll() is None:
        now = stage[0]
        held = held_mb(process.pid)
        if now == stage[0]:
            peaks[now] = max(peaks[now], held)
            spent[now] = max(spent[now], cpu_s(process.pid))
        time.sleep(SAMPLING_INTERVAL_S)
    reader.join()
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}: exit code {process.returncode}")
    ends = [0.0, *spent.values()]
    return peaks, {name: end - start for name, start, end in zip(NAMES, ends, ends[1:], strict=False)}


def cpu_s(process: int) -> float:
    """Return the CPU seconds of a process and its children; 0 where it has ended."""
    return (_ticks(process) + sum(_ticks(child) for child in children(process))) / os.sysconf("SC_CLK_TCK")


def held_mb(process: int) -> int:
    """Return the larger of a process's peak memory since its last reset and what it and its children hold now."""
    own = memory_kb(process)
    return max(own["VmHWM"], own["VmRSS"] + sum(memory_kb(child)["VmRSS"] for child in children(process))) // 1024


def children(process: int) -> list[int]:
    """List the running children of a process."""
    lists = Path(f"/proc/{process}/task").glob("*/children")
    return [int(child) for path in lists for child in read_if_present(path).split()]


def memory_kb(process: int) -> dict[str, int]:
    """Read a process's memory counts from the kernel; zeros where it has ended."""
    said = re.findall(r"(VmHWM|VmRSS):\s+(\d+) kB", read_if_present(Path(f"/proc/{process}/status")))
    return {"VmHWM": 0, "VmRSS": 0} | {name: int(size) for name, size in said}


def read_if_present(path: Path) -> str:
    """Read a file of the kernel; empty where it is gone."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""


def _ticks(process: int) -> int:
    after_name = read_if_present(Path(f"/proc/{process}/stat")).rpartition(")")[2].split()
    return sum(map(int, after_name[11:15]))


def measure(count: int, cache: Path, settings: Sequence[str]) -> Row:
    """Run the program once from scratch."""
    photos = photo_folder(count, cache)
    out = Path(tempfile.mkdtemp(prefix=f"run-{count}-", dir=cache / "hundred"))
    flags = [part for assignment in settings for part in ("--set", assignment)]
    peaks, spent = measure_stages([sys.executable, "-m", "sfm_app", "run", str(photos), "-o", str(out), *flags])
    stages: dict[str, Any] = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]
    row: Row = {"method": "sfm-app", "photos": count, "placed": stages["scene"]["counts"]["registered"]}
    for name in NAMES:
        row |= {f"s of {name}": stages[name]["seconds"], f"CPU {name}": spent[name], f"MB {name}": peaks[name]}
    return row


def page(rows: Sequence[Row]) -> str:
    """Return the page: one row per stage, and per number of photos its seconds and its memory."""
    lines: list[Row] = [
        {"stage": name}
        | {f"CPU, {row['photos']} photos": row[f"CPU {name}"] for row in rows}
        | {f"s, {row['photos']} photos": row[f"s of {name}"] for row in rows}
        | {f"MB, {row['photos']} photos": row[f"MB {name}"] for row in rows}
        for name in NAMES
    ]
    total: Row = {"stage": "together"}
    for row in rows:
        total[f"CPU, {row['photos']} photos"] = sum(row[f"CPU {name}"] for name in NAMES)
        total[f"s, {row['photos']} photos"] = sum(row[f"s of {name}"] for name in NAMES)
        total[f"MB, {row['photos']} photos"] = max(row[f"MB {name}"] for name in NAMES)
    placed = ", ".join(f"{row['placed']} of {row['photos']}" for row in rows)
    return f"# Hundreds of photos\n\n{ABOUT} Photos that have a place: {placed}.\n\n{table([*lines, total])}"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("hundred", __doc__)
    parser.add_argument("--cache", type=Path, help="keeps the rendered photos and the runs")
    parser.add_argument("--counts", type=int, nargs="+", default=[100, 200], help="photos, each a divisor of 200")
    parser.add_argument("--set", dest="settings", nargs="*", default=[], metavar="TABLE.KEY=VALUE")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--name", default="hundred", help="name of the result files")
    return parser


def main() -> None:
    """Measure a run for each number of photos, and write the results."""
    args = parser().parse_args()
    with tempfile.TemporaryDirectory(prefix="hundred-") as scratch:
        cache = (args.cache or Path(scratch)).resolve()
        rows = [measure(count, cache, args.settings) for count in args.counts]
    found = document("hundred", ABOUT, {"settings": args.settings}, {"counts": args.counts}, rows)
    write(args.results, args.name, found, page(rows))
    print(page(rows))
