#!/usr/bin/env python3
"""Camera poses of `sfm-app` beside those of stock pycolmap, on the same photos in the same run.

    python benchmarks/accuracy/cameras.py DATA --sets fountain-P11 castle-P19
    python benchmarks/accuracy/cameras.py DATA --sets fountain-P11 --crop 460,200 --name cameras-cropped

Stock is pycolmap's default except one shared camera and the same image size cap.
"""

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps
from score import area_under_recall, focal_error_percent, load_truth, pose_errors_deg

import sfm_app
from sfm_app.colmap.backend import pycolmap
from sfm_app.pipeline import versions

RESULTS = Path(__file__).parents[1] / "results"


def ours(photos: Path, out: Path) -> dict[str, Any]:
    """Until the scene stands."""
    run = sfm_app.reconstruct(photos, out, last="scene")
    camera = next(iter(run.scene.cameras.values()))
    return {
        "poses": {Path(name).stem: pose for name, pose in run.scene.cam_from_world.items()},
        "K_before": run.calibration.K if run.calibration.identifiable else None,
        "K": camera.K,
        "points": run.scene.points,
        "reprojection_px": run.scene.mean_reprojection_px,
    }


def stock(photos: Path, out: Path) -> dict[str, Any]:
    """pycolmap's incremental mapping."""
    out.mkdir(parents=True)
    pycolmap.set_random_seed(0)
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = sfm_app.Settings().matching.max_image_size_px
    database = out / "database.db"
    pycolmap.extract_features(database, photos, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=options)
    pycolmap.match_exhaustive(database)
    models = pycolmap.incremental_mapping(database, photos, out)
    if not models:
        return {"poses": {}, "K_before": None, "K": None, "points": 0, "reprojection_px": None}
    best = max(models.values(), key=lambda model: model.num_reg_images())
    posed = [image for image in best.images.values() if image.has_pose]
    return {
        "poses": {Path(image.name).stem: image.cam_from_world().matrix() for image in posed},
        "K_before": None,
        "K": best.cameras[posed[0].camera_id].calibration_matrix(),
        "points": best.num_points3D(),
        "reprojection_px": best.compute_mean_reprojection_error(),
    }


def cropped(photos: Path, out: Path, left: int, top: int) -> Path:
    """Copies without EXIF that lack columns at the left and rows at the top: the optical centre moves."""
    out.mkdir()
    for path in sorted(photos.iterdir()):
        with Image.open(path) as image:
            upright = ImageOps.exif_transpose(image).convert("RGB")
        upright.crop((left, top, *upright.size)).save(out / f"{path.stem}.jpg", quality=92)
    return out


def scored(found: dict[str, Any], truth_path: Path, seconds: float) -> dict[str, Any]:
    """Plain figures of one method on one set."""
    row: dict[str, Any] = {"registered": len(found["poses"]), "points": found["points"], "seconds": round(seconds, 1)}
    if found["reprojection_px"] is not None:
        row["reprojection_px"] = round(found["reprojection_px"], 3)
    if truth_path.exists():
        truth = load_truth(truth_path)
        errors = pose_errors_deg(found["poses"], {name: pose for name, (_, pose) in truth.items()})
        row |= {f"AUC@{limit}": round(area_under_recall(errors, limit), 3) for limit in (1, 5)}
        true_K = np.median([K for K, _ in truth.values()], axis=0)
        for key, name in (("K_before", "focal error before BA %"), ("K", "focal error %")):
            row[name] = None if found[key] is None else round(focal_error_percent(found[key], true_K), 2)
    return row


def markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as a table."""
    columns = list(dict.fromkeys(key for row in rows for key in row))
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(str(row.get(column, "")) for column in columns) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--sets", nargs="+", required=True)
    parser.add_argument(
        "--crop", type=lambda text: [int(value) for value in text.split(",")], help="LEFT,TOP in pixels"
    )
    parser.add_argument("--ours-only", action="store_true", help="without stock pycolmap")
    parser.add_argument("--name", default="cameras", help="name of the result files")
    args = parser.parse_args()
    methods = {"sfm-app": ours} if args.ours_only else {"sfm-app": ours, "pycolmap": stock}
    rows = []
    for name in args.sets:
        for label, method in methods.items():
            with tempfile.TemporaryDirectory() as scratch:
                photos = args.data / name / "images"
                photos = cropped(photos, Path(scratch) / "photos", *args.crop) if args.crop else photos
                start = time.perf_counter()
                found = method(photos, Path(scratch) / "out")
                seconds = time.perf_counter() - start
            rows.append({"photos": name, "method": label, **scored(found, args.data / name / "cameras.json", seconds)})
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    machine = {
        "machine": platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
    }
    document = {"machine": machine, "versions": versions(), "rows": rows}
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / f"{args.name}.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    (RESULTS / f"{args.name}.md").write_text(markdown(rows), encoding="utf-8")
    print(markdown(rows))


if __name__ == "__main__":
    main()
