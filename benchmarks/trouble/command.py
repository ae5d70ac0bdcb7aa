"""Run `sfm-app run --until scene` on rendered folders with random trouble, and count failures and wrong cameras.

    python -m benchmarks.trouble --cache CACHE --folders 200 --keep
    python -m benchmarks.trouble --cache CACHE --only 17 42
    python -m benchmarks.trouble --cache CACHE --hard statue-by-many palace brass dark --name trouble-hard
    python -m benchmarks.trouble --cache CACHE --folders 100 --keep --without learned-cameras finer-features

A seed determines a folder. With --keep, runs of the same program are reused. --without runs the scene once more without
a hypothesis about the photos, in the folders where it was tried.
"""

import argparse
import json
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any, get_args

import numpy as np

from benchmarks.cameras.methods import Method, ablations
from benchmarks.cameras.score import Model, TruePhoto, accuracy, read_models
from benchmarks.cameras.worker import OURS
from benchmarks.common.command_line import new_parser
from benchmarks.common.metrics import focal_error_percent, misplaced_photos
from benchmarks.common.outputs import read_initial_cameras, read_refined_cameras
from benchmarks.common.photo_sets import PhotoSet
from benchmarks.common.processes import run_command
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.corpus.kept_runs import FinishedRun, has_tried, load_finished_run, record_run, run_key, trials
from benchmarks.corpus.report import GAINS_TEXT, hypothesis_rows
from benchmarks.corpus.score import Doubt, parameter_errors
from benchmarks.synthetic.hard import HARD
from benchmarks.synthetic.trouble import KINDS, troubled_folder, write_troubled_folder
from sfm_app.frame.upright import turn_camera
from sfm_app.products import read_scene
from sfm_app.report.text import place_warnings
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import HypothesisName
from sfm_app.synthetic.photo_folder import Truth, load_truth, save_truth

ABOUT = (
    "Rendered folders of 6 to 20 small photos, each with a few troubles drawn by its seed "
    "(`benchmarks/synthetic/trouble.py`), "
    "through `sfm-app run --until scene` in a process of its own, without EXIF. Exit codes 0 and 4 (the photos do not "
    "support a scene, and it says why) are expected, all others are failures. known: photos whose K is called "
    "identifiable before mapping; focal %: its error against the camera that took the photo, the worst photo; after: "
    "bundle adjustment, where a focal counts as known when three stated deviations are within 3 %. in sd: fx, fy, cx "
    "and cy after bundle adjustment in stated deviations, against the median of the cameras of the photos. misplaced: "
    "placed photos over 20 degrees or a tenth of the distance of the scene off; silent: those in runs without a "
    "warning about places or focal lengths."
)
WRONG_PERCENT = 5.0
"""A focal that is called identifiable and has a larger error is wrong."""
WRONG_SHARE = 0.01
"""Largest share of folders that may have a wrong focal."""
SILENT_SHARE = 0.003
"""Largest share of placed photos that may be in a wrong place without a warning."""
EXPECTED = (0, 4)
RENDER_LOCK = Lock()
"""Held while rendering, which uses all cores anyway."""


def load_folder(seed: int | str, cache: Path) -> tuple[Path, Truth, tuple[str, ...]]:
    """Return the photos of a seed or hard folder, their truth and its troubles; rendered on first use."""
    plan, name = (HARD[seed](), seed) if isinstance(seed, str) else (troubled_folder(seed), f"{seed:05d}")
    photos, truth = cache / "trouble" / "photos" / name, cache / "trouble" / "truth" / name
    with RENDER_LOCK:
        if not truth.exists():  # written last
            shutil.rmtree(photos, ignore_errors=True)
            save_truth(write_troubled_folder(photos, plan), truth)
    return photos, load_truth(truth), plan.troubles


