"""Rendered videos with their truth, and runs of ours and of stock on the same frames."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.cameras.methods import Method
from benchmarks.cameras.methods import run as run_method
from benchmarks.cameras.score import TruePhoto, accuracy, read_models
from benchmarks.cameras.worker import INCREMENTAL, OURS, RESULT
from benchmarks.common.photo_sets import PhotoSet
from benchmarks.common.results import Row
from benchmarks.synthetic.scenes import build_scene
from sfm_app.api import reconstruct
from sfm_app.colmap.backend import log_level, show_log
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import Camera, Views
from sfm_app.synthetic.photo_folder import PhotoOptions, Truth, load_truth, save_truth, write_photo_folder

FloatArray = NDArray[np.float64]

RATE = 30.0
"""Frames per second."""


def frame_name(frame: int) -> str:
    """Return the name of a frame of a video that is to be rendered."""
    return f"{frame:06d}.png"


def render_video(name: str, scene: str, views: Views, seed: int, cache: Path) -> tuple[Path, Truth]:
    """Return a video as an MP4 file and the truth of its frames; rendered on first use.

    Args:
        name: of the video.
        scene: of `build_scene`.
        views: its frames, named as by `frame_name`.
        seed: of the noise.
        cache: keeps all videos.
    """
    frames, clip, truth = cache / "frames" / name, cache / "videos" / f"{name}.mp4", cache / "truth" / name
    if not truth.exists():  # written last
        made = write_photo_folder(frames, build_scene(scene), views, PhotoOptions(supersampling=1, seed=seed))
        clip.parent.mkdir(parents=True, exist_ok=True)
        camera = next(iter(views.cameras.values()))
        size = (camera.width, camera.height)
        writer = cv2.VideoWriter(str(clip), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), RATE, size)
        for path in sorted(frames.iterdir()):
            if (pixels := cv2.imread(str(path))) is not None:
                writer.write(pixels)
        writer.release()
        save_truth(made, truth)
    return clip, load_truth(truth)


def run_ours(clip: Path, out: Path, most_frames: int) -> Mapping[str, Any]:
    """Reconstruct a video up to the scene; return the manifest."""
    loud = log_level()
    reconstruct(clip, out, Settings.from_mapping({"photos": {"max_frames": most_frames}}), last="scene")
    show_log(loud)
    manifest: Mapping[str, Any] = json.loads((out / "manifest.json").read_text(encoding="utf-8"))
    return manifest


def run_stock(out: Path, other: Path, cameras: str) -> float:
    """Run stock's incremental mapping on the frames of a run of ours; return its seconds.

    Args:
        out: of ours.
        other: where stock writes.
        cameras: "single" or "each".
    """
    method = Method(f"{INCREMENTAL}, {cameras}", INCREMENTAL)
    run_method(method, PhotoSet(out.parent.name, out / "photos", {}, cameras=cameras), other)
    if not (other / "photos").exists():
        (other / "photos").symlink_to(out / "photos")
    path = other / RESULT
    said = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"seconds": {}}
    return float(sum(said["seconds"].values()))


def _shutter(manifest: Mapping[str, Any]) -> Row:
    """Return what a run says of the shutter."""
    found = manifest["stages"]["scene"]["counts"].get("shutter")
    if found is None:
        return {}
    figures = {"measured ms": found.get("readout_ms"), "deviation ms": found.get("deviation_ms")}
    return figures | {"compensated": found["compensated"], "because": found.get("because", "")}


def score_frames(out: Path, truth: Truth) -> Row:
    """Score the poses and the focal length of every frame; frames are named by their number in the video."""
    numbers = {frame_name(int(Path(name).stem)): name for name in truth.cameras}
    models = read_models(out)
    if not models:
        return {"placed": "0"}
    stems = {path.stem: numbers[f"{path.stem.rsplit('_', 1)[-1]}.png"] for path in sorted((out / "photos").iterdir())}
    true: dict[str, Camera] = {stem: truth.cameras[name] for stem, name in stems.items()}
    poses = {
        stem: TruePhoto(camera.K, truth.cam_from_world[stems[stem]], camera.width) for stem, camera in true.items()
    }
    found = accuracy(models, poses, len(poses))
    errors = [
        100.0 * abs(float(np.sqrt(K[0, 0] * K[1, 1])) / true[stem].K[0, 0] - 1.0) for stem, K in models[0].K.items()
    ]
    return {
        "frames": len(poses), "placed": f"{found['registered']}/{found['of']}", "AUC@1": found["AUC@1"],
        "AUC@5": found["AUC@5"], "focal % median": round(float(np.median(errors)), 2),
        "focal % worst": round(max(errors), 2),
    }  # fmt: skip


def run_both(clip: Path, truth: Truth, folder: Path, most_frames: int, stock: tuple[str, ...]) -> list[Row]:
    """Run ours and stock on a video, and score them.

    Args:
        clip, truth: from `render_video`.
        folder: of the runs.
        most_frames: that ours takes from the video.
        stock: cameras of each run of stock, "single" or "each".
    """
    out = folder / clip.stem / OURS
    manifest = run_ours(clip, out, most_frames)
    seconds = sum(stage["seconds"] for stage in manifest["stages"].values())
    rows: list[Row] = [{"method": OURS, **score_frames(out, truth), **_shutter(manifest), "seconds": round(seconds, 1)}]
    for cameras in stock:
        name = f"{INCREMENTAL}, {cameras}"
        other = folder / clip.stem / name.replace(", ", "-")
        seconds = run_stock(out, other, cameras)
        rows.append({"method": name, **score_frames(other, truth), "seconds": round(seconds, 1)})
    return rows
