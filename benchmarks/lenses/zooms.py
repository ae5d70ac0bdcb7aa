"""Videos in which the camera zooms: is the focal length of every frame followed?

    python -m benchmarks.lenses.zooms --cache CACHE

Rendered walks with a smooth zoom in the middle, as MP4 files. Stock has the same frames, as photos of one camera and
with a camera for each.
"""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.cameras.methods import Method
from benchmarks.cameras.methods import run as run_method
from benchmarks.cameras.score import TruePhoto, accuracy, read_models
from benchmarks.cameras.worker import INCREMENTAL, OURS, RESULT
from benchmarks.common.command_line import new_parser
from benchmarks.common.photo_sets import PhotoSet
from benchmarks.common.results import RESULTS, Row, document, table, write
from sfm_app.api import reconstruct
from sfm_app.colmap.backend import log_level, show_log
from sfm_app.geometry.camera import camera_matrix
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import Camera, Views, look_at
from sfm_app.synthetic.photo_folder import PhotoOptions, Truth, load_truth, save_truth, write_photo_folder
from sfm_app.synthetic.scenes.scene_catalog import build_scene

FloatArray = NDArray[np.float64]

SCENES = ("courtyard", "facade")
SIZE, CENTER, FRAMES, RATE = (640, 426), (328.0, 208.0), 90, 30.0
FOCAL_PX, ZOOM, DURING = 620.0, 1.6, (0.33, 0.67)
"""First focal length, by how much it grows, and the part of the video in which it does."""
MOST_FRAMES = 30
COLUMNS = ("scene", "method", "frames", "placed", "AUC@1", "AUC@5", "focal % median", "focal % worst", "seconds")
ABOUT = (
    f"Rendered videos of {FRAMES} frames of {SIZE[0]} x {SIZE[1]}, a hand-held walk in which the focal length grows by "
    f"a factor of {ZOOM}; at most {MOST_FRAMES} frames are used. focal %: error of the focal length of a frame after "
    "bundle adjustment. Stock is pycolmap's incremental mapper on the same frames, with one camera for all and with a "
    "camera for each."
)


def zoom_views(scene: str, seed: int) -> Views:
    """Return the frames of a walk with a zoom.

    Args:
        scene: one of `SCENES`.
        seed: same seed, same walk.
    """
    rng, along = np.random.default_rng(seed), np.linspace(0.0, 1.0, FRAMES)
    zoomed = np.clip((along - DURING[0]) / (DURING[1] - DURING[0]), 0.0, 1.0)
    focals = FOCAL_PX * np.exp(np.log(ZOOM) * zoomed)

    def waver(low: float, high: float) -> FloatArray:
        """Return a smooth random curve (FRAMES,) between two values."""
        phases, sizes = rng.uniform(0.0, 2.0 * np.pi, 3), rng.uniform(0.4, 1.0, 3)
        turns = np.arange(1.0, 4.0)
        curve = np.sin(1.8 * np.pi * along[:, None] * turns + phases) @ (sizes / turns)
        return np.asarray(low + (high - low) * (curve - curve.min()) / np.ptp(curve), np.float64)

    if scene == "facade":
        x = np.linspace(-4.0, 4.0, FRAMES)
        centers = np.column_stack([x, waver(1.2, 2.2), waver(5.0, 7.0)])
        aims = np.column_stack([x * waver(0.3, 0.9), waver(2.0, 3.2), np.zeros(FRAMES)])
    else:
        azimuth, distance = np.radians(np.linspace(-40.0, 40.0, FRAMES)), waver(4.4, 6.2)
        centers = np.column_stack([distance * np.sin(azimuth), waver(0.9, 2.4), distance * np.cos(azimuth)])
        aims = np.column_stack([waver(-0.5, 0.5), waver(1.0, 1.6), waver(-0.5, 0.1)])
    rolls = waver(-6.0, 6.0)
    names = [f"{frame:06d}.png" for frame in range(FRAMES)]
    cameras = {
        name: Camera(camera_matrix(focal, focal, *CENTER), *SIZE) for name, focal in zip(names, focals, strict=True)
    }
    poses = (look_at(c, a, float(roll)) for c, a, roll in zip(centers, aims, rolls, strict=True))
    return Views(cameras, dict(zip(names, poses, strict=True)))


