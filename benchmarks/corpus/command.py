"""Run `sfm-app` and stock pycolmap on every photo set of DATA, as it is and changed: one table.

    python -m benchmarks.corpus DATA --cache CACHE --keep
    python -m benchmarks.corpus DATA --cache CACHE --sets merton1 "kitchen1000 every:5" --ours-only
    python -m benchmarks.corpus DATA --cache CACHE --keep --ours-only --without learned-cameras finer-features
    python -m benchmarks.corpus DATA --cache CACHE --score-only

--keep continues an interrupted command: what has been run with the same program, settings and photos is not
run again. --score-only runs nothing and makes the table from the runs in CACHE. --without runs the scene once more
without a hypothesis about the photos, on the sets where it was tried.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import get_args

from benchmarks.cameras.bars import BARS, verdict
from benchmarks.cameras.measure import FEW_PHOTOS, OWN_CAMERA_SETS, score_run, warm_up
from benchmarks.cameras.methods import STOCK, Method, ablations, methods
from benchmarks.cameras.score import true_photos
from benchmarks.cameras.worker import INCREMENTAL, OURS
from benchmarks.common import photo_sets
from benchmarks.common.command_line import new_parser, overrides
from benchmarks.common.photo_sets import FORMATS, PhotoSet, photo_set, steps
from benchmarks.common.results import RESULTS, Row, document, finite_or_none, write
from benchmarks.corpus.bars import required_bars, unreported_fold
from benchmarks.corpus.kept_runs import FinishedRun, has_tried, reusable_run, run_and_record, run_key, trials
from benchmarks.corpus.report import add_comparisons, corpus_page
from benchmarks.corpus.score import OFFSETS, corpus_figures, fold_lines
from sfm_app.settings import HypothesisName

ABOUT = (
    "The same pixels for all: photos saved anew as PNG, upright, no EXIF; every run in a process of its own, once. "
    "Stock is pycolmap's default but for a seed, our cap on the image size, and which photos share a camera, which it "
    "is told. AUC: area under the recall of the larger of rotation and translation error over all pairs of photos, 180 "
    "degrees for a pair with a photo left out. axis, distance: rank correlation of the photos' order with their place "
    "along the main axis, and of |i - j| with the distance between centers; jumps: steps over five usual ones. Center "
    "cm: against a camera beside ours, after fitting the offset. Before and after: bundle adjustment; %: of the true "
    "focal, of the width for the center, the worst of several cameras; in sd: in stated standard deviations. Cameras "
    "that are called guesses are not counted before. The truth's own doubt: see DOUBTS in benchmarks/corpus/score.py. "
    "Exit codes are those of the command: 0, 4 where the photos do not support a scene, none where it ran out of time."
)
DEFAULT_CHANGES = {"kitchen1000": "every:5"}
"""Changes of sets that are not run in full unless --sets names them."""
PADDED = "reichstag10 pad:1024,1024"
"""Photos of ten cameras brought to one size."""
LIMIT_MIN = 40.0


def default_titles(data: Path) -> list[str]:
    """List every set in DATA, smallest first, then the changed ones."""
    counts = {path.name: _photo_count(path) for path in data.iterdir() if (path / "images").is_dir()}
    plain = [
        f"{name} {DEFAULT_CHANGES.get(name, '')}".strip()
        for name in sorted(counts, key=lambda name: (counts[name], name))
    ]
    changed = [title for title in BARS if title.partition(" ")[0] in counts]
    padded = [PADDED] if "pad" in photo_sets.STEPS and PADDED.partition(" ")[0] in counts else []
    return list(dict.fromkeys([*plain, *changed, *padded]))


def _photo_count(folder: Path) -> int:
    return sum(path.suffix.lower() in FORMATS for path in (folder / "images").iterdir())


def score(method: Method, photos: PhotoSet, out: Path, data: Path, done: FinishedRun) -> tuple[Row, list[Row]]:
    """Score a run, and list the parameters that it states."""
    name, _, change = photos.name.partition(" ")
    truth = true_photos(data / name / "cameras.json", steps(change))
    row = score_run(done.said, photos, truth if name not in OFFSETS else {}, method, out)
    row["placed"] = f"{row['registered']}/{row['of']}"
    said = done.said.get("summary", [])
    figures, stated = corpus_figures(name, out, truth, said)
    row |= figures
    if method.kind == OURS:
        row |= {"folded without a word": unreported_fold(name, row), "said of folds": " / ".join(fold_lines(said))}
        calibration = out / "calibration.json"
        if calibration.exists():
            row["cameras"] = len(json.loads(calibration.read_text(encoding="utf-8"))["cameras"])
        row["trials"] = trials(out)
        row["made by"] = None if done.key == run_key(method, photos) else "another program, or settings"
    stated = [{"photos": photos.name, "method": method.name} | one for one in stated]
    return {name: finite_or_none(value) for name, value in row.items()}, stated


def summary_line(row: Row) -> str:
    """Describe a run in one line."""
    figures = [row["placed"] + " placed"] + [f"{key} {row[key]}" for key in SHOWN if row.get(key) not in (None, "")]
    return f"{row['photos']}: {row['method']}: {', '.join(figures)}"


SHOWN = ("models", "AUC@1", "AUC@5", "axis", "distance", "median center cm", "K known", "exit code", "wall seconds",
         "failed")  # fmt: skip


def load_set(title: str, args: argparse.Namespace) -> PhotoSet:
    """Make a set from its name and change; its photos are copied on first use."""
    name, _, change = title.partition(" ")
    return photo_set(args.data, name, change, args.cache, "each" if name in OWN_CAMERA_SETS else "auto")


def compile_kernels(args: argparse.Namespace, these: Sequence[Method]) -> bool:
    """Run once, unmeasured, on the first set that has enough photos to need all kernels."""
    enough = [title for title in args.sets if _photo_count(args.data / title.partition(" ")[0]) >= FEW_PHOTOS]
    warm_up([load_set((enough or args.sets)[0], args)], these, args.cache / "corpus" / "warm-up")
    return True


def failed_row(title: str, method: Method, error: Exception) -> Row:
    """Return the row of a run that could not be started or scored, which is a fault of the benchmark."""
    empty: Row = dict.fromkeys(("models", "total", "registered", "of", "peak MB"))
    text = f"benchmark: {type(error).__name__}: {error}"
    return {"photos": title, "method": method.name, "failed": text, "exit code": None, "placed": ""} | empty


def run_all(args: argparse.Namespace, these: Sequence[Method]) -> Iterator[tuple[Row, list[Row]]]:
    """Run every method on every set; a failure of one does not stop the others."""
    compiled = False
    for number, title in enumerate(args.sets, start=1):
        for method in these:
            stated: list[Row] = []
            try:
                photos = load_set(title, args)
                folder = args.cache / "corpus" / photos.folder.name
                out, finished = folder / method.name.replace(" ", "_"), folder / OURS if method.without else None
                if finished and not has_tried(finished, method.without):
                    continue
                done = reusable_run(method, photos, out, args)
                if done is None and args.score_only:
                    continue
                if done is None:
                    compiled = compiled or compile_kernels(args, these)
                    done = run_and_record(method, photos, out, 60 * args.limit_min, finished)
                row, stated = score(method, photos, out, args.data, done)
            except Exception as error:  # runs unattended: measure the next set anyway
                row = failed_row(title, method, error)
            print(f"[{number}/{len(args.sets)}] {summary_line(row)}", file=sys.stderr, flush=True)
            yield row, stated


def add_verdicts(rows: Sequence[Row]) -> None:
    """Fill in the columns that need other rows: ratios, figures worse than stock, and whether the bars are met."""
    add_comparisons(rows)
    for row in rows:
        beside = {other["method"]: other for other in rows if other["photos"] == row["photos"]}
        row["bar met"] = "" if row["method"] in STOCK else verdict(row, beside, required_bars(row["photos"]))


def publish(args: argparse.Namespace, these: Sequence[Method], rows: Sequence[Row], stated: Sequence[Row]) -> str:
    """Write the results so far."""
    add_verdicts(rows)
    options = {"methods": [method.name for method in these], "each": list(OWN_CAMERA_SETS), "limit min": args.limit_min}
    found = document("corpus", ABOUT, options, {"sets": list(args.sets), "parameters": list(stated)}, rows)
    text = corpus_page(ABOUT, rows, stated)
    write(args.results, args.name, found, text)
    return text


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("corpus", __doc__)
    parser.add_argument("data", type=Path, help="folder with NAME/images and, where known, NAME/cameras.json")
    parser.add_argument("--cache", type=Path, required=True, help="keeps copies of photos and the last run of each")
    parser.add_argument("--sets", nargs="+", metavar="SET", help='"NAME" or "NAME CHANGE"; all by default')
    parser.add_argument("--skip", nargs="*", default=[], metavar="SET", help="sets to skip")
    parser.add_argument(
        "--without", nargs="*", default=[], choices=get_args(HypothesisName), metavar="NAME",
        help="hypotheses to switch off, one by one: " + ", ".join(get_args(HypothesisName)),
    )  # fmt: skip
    parser.add_argument("--stock", nargs="*", default=[INCREMENTAL], choices=STOCK, help="stock mappers")
    parser.add_argument("--ours-only", action="store_true", help="skip stock pycolmap")
    parser.add_argument("--also", nargs="*", default=(), metavar="TABLE.KEY=VALUE", help="run ours with it, too")
    parser.add_argument("--keep", action="store_true", help="reuse runs of the same program")
    parser.add_argument("--score-only", action="store_true", help="run nothing: make the table from CACHE")
    parser.add_argument(
        "--limit-min", type=float, default=LIMIT_MIN, metavar="M", help="time limit of a run in minutes"
    )
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--name", default="corpus", help="name of the result files")
    return parser


def parse_arguments() -> argparse.Namespace:
    """Read the command line, and resolve which sets to run."""
    args = parser().parse_args()
    wanted = args.sets or default_titles(args.data)
    args.sets = [title for title in wanted if title not in args.skip and title.partition(" ")[0] not in args.skip]
    return args


def main() -> None:
    """Run, score and publish set by set."""
    args = parse_arguments()
    stock = () if args.ours_only else args.stock
    these = [method for method in methods(overrides(args.also)) if method.kind == OURS or method.name in stock]
    these += ablations(args.without)
    rows: list[Row] = []
    stated: list[Row] = []
    page = ""
    for row, parameters in run_all(args, these):
        rows.append(row)
        stated += parameters
        page = publish(args, these, rows, stated)
    print(page or "nothing has been run")
