"""Every constant of the two methods that was chosen by hand, halved and doubled: what becomes of poses and focals?

    python -m benchmarks.sensitivity DATA --cache CACHE

DATA holds the photo sets with truth. What is measured stays in the results: the same command goes on where it was
stopped, and measures anew what has changed with --again. About a minute of one core for each constant.
"""

import argparse
import json
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from benchmarks.common.command_line import new_parser
from benchmarks.common.metrics import load_truth
from benchmarks.common.processes import environment, module_command
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.sensitivity.constants import ROOMS, Constant, constants
from benchmarks.sensitivity.problem import Problem
from benchmarks.trouble.command import load_folder
from sfm_app.api import open_run
from sfm_app.pipeline import MATCH_GRAPH, run_stages
from sfm_app.settings import Settings
from sfm_app.types import MatchGraph

ABOUT = (
    "Constants whose docstring says that they were chosen by hand, each halved and doubled alone (the distance to 1 of "
    "shares above 0.5). All folders: fundamental matrices, cameras, relative poses. AUC@5: mean area under the recall "
    "of relative poses up to 5 degrees of all pairs with matches; focal %: mean error of the focals. Both as "
    "differences to the program as it is. worst: the largest loss of AUC@5 in one folder. noise: the same program "
    "under other seeds, which is what a difference has to exceed to mean something."
)
SETS = ("Herz-Jesus-P8", "reichstag10")
"""Photo sets with truth: one camera, and ten."""
SEEDS = (5000, 5001, 5003, 5005, 5007)
"""Of rendered folders with trouble, those of 5000 to 5007 that have at most ten photos; no constant was chosen on
them."""
FACTORS = (0.5, 2.0)
NOISE = (1, 2, 3, 4)
"""Other seeds of the program as it is."""
COLUMNS = ("constant", "AUC@5, halved", "AUC@5, doubled", "worst", "focal %, halved", "focal %, doubled")

Figures = dict[str, dict[str, Any]]
"""By folder: numbers, or why there are none."""


def prepare(data: Path, cache: Path) -> None:
    """Match the photos of every folder once; what is there stays."""
    for name in SETS:
        if not (cache / "problems" / name / "problem.pickle").exists():
            truth = load_truth(data / name / "cameras.json")
            matches = matches_of(data / name / "images", cache / "runs" / name)
            keep(cache / "problems" / name, Problem(matches, *({k: v[i] for k, v in truth.items()} for i in (0, 1))))
    for seed in SEEDS:
        if not (cache / "problems" / f"trouble {seed}" / "problem.pickle").exists():
            photos, true, _ = load_folder(seed, cache)
            matches = matches_of(photos, cache / "runs" / str(seed))
            Ks = {Path(name).stem: camera.K for name, camera in true.cameras.items()}
            poses = {Path(name).stem: pose for name, pose in true.cam_from_world.items()}
            keep(cache / "problems" / f"trouble {seed}", Problem(matches, Ks, poses))


def matches_of(photos: Path, out: Path) -> MatchGraph:
    """Return keypoints and raw matches, as the program finds them."""
    print(f"matching {photos}", file=sys.stderr)
    with open_run(out, Settings(), None) as run:
        return run_stages([photos], run, last=MATCH_GRAPH.name)[MATCH_GRAPH]