def run_folder(seed: int | str, args: argparse.Namespace) -> list[Row]:
    """Run the program on one folder, and without each hypothesis that is left out, and score the results."""
    photos, truth, troubles = load_folder(seed, args.cache)
    whole = args.cache / "trouble" / "runs" / photos.name
    rows = []
    for method in (Method(OURS), *ablations(args.without)):
        out = whole.with_name(f"{whole.name}-without-{method.without}") if method.without else whole
        if method.without and not has_tried(whole, method.without):
            continue
        key = run_key(method, PhotoSet(photos.name, photos, {}))
        done = load_finished_run(out)
        if done is None or not args.keep or done.key != key:
            shutil.rmtree(out, ignore_errors=True)
            command = [
                sys.executable,
                "-m",
                "sfm_app",
                "run",
                str(photos),
                "-o",
                str(out),
                "--until",
                "scene",
                "--quiet",
            ]
            if method.without:
                shutil.copytree(whole, out)
                command += ["--set", f"scene.without={method.without}"]
            command += ["--workers", str(args.workers)] if args.workers else []
            code, last = run_command(command, 60 * args.limit_min)
            done = FinishedRun(key, {"exit code": code, "last": last if code else ""})
            record_run(out, done)
        row = {"method": method.name, "photos": photos.name, "seed": seed, "troubles": ", ".join(troubles) or "none"}
        row |= done.said | score_run(out, truth) | {"trials": trials(out)}
        print(f"{seed}: {method.name}: {summary_line(row)}", file=sys.stderr, flush=True)
        rows.append(row)
    return rows


def summary_line(row: Row) -> str:
    """Describe a folder in one line."""
    shown = ("placed", "AUC@5", "known", "focal %", "known after", "focal % after", "worst in sd")
    figures = ", ".join(f"{name} {row[name]}" for name in shown if row.get(name) is not None)
    return (
        f"{row['troubles']}: exit code {row['exit code']}{' (' + row['last'] + ')' if row['last'] else ''}: {figures}"
    )


def score_run(out: Path, truth: Truth) -> Row:
    """Score the result against the truth."""
    laid = laid_photos(out)
    photos = {
        Path(name).stem: lay(photo) if name in laid else photo
        for name, camera in truth.cameras.items()
        for photo in (TruePhoto(camera.K, truth.cam_from_world[name], camera.width),)
    }
    models = read_models(out) if out.exists() else []
    found = accuracy(models, photos, len(photos))
    stated = parameter_errors(out, photos, Doubt(0.0, 0.0))
    after = [row["in sd"] for row in stated if row["when"] == "after" and row["in sd"] is not None]
    return {
        "placed": f"{found['registered']}/{found['of']}",
        "registered": found["registered"],
        "map + BA": cpu_seconds(out, "scene"),
        "features": cpu_seconds(out, "match_graph"),
        "cameras": cpu_seconds(out, "intrinsics"),
        "share placed": round(found["registered"] / found["of"], 3),
        "models": found["models"],
        "AUC@1": found["AUC@1"],
        "AUC@5": found["AUC@5"],
        **misplaced(out, models, photos, truth),
        **known_cameras(out, photos, "before"),
        **known_cameras(out, photos, "after", [row for row in stated if row["when"] == "after"]),
        "stated": len(after),
        "beyond 3 sd": sum(value > 3 for value in after),
        "worst in sd": max(after, default=None),
    }


def laid_photos(out: Path) -> set[str]:
    """Return the photos that the program laid on their side, because most others are wide."""
    file = out / "photos.json"
    entries = json.loads(file.read_text(encoding="utf-8"))["photos"] if file.exists() else ()
    return {entry["name"] for entry in entries if entry["turn_deg"] == 90}


def lay(photo: TruePhoto) -> TruePhoto:
    """Return the camera of an upright photo after a quarter turn to the left."""
    turn = turn_camera(np.eye(3), -90)
    moved = np.array([turn[0], [-1.0, 0.0, photo.width], turn[2]])
    return photo._replace(K=moved @ photo.K @ turn.T, pose=turn @ photo.pose)