def render_video(scene: str, seed: int, cache: Path) -> tuple[Path, Truth]:
    """Return the video of a scene and the truth of its frames; rendered on first use."""
    name = f"zoom-{scene}-{seed}"
    frames, clip, truth = cache / "frames" / name, cache / "videos" / f"{name}.mp4", cache / "truth" / name
    if not truth.exists():  # written last
        options = PhotoOptions(supersampling=1, seed=seed)
        made = write_photo_folder(frames, build_scene(scene), zoom_views(scene, seed), options)
        clip.parent.mkdir(parents=True, exist_ok=True)
        writer = cv2.VideoWriter(str(clip), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"mp4v"), RATE, SIZE)
        for path in sorted(frames.iterdir()):
            if (pixels := cv2.imread(str(path))) is not None:
                writer.write(pixels)
        writer.release()
        save_truth(made, truth)
    return clip, load_truth(truth)


def score(out: Path, truth: Truth) -> Row:
    """Score the poses and the focal length of every frame; frames are named by their number in the video."""
    numbers = {f"{int(Path(name).stem):06d}": name for name in truth.cameras}
    models = read_models(out)
    if not models:
        return {"placed": "0"}
    stems = {stem: stem.rsplit("_", 1)[-1] for stem in sorted(path.stem for path in (out / "photos").iterdir())}
    true = {stem: truth.cameras[numbers[number]] for stem, number in stems.items()}
    poses = {
        stem: TruePhoto(camera.K, truth.cam_from_world[numbers[stems[stem]]], camera.width)
        for stem, camera in true.items()
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


def run_scene(scene: str, seed: int, args: argparse.Namespace) -> list[Row]:
    """Run ours and stock on one video."""
    clip, truth = render_video(scene, seed, args.cache)
    out = args.cache / "zooms" / clip.stem / OURS
    loud = log_level()
    reconstruct(clip, out, Settings.from_mapping({"photos": {"max_frames": MOST_FRAMES}}), last="scene")
    show_log(loud)
    seconds = sum(stage["seconds"] for stage in json.loads((out / "manifest.json").read_text())["stages"].values())
    rows = [{"scene": scene, "method": OURS, **score(out, truth), "seconds": round(seconds, 1)}]
    for cameras in () if args.ours_only else ("single", "each"):
        method = Method(f"{INCREMENTAL}, {cameras}", INCREMENTAL)
        other = args.cache / "zooms" / clip.stem / method.name.replace(", ", "-")
        run_method(method, PhotoSet(clip.stem, out / "photos", {}, cameras=cameras), other)
        rows.append({"scene": scene, "method": method.name, **_score_stock(other, out, truth)})
    for row in rows:
        print(json.dumps(row), file=sys.stderr, flush=True)
    return rows


def _score_stock(other: Path, ours: Path, truth: Truth) -> Mapping[str, object]:
    """Score a stock run, which has the frames of ours."""
    if not (other / "photos").exists():
        (other / "photos").symlink_to(ours / "photos")
    path = other / RESULT
    said = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {"seconds": {}}
    return {**score(other, truth), "seconds": round(sum(said["seconds"].values()), 1)}


def main() -> None:
    """Run all videos, and publish after each."""
    parser = new_parser("lenses.zooms", __doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keeps rendered videos and runs")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ours-only", action="store_true", help="leave out stock")
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args()
    rows: list[Row] = []
    for scene in args.scenes:
        rows += run_scene(scene, args.seed, args)
        page = f"# Zooms\n\n{ABOUT}\n\n{table([dict(row) for row in rows], COLUMNS)}"
        options = {"scenes": args.scenes, "seed": args.seed}
        write(args.results, "lenses-zooms", document("lenses.zooms", ABOUT, options, {}, rows), page)
    print(page)


if __name__ == "__main__":
    main()
