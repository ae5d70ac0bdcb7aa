"""Mapping in parts beside mapping as a whole, on the same match graph: photos, accuracy against the truth, cost.

    python -m benchmarks.many.parts --cache CACHE
    python -m benchmarks.many.parts --cache CACHE --data DATA --every 4

A walk through a town without pictures (`benchmarks.synthetic.matches`) with small steps, and with --data
the video kitchen1000, whose truth are the poses of another camera on the same rig.
"""

import argparse
import json
import resource
import shutil
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.common.command_line import new_parser
from benchmarks.common.metrics import load_truth
from benchmarks.common.photo_sets import link_or_copy
from benchmarks.common.processes import environment, module_command, row_of_module
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.many.graphs import calibrate_town
from benchmarks.synthetic.matches import TownOptions, make_town_graph
from sfm_app.colmap.backend import Reconstruction
from sfm_app.colmap.bundle import adjust_or_keep
from sfm_app.colmap.model import poses_and_points
from sfm_app.geometry.poses import robust_similarity, umeyama
from sfm_app.mapping import reconstruct
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor, worker_count
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.types import Evidence

FloatArray = NDArray[np.float64]
Pose = FloatArray

PHOTOS, STEP_M, PART, WHOLE = 300, 0.75, 80, 100_000
"""Photos of the walk, meters between them, photos of a part, and a part that is larger than any set."""
ROBUST_M = 0.02
"""Scale of the robust fit of the two cameras of a rig, in radians and meters."""
FOLDED_M = 2.0
"""A photo farther off than this, a sixth of the width of a street, stands in a wrong place. Chosen by hand."""
ABOUT = (
    "Mapping of the same match graph as a whole and in parts, up to the last adjustment. CPU: seconds of all processes "
    "from relative poses on. Centers: distances in meters after the best similarity (kitchen1000: and the offset "
    "between the two cameras of its rig), median, 90 % and largest. Joins: kept and dropped. Support: as mappers are "
    "compared; contradicted: share of the inliers of fundamental matrices."
)
COLUMNS = ("set", "method", "photos", "of", "center m", "90 %", "worst", "rotation deg", "CPU s", "support",
           "contradicted %", "parts", "joins", "dropped", "mapper")  # fmt: skip


def measure_town(photos: int, part: int, seed: int, place: Path) -> Row:
    """Map a walk through a town from its matches.

    Args:
        photos: length of the walk.
        part: `scene.part_photos`.
        seed: of the town.
        place: folder for the mapping; removed afterwards.
    """
    town = make_town_graph(TownOptions(photos=photos, step_m=STEP_M), seed)
    intrinsics = calibrate_town(town, seed)
    shutil.rmtree(place, ignore_errors=True)
    (place / "photos").mkdir(parents=True)
    settings = Settings.from_mapping({"seed": seed, "scene": {"part_photos": part}})
    workers, before = worker_count(0), cpu_s()
    with make_executor(workers) as executor:
        run = RunContext(settings, Workspace(place), load_plugins(installed=False), executor, workers)
        outcome = reconstruct(Evidence(town.matches, town.views, intrinsics), run)
        main = outcome.models[0]
        model = adjust_or_keep(main.model, run.workspace.database).model
    spent = cpu_s() - before
    shutil.rmtree(place)
    truth = {image.name: np.column_stack([R, -R @ c]) for image, R, c in _town_truth(town)}
    names = {image.id: image.name for image in town.matches.images.values()}
    found = {names[key]: pose for key, pose in poses_and_points(model)[0].items()}
    inliers = sum(pair.inliers for pair in main.explained.values())
    against = sum(pair.contradicted for pair in main.explained.values())
    return {
        "set": f"town, {photos} photos",
        "photos": len(found),
        "of": photos,
        **pose_errors(found, truth, rig=False),
        "CPU s": spent,
        "support": outcome.support,
        "contradicted %": 100.0 * against / inliers,
        "mapper": main.mapper,
        **part_columns(run.statistics),
    }


def _town_truth(town: Any) -> list[tuple[Any, FloatArray, FloatArray]]:
    return [(town.matches.images[k + 1], R, c) for k, (R, c) in enumerate(zip(town.R, town.centers, strict=True))]


def measure_kitchen(data: Path, every: int, part: int, cache: Path) -> Row:
    """Run the program on photos of kitchen1000 up to the scene; stages before it are run once.

    Args:
        data: folder with kitchen1000.
        every: takes every so many photos.
        part: `scene.part_photos`.
        cache: keeps the photos and the run.
    """
    photos, out = cache / f"kitchen-{every}", cache / f"kitchen-{every}-run"
    photos.mkdir(parents=True, exist_ok=True)
    for photo in sorted((data / "kitchen1000" / "images").iterdir())[::every]:
        link_or_copy(photo, photos)
    options = ("--until", "scene", "--keep-low-quality", "--set", f"scene.part_photos={part}")
    command = module_command("sfm_app", "run", str(photos), "-o", str(out), *options)
    subprocess.run(command, env=environment(), check=True)
    stage = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]["scene"]
    known = stage["counts"]
    model = Reconstruction(out / "sparse")
    found = {Path(model.images[key].name).stem: pose for key, pose in poses_and_points(model)[0].items()}
    truth = {name: pose for name, (_, pose) in load_truth(data / "kitchen1000" / "cameras.json").items()}
    against, explained = known["contradicted_matches"], known["explained_matches"]
    return {
        "set": f"kitchen1000, every {every}",
        "photos": known["registered"],
        "of": known["of"],
        **pose_errors(found, truth, rig=True),
        "CPU s": stage["cpu_seconds"],
        "support": explained,
        "contradicted %": 100.0 * against / (against + explained),
        "mapper": known["mapper"],
        **part_columns(known),
    }


