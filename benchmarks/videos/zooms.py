"""Videos in which the camera zooms: is the focal length of every frame followed?

    python -m benchmarks.videos.zooms --cache CACHE

Rendered walks with a smooth zoom in the middle, as MP4 files. Stock has the same frames, as photos of one camera and
with a camera for each.
"""

import argparse
import json
import sys

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.command_line import add_rendered, new_parser
from benchmarks.common.results import Row, document, table, write
from benchmarks.videos.rendered import frame_name, render_video, run_both
from sfm_app.camera.models import camera_matrix
from sfm_app.synthetic.cameras import Camera, Views, look_at

FloatArray = NDArray[np.float64]

SCENES = ("courtyard", "facade")
SIZE, CENTER, FRAMES = (640, 426), (328.0, 208.0), 90
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
    names = [frame_name(frame) for frame in range(FRAMES)]
    cameras = {
        name: Camera(camera_matrix(focal, focal, *CENTER), *SIZE) for name, focal in zip(names, focals, strict=True)
    }
    poses = (look_at(c, a, float(roll)) for c, a, roll in zip(centers, aims, rolls, strict=True))
    return Views(cameras, dict(zip(names, poses, strict=True)))


def run_scene(scene: str, seed: int, args: argparse.Namespace) -> list[Row]:
    """Run ours and stock on one video."""
    clip, truth = render_video(f"zoom-{scene}-{seed}", scene, zoom_views(scene, seed), seed, args.cache)
    stock = () if args.ours_only else ("single", "each")
    rows = [{"scene": scene, **row} for row in run_both(clip, truth, args.cache / "zooms", MOST_FRAMES, stock)]
    for row in rows:
        print(json.dumps(row), file=sys.stderr, flush=True)
    return rows


def main() -> None:
    """Run all videos, and publish after each."""
    parser = new_parser("videos.zooms", __doc__)
    add_rendered(parser, SCENES)
    args = parser.parse_args()
    rows: list[Row] = []
    for scene in args.scenes:
        rows += run_scene(scene, args.seed, args)
        page = f"# Zooms\n\n{ABOUT}\n\n{table([dict(row) for row in rows], COLUMNS)}"
        options = {"scenes": args.scenes, "seed": args.seed}
        write(args.results, "videos-zooms", document("videos.zooms", ABOUT, options, {}, rows), page)
    print(page)


if __name__ == "__main__":
    main()