def misplaced(out: Path, models: Sequence[Model], photos: Mapping[str, TruePhoto], truth: Truth) -> Row:
    """Count the photos of the main model in a wrong place, and those of them without any warning."""
    if not models:
        return {"misplaced": 0, "silent": 0}
    poses = {name: photo.pose for name, photo in photos.items()}
    middle = np.median(truth.vertices, axis=0)
    size = float(np.median([np.linalg.norm(center - middle) for center in truth.centers.values()]))
    wrong = misplaced_photos(models[0].poses, poses, size)
    warned = any(place_warnings(read_scene(Workspace(out)), manifest(out)["scene"]["counts"]))
    return {"misplaced": len(wrong), "silent": 0 if warned else len(wrong)}


def manifest(out: Path) -> dict[str, Any]:
    """Return the records of the stages in OUT; empty without them."""
    try:
        stages: dict[str, Any] = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]
    except (OSError, ValueError, KeyError):
        return {}
    return stages


def cpu_seconds(out: Path, stage: str) -> float | None:
    """Return the CPU seconds of a stage in OUT; None without them."""
    seconds: float | None = manifest(out).get(stage, {}).get("cpu_seconds")
    return seconds


def known_cameras(out: Path, photos: dict[str, TruePhoto], when: str, stated: Sequence[Row] = ()) -> Row:
    """Count the photos with a camera that is called known, and return the error of the worst of them."""
    suffix, (found, camera_of) = (
        ("", read_initial_cameras(out)) if when == "before" else (" after", read_refined_cameras(out))
    )
    sure = {row["camera"] for row in stated if row["identifiable"] == "yes"}
    known = {name for name, camera in found.items() if (camera["identifiable"] if when == "before" else name in sure)}
    cameras = {name: found[name]["K"] for name in known}
    errors = [
        focal_error_percent(np.array(cameras[name]), photos[Path(photo).stem].K)
        for photo, name in camera_of.items()
        if name in cameras and Path(photo).stem in photos
    ]
    return {
        f"known{suffix}": f"{len(errors)}/{len(photos)}",
        f"focal %{suffix}": round(max(errors), 2) if errors else None,
        f"wrong{suffix}": int(bool(errors) and max(errors) > WRONG_PERCENT),
    }


def summary(rows: Sequence[Row]) -> Row:
    """Summarize some folders."""
    known = [row for row in rows if row["focal %"] is not None]
    stated = sum(row["stated"] for row in rows)
    return {
        "folders": len(rows),
        "failures": sum(row["exit code"] not in EXPECTED for row in rows),
        "exit 4": sum(row["exit code"] == 4 for row in rows),
        "placed, mean share": _mean([row["share placed"] for row in rows]),
        "AUC@5, mean": _mean([row["AUC@5"] for row in rows]),
        "K known": len(known),
        "K wrong": sum(row["wrong"] for row in rows),
        "K wrong after": sum(row["wrong after"] for row in rows),
        "misplaced": sum(row["misplaced"] for row in rows),
        "silent": sum(row["silent"] for row in rows),
        "beyond 3 sd": f"{sum(row['beyond 3 sd'] for row in rows)} of {stated}",
    }


def trouble_rows(rows: Sequence[Row]) -> Iterator[Row]:
    """Yield the summary of all folders, and of those with each trouble."""
    yield {"trouble": "all"} | summary(rows)
    for kind in ("none", *KINDS):
        if having := [row for row in rows if kind in row["troubles"].split(", ")]:
            yield {"trouble": kind} | summary(having)


