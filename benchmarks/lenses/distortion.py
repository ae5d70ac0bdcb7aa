"""Focal lengths from pairs through barrel and pincushion lenses, before bundle adjustment.

    python -m benchmarks.lenses.distortion --seeds 20

Synthetic matches of 12 photos of one camera through a perspective lens with k1, k2, p1 and p2: half a pixel of noise, a
fifth of the matches wrong, random focal lengths and centers. Every pair goes through the stages of a run.
"""

import json
import sys
import tempfile
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.common.command_line import new_parser
from benchmarks.common.results import RESULTS, Row, document, table, write
from sfm_app.camera.models import camera_matrix
from sfm_app.estimation.calibrating import find_intrinsics
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages import view_graph
from sfm_app.synthetic.cameras import Lens
from sfm_app.types import Calibration, MatchedImage, MatchGraph

FloatArray = NDArray[np.float64]

SIZE = (1200, 900)
PHOTOS, POINTS, NOISE_PX, WRONG = 12, 900, 0.5, 0.2
TERMS = (-0.35, -0.2, -0.1, 0.0, 0.1, 0.2)
COLUMNS = ("k1", "k2", "p1", "p2", "seeds", "known", "median %", "90 % of seeds below %", "worst %", "worst in sd")
ABOUT = (
    "12 photos of 1200 x 900, fields of view of 45 to 75 degrees, 0.5 px of noise, a fifth of the matches wrong. Error "
    "of the focal length in percent before bundle adjustment, of the cameras that are called known, and in stated "
    "standard deviations. k2 is -0.3 k1^2 where it is not 0; p1 and p2 are 0.0008 and -0.0005 where they are not."
)


def photograph(lens: Lens, seed: int) -> tuple[MatchGraph, FloatArray]:
    """Return the matches of photos around a scene, and K (3, 3)."""
    rng = np.random.default_rng([seed, 20])
    focal = 0.5 * SIZE[0] / np.tan(np.radians(rng.uniform(45.0, 75.0) / 2.0))
    K = camera_matrix(focal, focal, *(np.array(SIZE) / 2 + rng.normal(0.0, 6.0, 2)))
    X = rng.uniform(-1.0, 1.0, (POINTS, 3)) * [2.2, 1.6, 1.2]
    images, keypoints, seen = {}, {}, {}
    for photo in range(1, PHOTOS + 1):
        turn = Rotation.from_euler(
            "yxz", [rng.uniform(-35, 35), rng.uniform(-15, 15), rng.uniform(-8, 8)], degrees=True
        )
        away = np.array([*rng.normal(0.0, 0.15, 2), rng.uniform(1.0, 1.5) * 2.2 * focal / (0.5 * SIZE[0])])
        rays = turn.apply(X) + away
        x = lens.project(rays) * np.diag(K)[:2] + K[:2, 2] + rng.normal(0.0, NOISE_PX, (POINTS, 2))
        keypoints[photo] = x
        seen[photo] = ((x > 0) & (x < SIZE)).all(axis=1)
        images[photo] = MatchedImage(photo, f"{photo:02d}.jpg", "1200x900", *SIZE)
    matches = {}
    for pair in combinations(images, 2):
        rows = np.repeat(np.flatnonzero(seen[pair[0]] & seen[pair[1]])[:, None], 2, axis=1).astype(np.uint32)
        bad = rng.random(len(rows)) < WRONG
        rows[bad, 1] = rng.permutation(rows[bad, 1])
        matches[pair] = rows
    return MatchGraph(images, keypoints, matches), K


def calibrate(matches: MatchGraph, seed: int) -> Calibration:
    """Return the camera that a run finds before it maps the photos."""
    with tempfile.TemporaryDirectory() as folder, make_executor(1) as executor:
        run = RunContext(Settings(seed=seed), Workspace(Path(folder)), load_plugins(), executor, 1, fingerprint="one")
        views = view_graph.make(matches, run)
        return find_intrinsics(matches, views, run).main


def measure(k1: float, *, more: bool, seeds: int) -> Row:
    """Return the errors of one lens over many seeds."""
    lens = Lens(radial=(k1, -0.3 * k1 * k1), tangential=(0.0008, -0.0005)) if more else Lens(radial=(k1,))
    errors, spreads, known = [], [], 0
    for seed in range(seeds):
        matches, K = photograph(lens, seed)
        found = calibrate(matches, seed)
        if found.identifiable:
            known += 1
            errors.append(100.0 * abs(found.focal_px / K[0, 0] - 1.0))
            spreads.append(errors[-1] / max(100.0 * found.spread.get("fx", 0.0) / K[0, 0], 1e-9))
    worst = errors or [float("nan")]
    k2, (p1, p2) = (lens.radial[1] if more else 0.0), lens.tangential
    return {
        "k1": k1, "k2": round(k2, 4), "p1": p1, "p2": p2,
        "seeds": seeds, "known": f"{known}/{seeds}", "median %": round(float(np.median(worst)), 3),
        "90 % of seeds below %": round(float(np.quantile(worst, 0.9)), 3), "worst %": round(float(np.max(worst)), 3),
        "worst in sd": round(float(np.max(spreads or [np.nan])), 1),
    }  # fmt: skip


def page(rows: Sequence[Row]) -> str:
    """Return the table."""
    return (
        f"# Barrel and pincushion lenses before adjustment\n\n{ABOUT}\n\n{table([dict(row) for row in rows], COLUMNS)}"
    )


def main() -> None:
    """Measure all lenses, and publish after each."""
    parser = new_parser("lenses.distortion", __doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args()
    rows: list[Row] = []
    for k1 in TERMS:
        for more in (False, True):
            rows.append(measure(k1, more=more, seeds=args.seeds))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
            found = document("lenses.distortion", ABOUT, {"seeds": args.seeds}, {}, rows)
            write(args.results, "lenses-distortion", found, page(rows))
    print(page(rows))


if __name__ == "__main__":
    main()
