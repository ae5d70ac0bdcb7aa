"""View graphs of thousands of photos: time, memory and errors of the cameras and of the pose graph.

    python -m benchmarks.many
    python -m benchmarks.many --counts 500 1000

A walk through a town of equal blocks, without pictures (`benchmarks.synthetic.matches`). Every number of photos
is a process of its own, so that memory is its own.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.common.command_line import new_parser
from benchmarks.common.memory import peak_mb
from benchmarks.common.processes import row_of_module
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.synthetic.matches import TownGraph, TownOptions, make_town_graph
from sfm_app.estimation.calibrating import photo_pairs, sample_pairs
from sfm_app.mapping.cuts import cut_group
from sfm_app.mapping.parts import OPTIONS as PARTS
from sfm_app.plugins import load_plugins
from sfm_app.posegraph import PoseGraphOptions, build_pose_graph
from sfm_app.posegraph.graph import average_pair_rotations
from sfm_app.runtime.parallel import make_executor, ordered_map, worker_count
from sfm_app.selfcal import calibrate_photo_set
from sfm_app.settings import Settings
from sfm_app.types import Evidence, Intrinsics, PoseGraph

COUNTS = (1000, 2500, 10_000)
ABOUT = (
    "A walk through a town with loops and look-alike houses: matches with noise of half a pixel and a quarter of wrong "
    "ones, 30 partners a photo, one pair in a hundred of look-alikes. K: calibration from a sample of pairs. Seconds "
    "of two workers; MB: most memory of the process, the made-up matches among it. Rotation: of photos against the "
    "truth, after the best turn of all. Parts: of about 150 photos; the largest with the photos that it shares, the "
    "mean of these, and the pairs of look-alikes that were not recognized, within parts and between them."
)
COLUMNS = ("photos", "pairs", "K s", "focal %", "pose graph s", "in one group", "look-alikes kept", "right dropped",
           "rotation deg", "worst deg", "parts s", "parts", "largest", "shared", "alike within", "alike between",
           "MB", "s per 1000 photos")  # fmt: skip


def measure(photos: int, seed: int) -> Row:
    """Calibrate a view graph, build its pose graph and cut that into parts.

    Args:
        photos: length of the walk.
        seed: of the town.
    """
    town = make_town_graph(TownOptions(photos=photos), seed)
    workers = worker_count(0)
    executor = make_executor(workers)

    def run_map(function: Callable[[Any], Any], items: Sequence[Any], _: str) -> list[Any]:
        return list(ordered_map(executor, function, items, 2 * workers))

    start = time.perf_counter()
    intrinsics = calibrate_town(town, seed)
    calibrated = time.perf_counter()
    evidence = Evidence(town.matches, town.views, intrinsics)
    graph = build_pose_graph(evidence, PoseGraphOptions(1.5, 16, seed), run_map)
    posed = time.perf_counter()
    parts = cut_group(graph, graph.groups[0], PARTS.usual_size)
    end = time.perf_counter()
    (camera,) = intrinsics.cameras.values()
    off = rotation_errors_deg(town, graph)
    kept, right = set(graph.poses), town.views.fits.keys() - town.look_alikes
    owner = {photo: number for number, part in enumerate(parts) for photo in part.own}
    alike = [owner.get(a) == owner.get(b) for a, b in sorted(kept & town.look_alikes)]
    return {
        "method": "sfm-app",
        "photos": photos,
        "pairs": len(town.views.fits),
        "K s": calibrated - start,
        "focal %": 100.0 * abs(camera.focal_px / town.K[0, 0] - 1.0),
        "pose graph s": posed - calibrated,
        "in one group": len(graph.groups[0]),
        "look-alikes kept": len(kept & town.look_alikes),
        "right dropped": len(right - kept),
        "rotation deg": float(np.median(off)),
        "worst deg": float(np.max(off)),
        "parts s": end - posed,
        "parts": len(parts),
        "largest": max(len(part.photos) for part in parts),
        "shared": float(np.mean([len(part.photos) - len(part.own) for part in parts])),
        "alike within": sum(alike),
        "alike between": len(alike) - sum(alike),
        "MB": peak_mb(),
        "s per 1000 photos": 1000.0 * (end - start) / photos,
    }


def calibrate_town(town: TownGraph, seed: int) -> Intrinsics:
    """Return the camera of all photos, as a run finds it."""
    settings = Settings()
    calibrator = load_plugins(installed=False).calibrator(settings.calibration.calibrator)
    sample = sample_pairs(town.views, len(town.matches.images))
    pairs = photo_pairs(list(town.matches.images.values()), town.matches, sample)
    cameras = calibrate_photo_set(pairs, calibrator.calibrate, settings.calibration, seed, together=calibrator.together)
    names = {image.id: image.name for image in town.matches.images.values()}
    camera_of = {names[photo]: camera.name for camera in cameras for photo in camera.photos}
    return Intrinsics({camera.name: camera.found for camera in cameras}, camera_of, names)


def rotation_errors_deg(town: TownGraph, graph: PoseGraph) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the angles between the rotations of photos by the pose graph and the truth, after the best turn."""
    turns, _ = average_pair_rotations(graph.poses)
    photos = [photo for photo in graph.groups[0] if photo in turns]
    left = np.array([town.R[photo - 1].T @ turns[photo] for photo in photos])
    middle = Rotation.from_matrix(left).mean().as_matrix()
    return np.asarray(np.degrees(Rotation.from_matrix(left @ middle.T).magnitude()), np.float64)


def page(rows: Sequence[Row]) -> str:
    """Return the page with a row for each number of photos."""
    return f"# View graphs of thousands of photos\n\n{ABOUT}\n\n{table(rows, COLUMNS)}"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("many", __doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=list(COUNTS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--results", type=Path, default=RESULTS)
    return parser


def main() -> None:
    """Measure every number of photos, and write the results."""
    args = parser().parse_args()
    if args.one:
        print(json.dumps(measure(args.one, args.seed)))
        return
    rows = []
    for count in args.counts:
        rows.append(row_of_module("benchmarks.many.graphs", "--one", str(count), "--seed", str(args.seed)))
        print(table(rows[-1:], COLUMNS))
    write(args.results, "many-graphs", document("many", ABOUT, {"seed": args.seed}, {}, rows), page(rows))


if __name__ == "__main__":
    main()
