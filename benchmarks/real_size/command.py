"""How exact the size and the place of a model are that markers and ground control points give.

    python -m benchmarks.real_size --cache CACHE
    python -m benchmarks.real_size --cache CACHE --scenes statue --seeds 3

Each scene is photographed with two printed markers in it. One run up to `scene`, then the size in several ways.
"""

import argparse
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.command_line import new_parser
from benchmarks.common.processes import module_command, run_command
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.real_size.measured_scene import GROUND, add_markers, center_and_aim, write_control_points
from benchmarks.synthetic.scenes import WALKS, build_scene, scene_views
from sfm_app.colmap.backend import Reconstruction
from sfm_app.colmap.model import poses_and_points
from sfm_app.geometry.poses import Similarity, umeyama
from sfm_app.synthetic.cameras import Views
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder
from sfm_app.types.scene import camera_center

ABOUT = (
    "Error of the size, in percent, against the true camera centers, and of the deviation that is stated; center mm: "
    "median error of the camera centers in the frame of the files, in thousandths of the distance to the scene; wrong: "
    "control points that are off by 5 % of that distance, and those that were named. The markers' sides are a "
    "fifteenth of the distance, marks in photos are off by 0.5 pixels, coordinates by 2 mm in a scene of some meters."
)
COLUMNS = ("scene", "seed", "by", "error %", "deviation %", "in deviations", "center", "wrong", "named", "failed")
SCENES = ("courtyard", "statue", "facade", "corner")
SIDE = 1 / 15
"""Side of a marker as a share of the distance to the scene."""


def measure(scene: str, seed: int, args: argparse.Namespace) -> Iterator[Row]:
    """Yield a row for each way in which the size of a scene is found.

    Args:
        scene: its name.
        seed: of the poses and the errors.
        args: cache, quality.
    """
    views, plain = scene_views(scene, seed), build_scene(scene)
    center, aim = center_and_aim(plain.vertices, views)
    side = round(float(SIDE * np.linalg.norm(aim - center)), 3)
    place = args.cache / f"{scene}-{seed}"
    measured = add_markers(plain, views, side)
    # edges along the pixels lie between few rays
    write_photo_folder(place / "photos", measured, views, PhotoOptions(supersampling=4, seed=seed), processes=2)
    vertices = plain.vertices
    if problem := run_program(place, args.quality, "--markers", f"{side}m"):
        yield {"method": "sfm-app", "scene": scene, "seed": seed, "by": "markers", "failed": problem}
        return
    truth = true_similarity(place, views)
    distance = float(np.linalg.norm(aim - center))
    yield row_of("2 markers", scene, seed, place, views, truth, distance)
    for count, wrong in ((5, ()), (6, (1,)), (10, (2, 5))):
        rng = np.random.default_rng([seed, count])
        write_control_points(place / "gcp_list.txt", vertices, views, count, wrong, rng)
        run_program(place, args.quality, "--gcp", str(place / "gcp_list.txt"))
        yield row_of(f"{count} points", scene, seed, place, views, truth, distance) | {"wrong": len(wrong)}


def run_program(place: Path, quality: str, *options: str) -> str:
    """Run the program up to the size, and return why it failed; empty if it did not.

    Args:
        place: has the photos.
        quality, options: of the run.
    """
    command = module_command(
        "sfm_app", "run", str(place / "photos"), "-o", str(place / "out"), "--until", "scale", "--quality", quality,
        *options,
    )  # fmt: skip
    code, said = run_command(command)
    return "" if code == 0 else said


def true_similarity(place: Path, views: Views) -> Similarity:
    """Return the similarity from OUT/sparse to the scene, by the camera centers.

    Args:
        place: of the run.
        views: the true poses.
    """
    found = found_centers(place)
    names = sorted(found)
    true = np.array([camera_center(views.cam_from_world[name]) for name in names])
    return umeyama(np.array([found[name] for name in names]), true)


def found_centers(place: Path) -> Mapping[str, Any]:
    """Return the camera centers in OUT/sparse, by photo.

    Args:
        place: of the run.
    """
    model = Reconstruction(place / "out" / "sparse")
    return {model.images[key].name: camera_center(pose) for key, pose in poses_and_points(model)[0].items()}


def row_of(by: str, scene: str, seed: int, place: Path, views: Views, truth: Similarity, distance: float) -> Row:
    """Return how exact scale.json is.

    Args:
        by: what gave the size.
        scene, seed: what was photographed.
        place: of the run.
        views: the true poses.
        truth: from OUT/sparse to the scene.
        distance: to the scene.
    """
    found = json.loads((place / "out" / "scale.json").read_text(encoding="utf-8"))
    counts = json.loads((place / "out" / "manifest.json").read_text(encoding="utf-8"))["stages"]["scale"]["counts"]
    row: Row = {"method": "sfm-app", "scene": scene, "seed": seed, "by": by}
    if found["deviation"] is None:
        return row | {"failed": "; ".join(counts["problems"])}
    error = float(np.log(found["scale"] / truth.scale))
    row |= {
        "error %": 100 * error,
        "deviation %": 100 * found["deviation"],
        "in deviations": error / found["deviation"],
    }
    if "map" in found:
        frame = Similarity(found["scale"], np.array(found["R"]), np.array(found["t"]))
        off = []
        for name, center in found_centers(place).items():
            mapped = np.array(found["map"]["transform"]) @ [*frame(center), 1.0]
            east, north, up = GROUND(mapped[None, :3])[0]
            off.append(np.linalg.norm(np.array([east, up, -north]) - camera_center(views.cam_from_world[name])))
        row["center"] = 1000 * float(np.median(off)) / distance
        row["named"] = len(counts["control_points"]["wrong"])
    return row


def main() -> None:
    """Measure every scene, and write the results scene by scene."""
    parser = new_parser("real_size", __doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keeps the rendered photos and the runs")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(WALKS))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--quality", default="normal")
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args()
    rows: list[Row] = []
    for scene in args.scenes:
        for seed in range(args.seeds):
            rows += measure(scene, seed, args)
            text = table(rows, COLUMNS)
            about = {"quality": args.quality, "seeds": args.seeds}
            write(
                args.results,
                "real-size",
                document("real-size", ABOUT, about, {}, rows),
                f"# Real size\n\n{ABOUT}\n\n{text}",
            )
        print(text, flush=True)
