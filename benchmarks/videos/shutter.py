"""Rolling shutters of synthetic videos: the measured readout, and the poses with and without it.

    python -m benchmarks.videos.shutter --seeds 5
    python -m benchmarks.videos.shutter --kinds "turn 60" --readouts-ms 20 --seeds 20

Models as mapping leaves them, from noisy keypoints; nothing is rendered.
"""

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.common.command_line import add_seeds, new_parser
from benchmarks.common.metrics import area_under_recall, pose_errors_deg
from benchmarks.common.results import Row, document, table, write
from benchmarks.synthetic.walks import WalkOptions
from benchmarks.videos.sequences import FRAMES_PER_S, SIZE, STRONG_LENS, Kind, draw_sequence, map_sequence
from sfm_app.bundle.rolling_shutter import ReadoutEstimate
from sfm_app.colmap.backend import pycolmap, show_log
from sfm_app.colmap.bundle import Adjustment, adjust
from sfm_app.colmap.model import posed_images
from sfm_app.colmap.readout import measure_readout, read_keypoints, straighten_model
from sfm_app.mapping.rolling_shutter import OPTIONS, Readout, follow_shutter
from sfm_app.progress import Progress
from sfm_app.types import MatchedImage, MatchGraph

ABOUT = (
    "36 frames of 1280 x 720 of a hand-held video of 30 frames per second, a focal of 1000 px, points 2 to 12 m away, "
    "noise 0.4 px, 5 % wrong keypoints. walk: 1.4 m/s with a hand's bobbing and shaking, every 3rd frame; turn N: the "
    "camera also swings from side to side, at most N degrees per second; sparse: every 10th frame. error %: of the "
    "measured readout, rms and worst; z: rms of its error in stated deviations; taken: videos whose readout is taken "
    "and compensated. AUC@1 of all relative poses (medians): with the shutter ignored, measured, and known. The last "
    "kinds have a global shutter and something else that may look like a rolling one."
)
READOUTS_MS = (0.0, 10.0, 20.0, 30.0)
KINDS = {
    "walk": Kind(walk=WalkOptions()),
    "turn 30": Kind(walk=WalkOptions(swing_deg_s=30.0)),
    "turn 60": Kind(walk=WalkOptions(swing_deg_s=60.0)),
    "turn 90": Kind(walk=WalkOptions(swing_deg_s=90.0)),
    "walk, sparse": Kind(walk=WalkOptions(), every=10),
    "turn 60, sparse": Kind(walk=WalkOptions(swing_deg_s=60.0), every=10),
}
MIMICS = {
    "strong lens": Kind(walk=WalkOptions(swing_deg_s=60.0), lens=STRONG_LENS),
    "moving people": Kind(walk=WalkOptions(swing_deg_s=60.0), moving_share=0.15),
    "stabilized lens": Kind(walk=WalkOptions(swing_deg_s=60.0), center_jitter_px=3.0),
    "breathing focal": Kind(walk=WalkOptions(swing_deg_s=60.0), breathing=0.01),
}
"""With a global shutter only."""
COLUMNS = (
    "kind", "readout ms", "videos", "measured ms", "deviation ms", "error % rms", "error % worst", "z", "taken",
    "AUC@1 ignored", "AUC@1 measured", "AUC@1 known", "seconds",
)  # fmt: skip


def measure(name: str, kind: Kind, readout_ms: float, seed: int) -> Row:
    """Adjust one video with the shutter ignored, measured and known, and compare the poses with the truth."""
    sequence = draw_sequence(kind, 1e-3 * readout_ms, seed)
    truth = dict(sequence.drawn.views.cam_from_world)
    with tempfile.TemporaryDirectory() as folder:
        model, database = map_sequence(sequence, seed, Path(folder))
        ignored = adjust(model, database)
        matches = timed_matches(ignored.model, sequence.times_s)
        start = time.perf_counter()
        followed, found = follow_shutter(ignored, matches, database, Progress())
        seconds = time.perf_counter() - start
        known = follow_known(ignored, matches, 1e-3 * readout_ms, database)
    if not isinstance(found, Readout):
        raise RuntimeError("the frames are not recognized as a video")
    row: Row = {
        "method": "follow_shutter", "kind": name, "seed": seed, "readout ms": readout_ms,
        "measured ms": round(1e3 * found.readout, 4), "deviation ms": round(1e3 * found.deviation, 4),
        "taken": int(not found.refused), "because": found.refused, "seconds": round(seconds, 2),
    }  # fmt: skip
    for how, one in (("ignored", ignored), ("measured", followed), ("known", known)):
        poses = {image.name: np.asarray(image.cam_from_world().matrix()) for image in posed_images(one.model)}
        row[f"AUC@1 {how}"] = round(area_under_recall(pose_errors_deg(poses, truth), 1.0), 4)
    return row


