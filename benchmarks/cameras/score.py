"""Scores of one method's output on one photo set: poses, cameras, stated deviations, times."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.metrics import (
    Pose,
    area_under_recall,
    center_error_percent,
    center_shift_percent,
    focal_error_percent,
    pose_errors_deg,
    position_rms_percent,
)
from benchmarks.common.outputs import read_initial_cameras, read_refined_cameras
from benchmarks.common.photo_sets import Step, changed_camera
from benchmarks.common.results import Row
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.model import scale_matrix

LIMITS_DEG = (1, 3, 5, 10)
FILES = ("cameras.bin", "images.bin", "points3D.bin")
STEPS = {
    "photos": "read", "features": "features + matches", "match_graph": "features + matches",
    "match_and_verify": "features + matches", "view_graph": "view graph", "intrinsics": "K", "calibrate": "K",
    "scene": "map + BA", "map": "map + BA",
}  # fmt: skip
"""The column that each step is counted in. COLMAP verifies pairs as part of matching, we do it afterwards."""


class TruePhoto(NamedTuple):
    """Ground truth of one photo."""

    K: NDArray[np.float64]
    pose: Pose
    width: float
    """Width of the photo before any change."""


class Model(NamedTuple):
    """A COLMAP model."""

    poses: Mapping[str, Pose]
    """By photo name without suffix: (3, 4) cam_from_world."""
    K: Mapping[str, NDArray[np.float64]]
    points: int
    observations: int
    reprojection_px: float


def true_photos(path: Path, change: Sequence[Step]) -> dict[str, TruePhoto]:
    """Read the truth by photo name without suffix; empty where the file does not exist."""
    images = json.loads(path.read_text(encoding="utf-8"))["images"] if path.exists() else []
    return {
        Path(entry["file"]).stem: TruePhoto(
            changed_camera(np.array(entry["K"], np.float64), change, (entry["width"], entry["height"])),
            np.column_stack([np.array(entry["R"], np.float64), np.ravel(entry["t"])]),
            entry["width"],
        )
        for entry in images
    }


def read_models(out: Path) -> list[Model]:
    """Read all models in OUT: first the one that the program calls its result, then by the number of photos."""
    found = sorted(path.parent for path in out.rglob("images.bin"))
    folders = [folder for folder in found if not any(part.startswith(".") for part in folder.relative_to(out).parts)]
    models = {folder: read_model(folder) for folder in folders}
    return [models[key] for key in sorted(folders, key=lambda key: (key != out / "sparse", -len(models[key].poses)))]


def read_model(folder: Path) -> Model:
    """Read the poses and cameras of the registered photos."""
    model = pycolmap.Reconstruction(folder)
    posed = {Path(image.name).stem: image for image in model.images.values() if image.has_pose}
    return Model(
        {name: np.asarray(posed[name].cam_from_world().matrix()) for name in sorted(posed)},
        {name: scale_matrix(model.cameras[image.camera_id]) for name, image in posed.items()},
        model.num_points3D(),
        model.compute_num_observations(),
        model.compute_mean_reprojection_error(),
    )


def accuracy(models: Sequence[Model], truth: Mapping[str, TruePhoto], photos: int) -> Row:
    """Score the first model against the truth, and each model by itself; without a truth, only count."""
    best = models[0] if models else Model({}, {}, 0, 0, float("nan"))
    registered = len(set(best.poses) & set(truth)) if truth else len(best.poses)
    row: Row = {
        "registered": registered,
        "of": len(truth) or photos,
        "unregistered": (len(truth) or photos) - registered,
        "models": len(models),
        "points": best.points,
        "observations": best.observations,
        "reprojection px": round(best.reprojection_px, 4) if models else None,
    }
    if not truth:
        return row
    poses = {name: photo.pose for name, photo in truth.items()}
    row |= camera_errors(best.K, truth)
    row["center rms %"] = _round_or_none(position_rms_percent(best.poses, poses))
    errors = pose_errors_deg(best.poses, poses)
    row |= {f"AUC@{limit}": round(area_under_recall(errors, limit), 4) for limit in LIMITS_DEG}
    alone = [model_auc(model, poses) for model in models]
    return row | {"AUC@5 of each model": ", ".join(f"{value:.2f}" for value in alone) if len(models) > 1 else None}


def model_auc(model: Model, truth: Mapping[str, Pose]) -> float:
    """Return AUC@5 over the pairs of the photos in one model: whether the model is right as far as it goes."""
    errors = pose_errors_deg(model.poses, {name: truth[name] for name in model.poses if name in truth})
    return area_under_recall(errors, 5)


def camera_errors(K: Mapping[str, NDArray[np.float64]], truth: Mapping[str, TruePhoto]) -> Row:
    """Average the errors of the cameras over the photos that have one, each against its own truth."""
    common = sorted(set(K) & set(truth))
    if not common:
        return dict.fromkeys(("e_focal %", "e_OC %", "e_OC_w %"))
    return {
        "e_focal %": round(float(np.mean([focal_error_percent(K[name], truth[name].K) for name in common])), 3),
        "e_OC %": round(float(np.mean([center_error_percent(K[name], truth[name].K) for name in common])), 3),
        "e_OC_w %": round(float(np.mean([center_shift_percent(K[n], truth[n].K, truth[n].width) for n in common])), 3),
    }


def errors_before_adjustment(out: Path, truth: Mapping[str, TruePhoto]) -> Row:
    """Score the cameras that the program knew before mapping."""
    cameras, camera_of = _calibration(out)
    known = {photo: cameras[name] for photo, name in camera_of.items() if cameras[name]["identifiable"]}
    row: Row = {"K known": f"{len(known)}/{len(camera_of)}"}
    if not truth:
        return row
    errors = camera_errors({photo: np.array(camera["K"]) for photo, camera in known.items()}, truth)
    return row | {f"{name} before": value for name, value in errors.items() if name != "e_OC %"}


def stated_deviations(out: Path, model: Model, truth: Mapping[str, TruePhoto]) -> Row:
    """Return the standard deviations after bundle adjustment, and the errors in units of them; the worst camera's."""
    by_camera, camera_of = _refined_deviations(out)
    row: Row = {}
    for photo in sorted(set(model.K) & set(truth)):
        K, true = model.K[photo], truth[photo].K
        for name, deviation in by_camera.get(camera_of.get(photo, ""), {}).items():
            if name in PARAMETER_ENTRIES and deviation > 0:
                error = abs(_mean_entry(K, name) - _mean_entry(true, name))
                row[f"sd {name} px"] = max(row.get(f"sd {name} px", 0.0), round(deviation, 3))
                row[f"{name} in sd"] = max(row.get(f"{name} in sd", 0.0), round(float(error / deviation), 2))
    counted = [value for name, value in row.items() if name.endswith(" in sd")]
    return row | {"worst in sd": max(counted, default=None)}


