"""Rendered videos with a rolling shutter, from the MP4 file to the poses.

    python -m benchmarks.videos --cache CACHE

The same walks are rendered with a global shutter too: what a known shutter could give at best. Stock has the same
frames, as photos of one camera.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.common.command_line import add_rendered, new_parser
from benchmarks.common.results import Row, document, table, write
from benchmarks.synthetic.walks import WalkOptions, row_poses, walk
from benchmarks.videos.rendered import RATE, frame_name, render_video, run_both
from sfm_app.camera.models import camera_matrix
from sfm_app.synthetic.cameras import Camera, Views

CAMERA = Camera(camera_matrix(620.0, 620.0, 328.0, 208.0), 640, 426)
FRAMES, MOST_FRAMES = 90, 30
READOUTS_MS = (0.0, 10.0, 20.0, 30.0)
WALKS = {
    "facade": WalkOptions(start=(-2.5, 1.6, 6.0), shake=1.0, swing_deg_s=30.0),
    "courtyard": WalkOptions(start=(-2.2, 1.4, 5.6), shake=1.0, swing_deg_s=15.0, swing_period_s=3.0),
}
"""By scene: 1.4 m/s past it, with a hand's bobbing and shaking, while the camera swings from side to side."""
COLUMNS = (
    "scene", "readout ms", "method", "frames", "placed", "measured ms", "deviation ms", "compensated", "AUC@1", "AUC@5",
    "focal % median", "seconds",
)  # fmt: skip
ABOUT = (
    f"Rendered videos of {FRAMES} frames of {CAMERA.width} x {CAMERA.height} at {RATE:.0f} per second, a walk at "
    f"1.4 m/s with the camera in the hand; at most {MOST_FRAMES} frames are used. True poses are those of the middle "
    "rows. measured ms: the readout that the program finds in the MP4 file, with its deviation; compensated: whether "
    "it takes it for one. Stock is pycolmap's incremental mapper on the same frames, with one camera."
)


def shutter_views(scene: str, readout_ms: float, seed: int) -> Views:
    """Return the frames of a walk, each row with a pose of its own.

    Args:
        scene: one of `WALKS`.
        readout_ms: of the shutter; 0 for a global one.
        seed: same seed, same walk.
    """
    path = walk(replace(WALKS[scene], seconds=(FRAMES - 1) / RATE), seed)
    times = np.arange(FRAMES) / RATE
    names = [frame_name(frame) for frame in range(FRAMES)]
    rows = {
        name: row_poses(path, float(time), 1e-3 * readout_ms, CAMERA.height)
        for name, time in zip(names, times, strict=True)
    }
    poses = dict(zip(names, path.poses(times), strict=True))
    return Views(dict.fromkeys(names, CAMERA), poses, rows if readout_ms else {})


def run_video(scene: str, readout_ms: float, seed: int, args: argparse.Namespace) -> Iterator[Row]:
    """Run ours and stock on one video."""
    name = f"shutter-{scene}-{readout_ms:g}-{seed}"
    clip, truth = render_video(name, scene, shutter_views(scene, readout_ms, seed), seed, args.cache)
    stock = () if args.ours_only else ("single",)
    for row in run_both(clip, truth, args.cache / "shutters", MOST_FRAMES, stock):
        yield {"scene": scene, "readout ms": readout_ms, **row}


def main() -> None:
    """Run all videos, and publish after each."""
    parser = new_parser("videos", __doc__)
    add_rendered(parser, list(WALKS))
    parser.add_argument("--readouts-ms", nargs="+", type=float, default=list(READOUTS_MS))
    args = parser.parse_args()
    rows: list[Row] = []
    for scene in args.scenes:
        for readout_ms in args.readouts_ms:
            for row in run_video(scene, readout_ms, args.seed, args):
                rows.append(row)
                print(json.dumps(row), file=sys.stderr, flush=True)
            page = f"# Rolling shutters, rendered\n\n{ABOUT}\n\n{table(rows, COLUMNS)}"
            options = {"scenes": args.scenes, "readouts": args.readouts_ms, "seed": args.seed}
            write(args.results, "videos", document("videos", ABOUT, options, {}, rows), page)
    print(page)


if __name__ == "__main__":
    main()