def part_columns(known: Mapping[str, Any]) -> Row:
    """Return how many parts and joins a run had, from its statistics."""
    figures = known.get("parts", [])
    return {
        "parts": sum(len(one["parts"]) for one in figures),
        "joins": sum(len(one["joins"]) for one in figures),
        "dropped": sum(len(one["dropped_joins"]) for one in figures),
    }


def pose_errors(found: Mapping[str, Pose], truth: Mapping[str, Pose], *, rig: bool) -> Row:
    """Return the errors of centers and rotations after the best similarity.

    Args:
        found, truth: (3, 4) camera from world, by name.
        rig: whether the truth is of another camera, fixed to the one that took the photos.
    """
    names = sorted(found.keys() & truth.keys())
    (Ra, Ca), (Rb, Cb) = (_split(np.array([poses[name] for name in names])) for poses in (found, truth))
    few = slice(None, None, max(1, len(names) // 100))
    start = robust_similarity(Ca[few], Cb[few]) if rig else umeyama(Ca, Cb)
    left = _left_over(Ra, Ca, Rb, Cb, free=rig)
    first = np.concatenate(
        [np.zeros(3), Rotation.from_matrix(start.R).as_rotvec(), [np.log(start.scale)], start.t, np.zeros(3)]
    )
    rest = left(least_squares(left, first, loss="soft_l1", f_scale=ROBUST_M).x).reshape(2, -1, 3)
    off = np.linalg.norm(rest[1], axis=1)
    return {
        "center m": float(np.median(off)),
        "90 %": float(np.percentile(off, 90)),
        "worst": float(off.max()),
        "folded": int((off > FOLDED_M).sum()),
        "rotation deg": float(np.degrees(np.median(np.linalg.norm(rest[0], axis=1)))),
    }


def _split(poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return rotations and centers of poses (N, 3, 4)."""
    return poses[:, :, :3], -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3])


def _left_over(Ra: FloatArray, Ca: FloatArray, Rb: FloatArray, Cb: FloatArray, *, free: bool) -> Any:
    """Return a function of turn and shift between cameras, and of the similarity, that gives what they leave over."""

    def left(p: FloatArray) -> FloatArray:
        between, world = (Rotation.from_rotvec(p[k : k + 3]).as_matrix() for k in (0, 3))
        if not free:
            between = np.eye(3)
        turned = np.einsum("ij,njk,lk->nil", between, Ra, world)
        rotation = Rotation.from_matrix(np.einsum("nij,nkj->nik", turned, Rb)).as_rotvec()
        shift = np.einsum("nji,j->ni", Rb, p[10:13]) if free else 0.0
        center = np.exp(p[6]) * Ca @ world.T + p[7:10] + shift - Cb
        return np.concatenate([rotation.ravel(), center.ravel()])

    return left


def cpu_s() -> float:
    """Return the CPU seconds of this process and of those that it has waited for."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in both)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("many.parts", __doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keeps runs")
    parser.add_argument("--photos", type=int, default=PHOTOS, help="of the town; 0 leaves it out")
    parser.add_argument("--part", type=int, default=PART, help="photos of a part")
    parser.add_argument("--data", type=Path, help="folder with kitchen1000; left out without it")
    parser.add_argument("--every", type=int, default=4, help="takes every so many photos of kitchen1000")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--results", type=Path, default=RESULTS)
    return parser


def main() -> None:
    """Measure both ways, and write the results."""
    args = parser().parse_args()
    if args.one:
        print(json.dumps(measure_town(args.photos, args.one, args.seed, args.cache / "town")))
        return
    rows: list[Row] = []
    for method, part in (("whole", WHOLE), ("parts", args.part)):
        if args.photos:
            town = row_of_module(
                "benchmarks.many.parts", "--cache", str(args.cache), "--photos", str(args.photos),
                "--seed", str(args.seed), "--one", str(part),
            )  # fmt: skip
            rows.append({"method": method, **town})
        if args.data:
            rows.append({"method": method, **measure_kitchen(args.data, args.every, part, args.cache)})
        print(table(rows, COLUMNS))
    rows.sort(key=lambda row: row["set"])
    options = {"photos": args.photos, "part": args.part, "every": args.every, "seed": args.seed}
    page = f"# Mapping in parts\n\n{ABOUT}\n\n{table(rows, COLUMNS)}"
    write(args.results, "many-parts", document("many.parts", ABOUT, options, {}, rows), page)


if __name__ == "__main__":
    main()
