"""A walk with a 360 degree camera: poses, and the finished model.

    python -m benchmarks.lenses.panoramas --cache CACHE

Panoramas of a rendered court, without metadata: the program has to see for itself what they are.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.cameras.methods import Method
from benchmarks.cameras.methods import run as run_method
from benchmarks.cameras.score import TruePhoto, accuracy, read_models
from benchmarks.cameras.worker import INCREMENTAL, OURS, RESULT
from benchmarks.common.command_line import new_parser
from benchmarks.common.photo_sets import PhotoSet
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.surface.photos import placed_photos
from benchmarks.synthetic.scenes import build_scene
from sfm_app.api import reconstruct
from sfm_app.colmap.backend import log_level, show_log
from sfm_app.products import read_texture
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import Views, look_at, panorama_camera
from sfm_app.synthetic.compare import surface_errors
from sfm_app.synthetic.photo_folder import PhotoOptions, Truth, load_truth, save_truth, write_photo_folder

SCENES = ("courtyard", "facade")
PHOTOS, WIDTH = 20, 1600
LENGTH, DEPTH, EYE, SWAY = 6.4, (2.4, 4.2), 1.65, 0.04
"""Of the walk, in scene units: along x, range of z, height of the camera, and how much it sways."""
TILT_DEG = 3.0
COLUMNS = ("scene", "method", "placed", "AUC@1", "AUC@5", "triangles", "surface %", "coverage %", "seconds")
ABOUT = (
    f"{PHOTOS} rendered panoramas of {WIDTH} x {WIDTH // 2} along a walk of {LENGTH} units, turned any way, upright to "
    f"{TILT_DEG:g} degrees. Stock is pycolmap's incremental mapper with one camera for all photos: by default, and "
    "told the model EQUIRECTANGULAR. surface %: share of the mesh within 0.5 % of the scene's size of the truth; "
    "coverage %: share of what the panoramas see within 1 % of the mesh. seconds: to the sparse model."
)


def walk(photos: int = PHOTOS, width: int = WIDTH, seed: int = 0) -> Views:
    """Return panoramas along a winding path.

    Args:
        photos: >= 2.
        width: of a panorama in pixels.
        seed: same seed, same walk.
    """
    rng = np.random.default_rng(seed)
    along = np.linspace(0.0, 1.0, photos)
    low, high = DEPTH
    z = low + (high - low) * 0.5 * (1.0 + np.sin(2.0 * np.pi * along + rng.uniform(0.0, 2.0 * np.pi)))
    centers = np.column_stack([LENGTH * (along - 0.5), np.full(photos, EYE), z])
    centers += rng.normal(scale=SWAY, size=(photos, 3))
    heading = np.cumsum(rng.normal(scale=0.6, size=photos))
    tilt = np.radians(rng.uniform(-TILT_DEG, TILT_DEG, (photos, 2)))
    ways = np.column_stack([np.sin(heading), np.tan(tilt[:, 0]), -np.cos(heading)])
    poses = [
        look_at(center, center + way, float(np.degrees(roll)))
        for center, way, roll in zip(centers, ways, tilt[:, 1], strict=True)
    ]
    return Views.from_poses(panorama_camera(width), poses)


def render_walk(scene: str, cache: Path) -> tuple[Path, Truth]:
    """Return the panoramas of a scene and their truth; rendered on first use."""
    photos, truth = cache / "photos" / f"{scene}-walk", cache / "truth" / f"{scene}-walk"
    if not truth.exists():  # written last
        save_truth(write_photo_folder(photos, build_scene(scene), walk(), PhotoOptions()), truth)
    return photos, load_truth(truth)


def surface_row(photos: Path, out: Path, truth: Truth) -> Row:
    """Finish the model of a run, and compare its surface with the truth."""
    loud = log_level()
    reconstruct(photos, out, Settings())
    show_log(loud)
    surface = read_texture(Workspace(out)).surface
    centers = {name: np.asarray(image.projection_center()) for name, image in placed_photos(out).items()}
    to_truth, to_mesh = surface_errors(surface.vertices, surface.faces, centers, truth)
    return {
        "triangles": len(surface.faces),
        "surface %": round(100.0 * float(np.mean(to_truth <= 0.005)), 1),
        "coverage %": round(100.0 * float(np.mean(to_mesh <= 0.01)), 1),
    }


def run_scene(scene: str, args: argparse.Namespace) -> list[Row]:
    """Run ours and stock on one walk."""
    photos, truth = render_walk(scene, args.cache)
    poses = {
        Path(name).stem: TruePhoto(camera.K, truth.cam_from_world[name], camera.width)
        for name, camera in truth.cameras.items()
    }
    told = {"camera_model": "EQUIRECTANGULAR", "camera_params": f"{WIDTH},{WIDTH // 2}"}
    methods = [Method(OURS), Method(INCREMENTAL, INCREMENTAL), Method(f"{INCREMENTAL}, told", INCREMENTAL, told)]
    rows = []
    for method in methods[: 1 if args.ours_only else None]:
        out = args.cache / "walks" / f"{scene}-{method.name.replace(', ', '-')}"
        if not (args.keep and (out / RESULT).exists()):
            run_method(method, PhotoSet(photos.name, photos, {}, cameras="auto"), out)
        said = json.loads((out / RESULT).read_text(encoding="utf-8")) if (out / RESULT).exists() else {"seconds": {}}
        found = accuracy(read_models(out), poses, len(poses))
        rows.append({
            "scene": scene, "method": method.name, "placed": f"{found['registered']}/{found['of']}",
            "AUC@1": found["AUC@1"], "AUC@5": found["AUC@5"], "seconds": round(sum(said["seconds"].values()), 1),
            **(surface_row(photos, out, truth) if method.name == OURS else {}),
        })  # fmt: skip
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return rows


def page(rows: Sequence[Row]) -> str:
    """Return the table."""
    return f"# Walks with panoramas\n\n{ABOUT}\n\n{table([dict(row) for row in rows], COLUMNS)}"


def main() -> None:
    """Run all walks, and publish after each."""
    parser = new_parser("lenses.panoramas", __doc__)
    parser.add_argument("--cache", type=Path, required=True, help="keeps rendered panoramas and runs")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES))
    parser.add_argument("--ours-only", action="store_true", help="leave out stock")
    parser.add_argument("--keep", action="store_true", help="do not run again what was run")
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args()
    rows: list[Row] = []
    for scene in args.scenes:
        rows += run_scene(scene, args)
        options = {"scenes": args.scenes}
        write(args.results, "lenses-panoramas", document("lenses.panoramas", ABOUT, options, {}, rows), page(rows))
    print(page(rows))


if __name__ == "__main__":
    main()
