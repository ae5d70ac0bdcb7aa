"""Self-calibration before bundle adjustment: ours, COLMAP's view-graph calibration and the thesis's methods.

    python -m benchmarks.selfcal --photos DATA --cache CACHE --rendered 2
    python -m benchmarks.selfcal --photos DATA --cache CACHE --varied castle-P19 --sets --each \\
        --variants crop:460,200+scale:0.75,1
    python -m benchmarks.selfcal --speed --coverage 500

All methods use the same fundamental matrices, those of our own estimator, and none sees EXIF.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.common.command_line import ensure_single_thread, new_parser, overrides
from benchmarks.common.photo_sets import PhotoSet, photo_set, steps
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.selfcal.coverage import run_trials, summary
from benchmarks.selfcal.methods import PRODUCTION, adjusted_cameras, match_set, run_every_method, warm_up
from benchmarks.selfcal.rendered_sets import rendered_sets
from benchmarks.selfcal.score import row
from benchmarks.selfcal.speed import measure_speed
from sfm_app.plugins import load_plugins
from sfm_app.settings import Settings

VARIED = ("fountain-P11", "castle-P19", "Herz-Jesus-P8")
VARIANTS = ("crop:460,200", "scale:0.75,1", "window:512,256,512,512")
SETS = ("merton1", "lund-door12", "temple16", "kermit11")
OWN_CAMERA_SETS = ("reichstag10",)
ABOUT = (
    "Before bundle adjustment; fundamental matrices from our own estimator, photos without EXIF. e_focal: mean error "
    "of fx and fy (thesis 5.5.3). known: whether the method says that it knows the camera; where not, the errors are "
    "those of the guess that it falls back to, except for the thesis's methods, whose own answer is scored. sd of f: "
    "what the method states; fx sd: error of fx in stated standard deviations; in 3 sd: whether fx, fy, cx and cy all "
    "are. Sets of several cameras: medians over the photos."
)
ABOUT_COVERAGE = (
    "Synthetic photos of random cameras, every pair with noise and 20 % wrong matches, fundamental matrices from our "
    "own estimator. Shares of the answered trials in which the truth lies within 1 and 3 stated standard deviations."
)
ABOUT_SPEED = "Medians of up to five calls in one process on one thread, compiled before."


def run_photos(args: argparse.Namespace) -> None:
    """Run every method on every photo set."""
    rows: list[Row] = []
    for photos in chosen_sets(args):
        rows += calibrate_set(photos, args)
    data = {"sets": list(dict.fromkeys(line["photos"] for line in rows))}
    found = document("selfcal", ABOUT, options(args), data, rows)
    publish(args, args.name, found, f"# Self-calibration\n\n{ABOUT}\n\n{tables(rows)}")


def chosen_sets(args: argparse.Namespace) -> Iterator[PhotoSet]:
    """Yield the varied sets with their variants, the plain sets, and the rendered sets."""
    plain = [(name, "", "auto") for name in args.sets] + [(name, "", "each") for name in args.each]
    varied = [(name, change, "auto") for name in args.varied for change in ("", *args.variants)]
    for name, change, cameras in [*varied, *plain] if args.photos else []:
        yield photo_set(args.photos, name, change, args.cache, cameras)
    yield from rendered_sets(args.rendered, args.cache)


def calibrate_set(photos: PhotoSet, args: argparse.Namespace) -> list[Row]:
    """Run all methods on one set."""
    subject = match_set(photos, args.cache)
    found = list(run_every_method(subject, args.methods, overrides(args.also)))
    truth = photos.truth or adjusted_cameras(subject)
    name = photos.name if photos.truth else f"{photos.name} (against our bundle adjustment)"
    rows = [row(name, answer, truth) | {"matching seconds": subject.matching_seconds} for answer in found]
    for line in rows:
        print(json.dumps(line), file=sys.stderr, flush=True)
    return rows


def tables(rows: list[Row]) -> str:
    """Format the methods side by side, then all columns of each method."""
    parts = []
    for column in ("known", "e_focal %", "center % of width", "fy/fx %"):
        beside: dict[str, Row] = {}
        for line in rows:
            beside.setdefault(line["photos"], {"photos": line["photos"]})[line["method"]] = line[column]
        parts.append(f"## {column}\n\n{table(list(beside.values()))}")
    for method in dict.fromkeys(line["method"] for line in rows):
        lines = [line for line in rows if line["method"] == method]
        columns = [name for name in lines[0] if name != "method" and any(line.get(name) is not None for line in lines)]
        parts.append(f"## {method[0].upper()}{method[1:]}\n\n{table(lines, columns)}")
    return "\n".join(parts)


def run_coverage(args: argparse.Namespace) -> None:
    """Check the stated standard deviations; once more for every `--also` setting."""
    for label, others in {"": {}, **overrides(args.also)}.items():
        trials = run_trials(args.coverage, Settings.from_mapping(others), args.seed)
        name = f"{args.name}-coverage{'-' if label else ''}{label}"
        data = {"trials": args.coverage, "first seed": args.seed, "each": [trial.row for trial in trials]}
        found = document("selfcal-coverage", ABOUT_COVERAGE, options(args), data, summary(trials))
        page = f"# Honesty of the standard deviations\n\n{ABOUT_COVERAGE}\n\n{table(found['rows'])}"
        publish(args, name, found, page)


def run_speed(args: argparse.Namespace) -> None:
    """Measure the speed."""
    subject = None
    if args.photos:
        subject = match_set(photo_set(args.photos, args.speed, "", args.cache), args.cache)
    rows = measure_speed(subject, overrides(args.also))
    found = document("selfcal-speed", ABOUT_SPEED, options(args), {"photos": args.speed if subject else None}, rows)
    publish(args, f"{args.name}-speed", found, f"# Speed of self-calibration\n\n{ABOUT_SPEED}\n\n{table(rows)}")


def options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the options of the command that belong to the results."""
    return {"methods": list(args.methods), "also": list(args.also)}


