"""Photos through wide-angle and fisheye lenses: cameras before and after bundle adjustment, beside stock pycolmap.

    python -m benchmarks.lenses --cache CACHE
    python -m benchmarks.lenses --cache CACHE --scenes courtyard --projections equidistant --fields 90 120

Rendered folders without EXIF. Stock runs with its default camera model and with COLMAP's model for such lenses. What
has been run stays in CACHE, and is taken as it is with --keep.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.cameras.methods import Method
from benchmarks.cameras.methods import run as run_method
from benchmarks.cameras.score import TruePhoto, accuracy, read_models
from benchmarks.cameras.worker import INCREMENTAL, OURS, RESULT
from benchmarks.common.command_line import new_parser
from benchmarks.common.photo_sets import PhotoSet
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.lenses.folders import FIELDS_DEG, PROJECTIONS, SCENES, Folder, render_folder
from benchmarks.lenses.radius import projection_of, radius_error_percent
from sfm_app import estimate_lens
from sfm_app.api import open_run
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import read_features
from sfm_app.pipeline import MATCH_GRAPH, run_stages
from sfm_app.settings import Settings
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.types import Intrinsics

ABOUT = (
    "Rendered folders of 12 photos of 960 x 640 without EXIF, field of view along the longer side. Stock is pycolmap's "
    "incremental mapper with one camera for all photos, which it is told: by default (SIMPLE_RADIAL), and told the "
    "model OPENCV_FISHEYE with the true focal and center (told only the model it places no photo). radius %: the "
    "largest error of the radius of a point about the optical center, in percent of the photo's width, over the part "
    "of the photo where 95 % of the keypoints lie: before and after bundle adjustment; 100 where a lens cannot show a "
    "point at all. K known: what is said of K before. radius % of lens: the same of `sfm_app.estimate_lens`, from raw "
    "matches alone, in sd: the largest error in stated deviations; fisheye: its verdict."
)
FISHEYE = "OPENCV_FISHEYE"
COLUMNS = (
    "scene", "projection", "field deg", "method", "placed", "AUC@1", "AUC@5", "radius % before", "radius % after",
    "K known", "radius % of lens", "in sd", "fisheye", "seconds",
)  # fmt: skip
FEATURES_SHARE = 0.95


def score_run(out: Path, truth: Truth, reach_px: float) -> Row:
    """Score what a method has left in OUT."""
    photos = {
        Path(name).stem: TruePhoto(camera.K, truth.cam_from_world[name], camera.width)
        for name, camera in truth.cameras.items()
    }
    models = read_models(out)
    found = accuracy(models, photos, len(photos))
    before, known = initial_radius(out, truth, reach_px)
    return {
        "placed": f"{found['registered']}/{found['of']}",
        "AUC@1": found["AUC@1"],
        "AUC@5": found["AUC@5"],
        "radius % before": before,
        "radius % after": refined_radius(out, truth, reach_px),
        "K known": known,
    }


def initial_radius(out: Path, truth: Truth, reach_px: float) -> tuple[float | None, str]:
    """Return the worst error of the cameras before bundle adjustment, and what is said of them."""
    path = out / "calibration.json"
    if not path.exists():
        return None, ""
    intrinsics = Intrinsics.from_dict(json.loads(path.read_text(encoding="utf-8")))
    errors = [
        radius_error_percent(truth.camera, projection_of(camera), camera.K[:2, 2], reach_px)
        for camera in intrinsics.cameras.values()
    ]
    known = sorted({"yes" if camera.identifiable else camera.method for camera in intrinsics.cameras.values()})
    return round(max(errors), 3), ", ".join(known)


def refined_radius(out: Path, truth: Truth, reach_px: float) -> float | None:
    """Return the worst error of the cameras of the first model; None without a model."""
    folders = sorted(path.parent for path in out.rglob("cameras.bin") if not path.parent.name.startswith("."))
    models = {folder: pycolmap.Reconstruction(folder) for folder in folders}
    if not models:
        return None
    first = min(models, key=lambda folder: (folder != out / "sparse", -models[folder].num_reg_images()))
    errors = []
    for camera in models[first].cameras.values():
        found = camera

        def project(rays: np.ndarray) -> np.ndarray:
            return np.asarray(found.img_from_cam(rays, False), np.float64)  # noqa: B023 -- called before the next one

        center = np.asarray(camera.calibration_matrix(), np.float64)[:2, 2]
        errors.append(radius_error_percent(truth.camera, project, center, reach_px))
    return round(max(errors), 3)


def lens_row(database: Path, truth: Truth, reach_px: float) -> Row:
    """Score the lens that the raw matches of a database give."""
    keypoints, matches = read_features(database)
    rows = [
        np.hstack([keypoints[a][pair[:, 0]], keypoints[b][pair[:, 1]]])
        for (a, b), pair in sorted(matches.items())
        if len(pair)
    ]
    true = truth.camera
    found = estimate_lens(rows, (true.width, true.height))
    if found is None:
        return {"radius % of lens": None, "in sd": None, "fisheye": "none"}
    error = radius_error_percent(true, found.lens.project, np.array(found.lens.center), reach_px)
    radius = np.linspace(1.0, reach_px, 50)
    rays = true.lens.rays(np.column_stack([radius / true.K[0, 0], np.zeros(len(radius))]))
    theta = np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])
    away = np.abs(found.lens.radius(theta) - radius) / found.radius_deviation_px(theta)
    verdict = "yes" if found.is_fisheye else "no"
    return {"radius % of lens": round(error, 4), "in sd": round(float(away.max()), 2), "fisheye": verdict}


def reach_of_features(database: Path, truth: Truth) -> float:
    """Return the radius about the true center within which most keypoints lie, in pixels."""
    keypoints = np.concatenate(list(read_features(database)[0].values()))
    radius = np.hypot(keypoints[:, 0] - truth.K[0, 2], keypoints[:, 1] - truth.K[1, 2])
    return float(np.quantile(radius, FEATURES_SHARE))


def methods_for(truth: Truth) -> list[Method]:
    """Return the methods, the last of which is told the lens."""
    fx, fy, cx, cy = (float(truth.K[place]) for place in ((0, 0), (1, 1), (0, 2), (1, 2)))
    lens = {"camera_model": FISHEYE, "camera_params": f"{fx},{fy},{cx},{cy},0,0,0,0"}
    return [Method(OURS), Method(INCREMENTAL, INCREMENTAL), Method(f"{INCREMENTAL}, told the lens", INCREMENTAL, lens)]


def lens_alone(folder: Folder, args: argparse.Namespace) -> Row:
    """Match the photos, and score the lens that their matches give."""
    photos, truth = render_folder(folder, args.cache)
    out = args.cache / "matches" / folder.name
    with open_run(out, Settings(), None) as run:
        run_stages([photos], run, last=MATCH_GRAPH.name)
    row = lens_row(out / "database.db", truth, reach_of_features(out / "database.db", truth))
    return {
        "method": OURS, "scene": folder.scene, "projection": folder.projection, "field deg": folder.field_deg, **row
    }  # fmt: skip


def run_folder(folder: Folder, args: argparse.Namespace) -> Iterator[Row]:
    """Yield one row for each method."""
    if args.lens_only:
        yield lens_alone(folder, args)
        return
    photos, truth = render_folder(folder, args.cache)
    methods = methods_for(truth)[: 1 if args.ours_only else None]
    outs = {method.name: args.cache / "runs" / folder.name / method.name.replace(", ", "-") for method in methods}
    seconds: dict[str, float | None] = {}
    for method in methods:
        done = outs[method.name] / RESULT
        if not (args.keep and done.exists()):
            run_method(method, PhotoSet(folder.name, photos, {}, cameras="auto"), outs[method.name])
        said = json.loads(done.read_text(encoding="utf-8")) if done.exists() else {"seconds": {}}
        seconds[method.name] = round(sum(said["seconds"].values()), 1) or None
    reach = reach_of_features(outs[OURS] / "database.db", truth)
    for method in methods:
        yield {
            "method": method.name, "scene": folder.scene, "projection": folder.projection,
            "field deg": folder.field_deg, **score_run(outs[method.name], truth, reach),
            **(lens_row(outs[OURS] / "database.db", truth, reach) if method.name == OURS else {}),
            "seconds": seconds[method.name],
        }  # fmt: skip


def page(rows: Sequence[Mapping[str, object]]) -> str:
    """Return the table, without the columns in which nothing stands."""
    columns = [column for column in COLUMNS if any(row.get(column) not in (None, "") for row in rows)]
    return f"# Lenses\n\n{ABOUT}\n\n{table([dict(row) for row in rows], columns)}"


def parser() -> argparse.ArgumentParser:
    """Give the command line."""
    parser = new_parser("lenses", __doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keeps rendered photos and runs")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--projections", nargs="+", default=list(PROJECTIONS), choices=PROJECTIONS)
    parser.add_argument("--fields", nargs="+", type=float, default=list(FIELDS_DEG), metavar="DEG")
    parser.add_argument("--lens-only", action="store_true", help="only match, and find the lens")
    parser.add_argument("--ours-only", action="store_true", help="leave out stock")
    parser.add_argument("--name", default="lenses", help="name of the result files")
    parser.add_argument("--keep", action="store_true", help="do not run again what was run")
    parser.add_argument("--results", type=Path, default=RESULTS)
    return parser


def main() -> None:
    """Run all folders, and publish after each."""
    args = parser().parse_args()
    rows: list[Row] = []
    for scene in args.scenes:
        for projection in args.projections:
            for field_deg in args.fields:
                for row in run_folder(Folder(scene, projection, field_deg), args):
                    rows.append(row)
                    print(json.dumps(row), file=sys.stderr, flush=True)
                options = {"scenes": args.scenes, "projections": args.projections, "fields": args.fields}
                write(args.results, args.name, document("lenses", ABOUT, options, {}, rows), page(rows))
    print(page(rows))