PARAMETER_ENTRIES = {"f": ((0, 0), (1, 1)), "fx": ((0, 0),), "fy": ((1, 1),), "cx": ((0, 2),), "cy": ((1, 2),)}
"""Entries of K for each parameter; their mean counts."""


def _mean_entry(K: NDArray[np.float64], name: str) -> float:
    return float(np.mean([K[place] for place in PARAMETER_ENTRIES[name]]))


def _refined_deviations(out: Path) -> tuple[dict[str, Mapping[str, float]], dict[str, str]]:
    """Read the deviations of the refined cameras by name, and the camera names by photo without suffix."""
    cameras, camera_of = read_refined_cameras(out)
    deviations = {name: camera["deviations"] for name, camera in cameras.items()}
    return deviations, {Path(photo).stem: name for photo, name in camera_of.items()}


def _calibration(out: Path) -> tuple[dict[str, Any], dict[str, str]]:
    """Read the cameras by name, and the camera names by photo without suffix."""
    cameras, camera_of = read_initial_cameras(out)
    return cameras, {Path(photo).stem: name for photo, name in camera_of.items()}


def times(seconds: Mapping[str, float], *, complete: bool) -> Row:
    """Sum the seconds per column; also the seconds of each step and, if all steps were done, the total."""
    row: Row = {}
    for step, value in seconds.items():
        row[STEPS[step]] = round(row.get(STEPS[step], 0.0) + value, 2)
    steps = {f"seconds of {step}": value for step, value in seconds.items()}
    return row | steps | {"total": round(sum(seconds.values()), 2) if complete else None}


def hashes(out: Path) -> Row:
    """Hash the files of the program's model."""
    found = {name: out / "sparse" / name for name in FILES}
    return {name: hashlib.sha256(path.read_bytes()).hexdigest()[:16] for name, path in found.items() if path.exists()}


def _round_or_none(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