def keep(folder: Path, problem: Problem) -> None:
    """Write a problem down for the workers."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "problem.pickle").write_bytes(pickle.dumps(problem))


def run_worker(cache: Path, *changed: str, seed: int = 0) -> Figures:
    """Return the figures of all folders, from a process of its own.

    Args:
        cache: as `prepare` has left it.
        changed: path, names and factor of a constant; none for the program as it is.
        seed: of the run.
    """
    command = module_command("benchmarks.sensitivity.worker", str(cache / "problems"), *changed)
    variables = environment() | {"SENSITIVITY_SEED": str(seed), "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=variables)
    if done.returncode:
        return {"all": {"failed": done.stderr.strip().split("\n")[-1]}}
    return dict(json.loads(done.stdout.strip().split("\n")[-1]))


def difference(found: Figures, usual: Figures) -> dict[str, Any]:
    """Return mean differences to the program as it is, and the worst of a folder; or why there are none."""
    failed = [figures["failed"] for figures in found.values() if "failed" in figures]
    if failed:
        return {"failed": failed[0]}
    gains = [found[name]["AUC@5"] - usual[name]["AUC@5"] for name in usual]
    focals = [found[name]["focal %"] - usual[name]["focal %"] for name in usual]
    return {"AUC@5": sum(gains) / len(gains), "worst": min(gains), "focal %": sum(focals) / len(focals)}


def row_of(constant: str, halved: Mapping[str, Any], doubled: Mapping[str, Any]) -> Row:
    """Return the line of a constant."""
    row: Row = {"method": "sfm-app", "constant": constant}
    for name, found in (("halved", halved), ("doubled", doubled)):
        for figure in ("AUC@5", "focal %"):
            row[f"{figure}, {name}"] = found["failed"] if "failed" in found else round(found[figure], 4)
    worst = [found["worst"] for found in (halved, doubled) if "worst" in found]
    return row | {"worst": round(min(worst), 4) if worst else None}


def lacking(rows: list[Row], rooms: list[str]) -> Iterator[Constant]:
    """Yield the constants that are not measured yet."""
    known = {row["constant"] for row in rows}
    for constant in constants(rooms):
        if label(constant) not in known:
            yield constant


def label(constant: Constant) -> str:
    """Return how a constant is called in the results."""
    return f"{constant.module.removeprefix('sfm_app.')}: {constant.names}"


def read_rows(path: Path, *, again: bool) -> list[Row]:
    """Return what was measured before, without constants that are gone."""
    if again or not path.exists():
        return []
    here = {label(constant) for constant in constants()}
    rows: list[Row] = json.loads(path.read_text(encoding="utf-8"))["rows"]
    return [row for row in rows if row["constant"] in here]


def page(rows: list[Row]) -> str:
    """Return the table, the constants that matter most first."""

    def weight(row: Row) -> float:
        values = [row[column] for column in COLUMNS[1:3]]
        return max((abs(value) if isinstance(value, float) else 9.0 for value in values), default=0.0)

    order = sorted(rows, key=lambda row: (not row["constant"].startswith("noise"), -weight(row), row["constant"]))
    return f"# Constants chosen by hand\n\n{ABOUT}\n\n{table(order, COLUMNS)}"


def parser() -> argparse.ArgumentParser:
    """Give the command line."""
    parser = new_parser("sensitivity", __doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--cache", type=Path, required=True, help="keeps matches of the folders")
    parser.add_argument("--rooms", nargs="+", default=list(ROOMS), choices=ROOMS)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="constants at a time")
    parser.add_argument("--again", action="store_true", help="measure all constants anew")
    parser.add_argument("--results", type=Path, default=RESULTS)
    return parser


def main() -> None:
    """Measure all constants, and publish after each."""
    args = parser().parse_args()
    prepare(args.data, args.cache)
    rows = read_rows(args.results / "sensitivity.json", again=args.again)
    usual = run_worker(args.cache)
    noise = [difference(run_worker(args.cache, seed=seed), usual) for seed in NOISE]

    def ask(constant: Constant) -> Row:
        changes = [run_worker(args.cache, constant.path, constant.names, str(factor)) for factor in FACTORS]
        return row_of(label(constant), *(difference(found, usual) for found in changes))

    options = {"sets": list(SETS), "seeds": list(SEEDS), "factors": list(FACTORS)}
    rows += [row_of(f"noise: seeds {NOISE[k]} and {NOISE[k + 1]}", *noise[k : k + 2]) for k in (0, 2)]
    with ThreadPoolExecutor(args.jobs) as pool:
        for row in pool.map(ask, list(lacking(rows, args.rooms))):
            rows.append(row)
            print(json.dumps(row), file=sys.stderr, flush=True)
            write(args.results, "sensitivity", document("sensitivity", ABOUT, options, usual, rows), page(rows))
    print(page(rows))
