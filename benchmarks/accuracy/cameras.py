#!/usr/bin/env python3
"""Cameras of `sfm-app` beside those of stock pycolmap: the same pixels, the same run, nobody sees EXIF.

    python benchmarks/accuracy/cameras.py DATA --cache CACHE --repeat 3 --twice
    python benchmarks/accuracy/cameras.py DATA --cache CACHE --sets merton1 "castle-P19 crop:300,100" --ours-only
    python benchmarks/accuracy/cameras.py DATA --cache CACHE --also scene.min_seed_angle_deg=4

Stock is pycolmap's default, incremental and global, but for one shared camera, a seed, and our cap on the image size.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from cameras_bars import BARS
from cameras_methods import STOCK, Method, methods, run, taking_turns
from cameras_report import draw, medians, page
from cameras_run import OURS
from cameras_score import (
    TruePhoto,
    accuracy,
    before_adjustment,
    hashes,
    read_models,
    stated_deviations,
    times,
    true_photos,
)
from photo_sets import PhotoSet, photo_set, steps
from report import RESULTS, Row, document, write

from sfm_app.cli.options import assigned
from sfm_app.settings import merged

EACH = ("reichstag10",)
ALSO: tuple[str, ...] = ()
"""Settings under which the program runs once more unless --also names others."""
FEW = 6
"""Sets with fewer photos do not need all kernels."""
ABOUT = (
    "The same pixels for all: photos saved anew as PNG, upright, without EXIF. Every run in a process of its own, "
    "methods taking turns, kernels compiled before; medians over the repetitions. e_focal, e_OC: mean errors of fx and "
    "fy, and of cx and cy (thesis 5.5.3); e_OC_w: distance of the optical centers as a share of the unchanged photo's "
    "width; center rms: of camera centers after a similarity, in percent of their mean distance from their mean; AUC: "
    "area under the recall of the larger of rotation and translation error over all pairs of photos, 180 degrees for a "
    "pair with a photo left out; every photo is compared with its own K. AUC@5 of each model: over its own photos, "
    "where there are several. Seconds: from the photos to the final cameras; COLMAP verifies pairs while matching, we "
    "after it; / incremental: total over that of stock incremental in the same repetition. sd: stated standard "
    "deviation after bundle adjustment; fx in sd: error of fx in them; in 3 sd: whether all errors are. bar met: see "
    "benchmarks/accuracy/cameras_bars.py."
)


def chosen_sets(args: argparse.Namespace, cache: Path) -> Iterator[tuple[PhotoSet, str]]:
    """Each set with the name of its data; the change stands behind a blank."""
    for title in args.sets:
        name, _, change = title.partition(" ")
        yield photo_set(args.data, name, change, cache, "each" if name in args.each else "auto"), name


def warm_up(sets: Sequence[PhotoSet], these: Sequence[Method], out: Path) -> None:
    """Compile the kernels: one unmeasured run on the smallest set of every kind that is no special case."""
    by_size = sorted(sets, key=lambda photos: (_count(photos) < FEW, _bytes(photos)), reverse=True)
    smallest = {photos.cameras: photos for photos in by_size}
    for photos in smallest.values():
        for method in these:
            if method.kind == OURS:
                run(method, photos, out)


def measure(photos: PhotoSet, truth_file: Path, method: Method, out: Path) -> Row:
    """One method, once, on one set."""
    said = run(method, photos, out)
    return scored(said, photos, true_photos(truth_file, steps(photos.name.partition(" ")[2])), method, out)


def scored(said: Row, photos: PhotoSet, truth: Mapping[str, TruePhoto], method: Method, out: Path) -> Row:
    """The figures of a finished run; a truth of more photos than the set has is cut to those."""
    truth = {name: true for name, true in truth.items() if (photos.folder / f"{name}.png").exists()}
    models = read_models(out)
    row = {"photos": photos.name, "method": method.name, "failed": said["failed"], "exit code": said["exit code"]}
    row |= accuracy(models, truth, _count(photos)) | times(said["seconds"], complete=not said["failed"])
    row |= {name: said[name] for name in ("wall seconds", "peak MB")}
    if method.kind == OURS:
        row |= before_adjustment(out, truth) | hashes(out)
        row |= stated_deviations(out, models[0], truth) if models else {}
    return row


def all_runs(args: argparse.Namespace, these: Sequence[Method], cache: Path) -> Iterator[Row]:
    """Every set, every repetition, every method."""
    sets = list(chosen_sets(args, cache))
    warm_up([photos for photos, _ in sets], these, cache / "cameras" / "warm-up")
    for photos, name in sets:
        for repetition in range(max(args.repeat, 1 + args.twice)):
            for method in taking_turns(these, repetition):
                if method.kind in STOCK and repetition >= args.repeat:
                    continue
                out = cache / "cameras" / photos.folder.name / method.name.replace(" ", "_")
                row = measure(photos, args.data / name / "cameras.json", method, out)
                print(json.dumps(row), file=sys.stderr, flush=True)
                yield row | {"repetition": repetition}


def overrides(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Settings by what was typed; several at once are joined by blanks."""
    found = {}
    for text in texts:
        settings: dict[str, Any] = {}
        for assignment in text.split():
            settings = merged(settings, assigned(assignment))
        found[text] = settings
    return found


def _count(photos: PhotoSet) -> int:
    return len(list(photos.folder.glob("*.png")))


def _bytes(photos: PhotoSet) -> int:
    return sum(path.stat().st_size for path in photos.folder.glob("*.png"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder with NAME/images and NAME/cameras.json")
    parser.add_argument("--cache", type=Path, help="keeps copies of photos and the last run of every method")
    parser.add_argument("--sets", nargs="+", default=list(BARS), metavar="SET", help='"NAME" or "NAME CHANGE"')
    parser.add_argument("--each", nargs="*", default=EACH, help="sets in which every photo has its own camera")
    parser.add_argument("--ours-only", action="store_true", help="without stock pycolmap")
    parser.add_argument("--without", nargs="*", default=[], choices=STOCK, help="ways of stock pycolmap to leave out")
    parser.add_argument("--also", nargs="*", default=ALSO, metavar="TABLE.KEY=VALUE", help="ours under this, too")
    parser.add_argument("--repeat", type=int, default=1, metavar="N", help="runs of every method")
    parser.add_argument("--twice", action="store_true", help="ours at least twice: are the bytes the same?")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--name", default="cameras", help="name of the result files")
    args = parser.parse_args()
    these = [
        method for method in methods(overrides(args.also), ours_only=args.ours_only) if method.name not in args.without
    ]
    with tempfile.TemporaryDirectory(prefix="cameras-") as scratch:
        runs = list(all_runs(args, these, args.cache or Path(scratch)))
    rows = medians(runs)
    options = {"methods": [method.name for method in these], "repeat": args.repeat, "each": list(args.each)}
    found = document("cameras", ABOUT, options, {"sets": list(args.sets), "medians": rows}, runs)
    write(args.results, args.name, found, page(ABOUT, rows))
    draw(rows, args.results, args.name)
    print(page(ABOUT, rows))


if __name__ == "__main__":
    main()