def demands(rows: Sequence[Row]) -> list[Row]:
    """Check what is required of all folders together."""
    all_of = summary(rows)
    before, after, allowed = all_of["K wrong"], all_of["K wrong after"], int(WRONG_SHARE * len(rows))
    stated, off = sum(row["stated"] for row in rows), sum(row["beyond 3 sd"] for row in rows)
    seeds = {name: [str(row["seed"]) for row in rows if row[name]] for name in ("wrong", "wrong after", "silent")}
    silent, placed = all_of["silent"], sum(row["registered"] for row in rows)
    failed = [str(row["seed"]) for row in rows if row["exit code"] not in EXPECTED]
    found = [
        ("no exception: exit code 0 or 4", all_of["failures"], failed, all_of["failures"] == 0),
        ("K identifiable and over 5 % off: at most 1 %", before, seeds["wrong"], before <= allowed),
        ("the same after bundle adjustment", after, seeds["wrong after"], after <= allowed),
        ("misplaced without a warning: at most 0.3 % of placed photos", f"{silent} of {placed}", seeds["silent"],
            silent <= SILENT_SHARE * placed),
        ("at most one parameter of twenty beyond 3 sd", f"{off} of {stated}", [], 20 * off <= stated),
    ]  # fmt: skip
    return [
        {"asked": asked, "found": number, "seeds": ", ".join(which), "met": "yes" if met else "no"}
        for asked, number, which, met in found
    ]


def page(rows: Sequence[Row]) -> str:
    """Return the tables: requirements, results by trouble, the folders that are far off, and gains of hypotheses."""
    gains, rows = hypothesis_rows(rows), [row for row in rows if row["method"] == OURS]
    far = [
        row for row in rows if row["exit code"] not in EXPECTED or row["wrong"] or row["wrong after"] or row["silent"]
    ]
    shown = (
        "seed", "troubles", "exit code", "last", "placed", "AUC@5", "misplaced", "silent", "known", "focal %",
        "known after", "focal % after",
        "worst in sd",
    )  # fmt: skip
    parts = [
        f"# Folders with trouble\n\n{ABOUT}\n",
        table(demands(rows)),
        "## By trouble\n",
        table([*trouble_rows(rows)]),
    ]
    if all(row["seed"] in HARD for row in rows):
        columns = ("seed", "placed", "AUC@5", "features", "cameras", "map + BA", "focal % after", "worst in sd")
        parts += ["## Hard folders; CPU seconds of features and pairs, cameras, map and bundle adjustment\n"]
        parts += [table(rows, columns)]
    parts += [
        "## Folders that failed, or with a wrong camera or place without a warning\n",
        table(far, shown) if far else "None.\n",
    ]
    parts += ["## What each hypothesis gains\n", GAINS_TEXT, table(gains)] if gains else []
    return "\n".join(parts)


def _mean(values: Sequence[float]) -> float | None:
    return round(sum(values) / len(values), 3) if values else None


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("trouble", __doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keeps rendered photos and runs")
    parser.add_argument("--folders", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first folder; the others count up from it")
    parser.add_argument("--only", nargs="+", type=int, metavar="SEED", help="run only these seeds")
    parser.add_argument("--hard", nargs="+", choices=HARD, metavar="NAME", help=f"run only {', '.join(HARD)}")
    parser.add_argument("--keep", action="store_true", help="reuse runs of the same program")
    parser.add_argument("--jobs", type=int, default=1, help="folders at a time")
    parser.add_argument("--workers", type=int, default=0, help="workers of each run; 0: one per core")
    parser.add_argument("--limit-min", type=float, default=15.0, metavar="M", help="time limit of a run in minutes")
    parser.add_argument(
        "--without", nargs="*", default=[], choices=get_args(HypothesisName), metavar="NAME",
        help="run the scene again without each of these, in the folders where it was tried",
    )  # fmt: skip
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--name", default="trouble", help="name of the result files")
    return parser


def main() -> None:
    """Run all folders, and write the results after each."""
    args = parser().parse_args()
    seeds = args.hard or args.only or [args.seed + k for k in range(args.folders)]
    rows: list[Row] = []
    with ThreadPoolExecutor(args.jobs) as pool:
        for of_folder in pool.map(partial(run_folder, args=args), seeds):
            rows += of_folder
            kept = [{name: value for name, value in row.items() if name != "trials"} for row in rows]
            found = document("trouble", ABOUT, {"jobs": args.jobs, "workers": args.workers}, {"seeds": seeds}, kept)
            write(args.results, args.name, found, page(rows))
    print(page(rows))
