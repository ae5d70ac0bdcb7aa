"""Cameras of `sfm-app` compared with those of stock pycolmap: same pixels, same run, no EXIF for either.

    python -m benchmarks.cameras DATA --cache CACHE --repeat 3 --twice
    python -m benchmarks.cameras DATA --cache CACHE --sets merton1 "castle-P19 crop:300,100" --ours-only
    python -m benchmarks.cameras DATA --cache CACHE --also scene.min_seed_angle_deg=4

Stock is pycolmap's default, incremental and global, except for one shared camera, a seed, and our cap on image size.
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.cameras.bars import BARS
from benchmarks.cameras.measure import OWN_CAMERA_SETS, measure, warm_up
from benchmarks.cameras.methods import (
    STOCK,
    Method,
    group_by_size,
    methods,
    openmvg_methods,
    rotate_methods,
    told_methods,
)
from benchmarks.cameras.report import draw, medians, page
from benchmarks.cameras.score import true_photos
from benchmarks.common.command_line import add_pictures, add_results, is_wanted, new_parser, overrides
from benchmarks.common.photo_sets import PhotoSet, photo_set, steps
from benchmarks.common.results import Row, document, write

EXTRA_SETTINGS: tuple[str, ...] = ()
"""Settings for one more run of the program each, unless --also names others."""
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
    "benchmarks/cameras/bars.py."
)


def chosen_sets(args: argparse.Namespace, cache: Path) -> Iterator[tuple[PhotoSet, str]]:
    """Yield each set with the name of its data; the change follows the name after a space."""
    for title in args.sets:
        name, _, change = title.partition(" ")
        yield photo_set(args.data, name, change, cache, "each" if name in args.each else "auto"), name


def run_all(args: argparse.Namespace, these: Sequence[Method], cache: Path) -> Iterator[Row]:
    """Run every method on every set in every repetition."""
    sets = list(chosen_sets(args, cache))
    warm_up([photos for photos, _ in sets], these, cache / "cameras" / "warm-up")
    for photos, name in sets:
        of_set = [*these, *told_to_rivals(args, photos, name)]
        for repetition in range(max(args.repeat, 1 + args.twice)):
            for method in rotate_methods(of_set, repetition):
                if method.kind in STOCK and repetition >= args.repeat:
                    continue
                out = cache / "cameras" / photos.folder.name / method.name.replace(" ", "_")
                row = measure(photos, args.data / name / "cameras.json", method, out)
                print(json.dumps(row), file=sys.stderr, flush=True)
                yield row | {"repetition": repetition}


def told_to_rivals(args: argparse.Namespace, photos: PhotoSet, name: str) -> list[Method]:
    """Return rivals with what they are told of the camera, on a set whose photos share a size and a true camera."""
    truth = true_photos(args.data / name / "cameras.json", steps(photos.name.partition(" ")[2])).values()
    cameras, sizes = {photo.K.tobytes(): photo.K for photo in truth}, list(group_by_size(photos.folder))
    if len(cameras) != 1 or len(sizes) != 1:
        return []
    K = next(iter(cameras.values()))
    return told_methods(K, sizes[0], args.told) + (openmvg_methods(K) if args.openmvg else [])


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("cameras", __doc__)
    parser.add_argument("data", type=Path, help="folder with NAME/images and NAME/cameras.json")
    parser.add_argument("--cache", type=Path, help="keeps copies of photos and the last run of every method")
    parser.add_argument("--sets", nargs="+", default=list(BARS), metavar="SET", help='"NAME" or "NAME CHANGE"')
    parser.add_argument(
        "--each", nargs="*", default=OWN_CAMERA_SETS, help="sets in which every photo has its own camera"
    )
    parser.add_argument("--ours-only", action="store_true", help="skip stock pycolmap")
    parser.add_argument("--without", nargs="*", default=[], choices=STOCK, help="stock mappers to skip")
    parser.add_argument(
        "--also", nargs="*", default=EXTRA_SETTINGS, metavar="TABLE.KEY=VALUE", help="run ours with it, too"
    )
    parser.add_argument(
        "--told", nargs="*", type=float, default=[], metavar="PERCENT",
        help="stock told of a focal that is so far off, too; with 0, of the true K",
    )  # fmt: skip
    parser.add_argument("--openmvg", action="store_true", help="openmvg-rs without and with the true K, too")
    parser.add_argument("--repeat", type=int, default=1, metavar="N", help="runs of every method")
    parser.add_argument("--twice", action="store_true", help="run ours at least twice and compare the bytes")
    add_results(parser, "cameras")
    add_pictures(parser, "result files")
    return parser


def main() -> None:
    """Run all methods on all sets, and write the results."""
    args = parser().parse_args()
    these = [
        method for method in methods(overrides(args.also), ours_only=args.ours_only) if method.name not in args.without
    ]
    with tempfile.TemporaryDirectory(prefix="cameras-") as scratch:
        runs = list(run_all(args, these, args.cache or Path(scratch)))
    rows = medians(runs)
    options = {"methods": [method.name for method in these], "repeat": args.repeat, "each": list(args.each)}
    found = document("cameras", ABOUT, options, {"sets": list(args.sets), "medians": rows}, runs)
    drawn = is_wanted(args.pictures, args.name) and draw(rows, args.results, args.name)
    text = page(ABOUT, rows, args.name if drawn else "")
    write(args.results, args.name, found, text)
    print(text)