def publish(args: argparse.Namespace, name: str, found: Row, page: str) -> None:
    """Write the results, and print the page."""
    write(args.results, name, found, page)
    print(page)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("selfcal", __doc__)
    parser.add_argument("--photos", type=Path, metavar="DATA", help="folder with NAME/images and NAME/cameras.json")
    parser.add_argument("--cache", type=Path, help="where copies of photos, matches and fundamental matrices are kept")
    parser.add_argument("--varied", nargs="*", default=VARIED, help="sets to run unchanged and in every variant")
    parser.add_argument("--variants", nargs="*", default=VARIANTS, help="changes of the photos, see photo_sets.py")
    parser.add_argument("--sets", nargs="*", default=SETS, help="sets to run unchanged")
    parser.add_argument(
        "--each", nargs="*", default=OWN_CAMERA_SETS, help="sets in which every photo has its own camera"
    )
    parser.add_argument("--rendered", type=int, default=0, metavar="N", help="seeds of each rendered set")
    parser.add_argument("--coverage", type=int, metavar="N", help="number of synthetic calibrations")
    parser.add_argument(
        "--speed", nargs="?", const="castle-P19", metavar="SET", help="measure times, with --photos also on a set"
    )
    parser.add_argument("--methods", nargs="*", default=list(load_plugins().calibrators), help="calibrators")
    parser.add_argument(
        "--also", nargs="*", default=[], metavar="TABLE.KEY=VALUE", help=f"run {PRODUCTION} once more with this setting"
    )
    parser.add_argument("--seed", type=int, default=0, help="first seed of --coverage")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--name", default="selfcal", help="name of the result files")
    return parser


def parse_arguments() -> argparse.Namespace:
    """Read the command line, and refuse options that do not fit together."""
    line = parser()
    args = line.parse_args()
    if not (args.photos or args.rendered or args.coverage or args.speed):
        line.error("name at least one of --photos, --rendered, --coverage, --speed")
    if (args.photos or args.rendered) and not args.cache:
        line.error("--photos and --rendered need --cache")
    for change in args.variants:
        steps(change)
    return args


def main() -> None:
    """Run the measurements that were asked for."""
    args = parse_arguments()
    ensure_single_thread()
    warm_up()
    if args.photos or args.rendered:
        run_photos(args)
    if args.speed:
        run_speed(args)
    if args.coverage:
        run_coverage(args)