def timed_matches(model: pycolmap.Reconstruction, times_s: dict[str, float]) -> MatchGraph:
    """Return a match graph that knows when the photos were taken, and nothing of matches."""
    images = {
        image.image_id: MatchedImage(image.image_id, image.name, "video", *SIZE, time_s=times_s[image.name])
        for image in posed_images(model)
    }
    return MatchGraph(images, {}, {})


def follow_known(adjusted: Adjustment, matches: MatchGraph, readout_s: float, database: Path) -> Adjustment:
    """Compensate a known readout."""
    keypoints = read_keypoints(adjusted.model)
    estimate: ReadoutEstimate | None = None
    times = {key: float(image.time_s or 0.0) for key, image in matches.images.items()}
    for _ in range(OPTIONS.rounds - 1):
        estimate = measure_readout(adjusted, keypoints, times, estimate, known=readout_s)
        adjusted = adjust(straighten_model(adjusted.model, estimate, keypoints), database)
    return adjusted


def summarize(rows: Sequence[Row]) -> Iterator[Row]:
    """Yield a row for each kind and readout."""
    for kind, readout in dict.fromkeys((row["kind"], row["readout ms"]) for row in rows):
        own = [row for row in rows if (row["kind"], row["readout ms"]) == (kind, readout)]
        found, deviation = (np.array([row[key] for row in own]) for key in ("measured ms", "deviation ms"))
        errors = 100.0 * (found / readout - 1.0) if readout else None
        yield {
            "kind": kind, "readout ms": readout, "videos": len(own), "measured ms": float(np.median(found)),
            "deviation ms": float(np.median(deviation)),
            "error % rms": None if errors is None else float(np.sqrt(np.mean(errors**2))),
            "error % worst": None if errors is None else float(np.abs(errors).max()),
            "z": float(np.sqrt(np.mean(((found - readout) / deviation) ** 2))),
            "taken": f"{sum(row['taken'] for row in own)}/{len(own)}",
            "seconds": float(np.median([row["seconds"] for row in own])),
        } | {key: float(np.median([row[key] for row in own])) for key in COLUMNS if key.startswith("AUC")}  # fmt: skip


def parser() -> argparse.ArgumentParser:
    """Give the command line."""
    parser = new_parser("videos.shutter", __doc__)
    add_seeds(parser, 5, "videos-shutter")
    parser.add_argument("--kinds", nargs="+", default=[*KINDS, *MIMICS], choices=[*KINDS, *MIMICS])
    parser.add_argument("--readouts-ms", nargs="+", type=float, default=list(READOUTS_MS))
    return parser


def main() -> None:
    """Run all videos and publish."""
    args = parser().parse_args()
    show_log(0)
    rows: list[Row] = []
    for name in args.kinds:
        for readout_ms in (0.0,) if name in MIMICS else args.readouts_ms:
            for seed in range(args.first_seed, args.first_seed + args.seeds):
                rows.append(measure(name, (KINDS | MIMICS)[name], readout_ms, seed))
                print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    page = f"# Rolling shutters\n\n{ABOUT}\n\n{table(list(summarize(rows)), COLUMNS)}"
    options = {"seeds": args.seeds, "first seed": args.first_seed, "kinds": args.kinds, "readouts": args.readouts_ms}
    write(
        args.results,
        args.name,
        document("videos.shutter", ABOUT, options | {"frames per s": FRAMES_PER_S}, {}, rows),
        page,
    )
    print(page)


if __name__ == "__main__":
    main()
