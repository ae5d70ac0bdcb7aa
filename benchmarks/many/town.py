"""Photos of a walk through a rendered town, from photos to textured mesh: cost per photo, loops and folds.

    python -m benchmarks.many.town --cache CACHE
    python -m benchmarks.many.town --cache CACHE --counts 60 --megapixels 0.8 --until scene

The first photos of the walk are taken for the smaller counts. A run that is stopped goes on with the same command.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.common.command_line import new_parser
from benchmarks.common.photo_sets import link_or_copy
from benchmarks.common.processes import module_command, run_command
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.many.blocks import WORKERS, camera_size
from benchmarks.many.parts import FOLDED_M, pose_errors
from benchmarks.synthetic.town import TownPhotos, town_of, town_views
from sfm_app.colmap.backend import Reconstruction
from sfm_app.colmap.model import poses_and_points
from sfm_app.pipeline import NAMES
from sfm_app.settings import QUALITY_PRESETS
from sfm_app.synthetic.cameras import Camera, Views, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder

ABOUT = (
    "`sfm-app run` on the first photos of a walk through a rendered town, as a user types it, with two workers. "
    "Centers: distances in meters after the best similarity, median, 90 % and worst; folded: photos that are more than "
    f"{FOLDED_M:g} m off. CPU of a stage: seconds of all processes per photo. MB: most memory of any stage "
    "with its processes."
)
STAGES = NAMES[: NAMES.index("texture") + 1]
COLUMNS = ("photos", "of pairs", "placed", "models", "parts", "focal %", "center m", "90 %", "worst", "folded",
           *(f"CPU {name}" for name in STAGES), "CPU per photo", "minutes", "MB", "failed")  # fmt: skip


def render(views: Views, options: TownPhotos, folder: Path) -> None:
    """Render the photos that are missing."""
    if any(not (folder / name).exists() for name in views.cam_from_world):
        write_photo_folder(folder, town_of(options), views, PhotoOptions(supersampling=1), processes=WORKERS)


def measure(count: int, rendered: Path, camera: Camera, views: Views, args: argparse.Namespace) -> Row:
    """Run the program on the first photos, and compare with the truth.

    Args:
        count: of the photos.
        rendered: folder with the photos.
        camera: that took them.
        views: with the true poses.
        args: cache and options of the run.
    """
    place = args.cache / f"{rendered.name}-{count}"
    photos, out = place / "photos", place / "model"
    photos.mkdir(parents=True, exist_ok=True)
    names = list(views.cam_from_world)[:count]
    for name in names:
        link_or_copy(rendered / name, photos)
    code, last = run_command(
        module_command(
            "sfm_app", "run", str(photos), "-o", str(out), "--until", args.until, "--quality", args.quality,
            "--max-memory", str(args.max_memory), "--workers", str(WORKERS),
        )
    )  # fmt: skip
    row: Row = {"method": "sfm-app", "photos": count}
    if code != 0:
        return row | {"failed": last}
    stages = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]
    return row | scene_figures(stages, out, camera, views, names) | cost_figures(stages, count)


def scene_figures(stages: dict[str, Any], out: Path, camera: Camera, views: Views, names: Sequence[str]) -> Row:
    """Return pairs, photos placed, and errors of cameras and poses."""
    scene = stages["scene"]["counts"]
    model = Reconstruction(out / "sparse")
    found = {model.images[key].name: pose for key, pose in poses_and_points(model)[0].items()}
    errors = pose_errors(found, views.cam_from_world, rig=False)
    pairs = len(names) * (len(names) - 1) / 2
    cameras = stages["intrinsics"]["counts"]["cameras"].values()
    parts = [len(group["parts"]) for group in scene.get("parts", [])]
    return {
        "of pairs": stages["match_graph"]["counts"].get("matched_pairs", pairs) / pairs,
        "placed": scene["registered"],
        "models": 1 + len(scene["other_models"]),
        "parts": sum(parts),
        "focal %": max(100.0 * abs(one["fx"] / camera.K[0, 0] - 1.0) for one in cameras),
        **errors,
    }


def cost_figures(stages: dict[str, Any], count: int) -> Row:
    """Return CPU seconds per photo of every stage, and minutes and memory of all."""
    spent = {name: stage["cpu_seconds"] / count for name, stage in stages.items()}
    return {f"CPU {name}": seconds for name, seconds in spent.items()} | {
        "CPU per photo": sum(spent.values()),
        "minutes": sum(stage["seconds"] for stage in stages.values()) / 60.0,
        "MB": max(stage["peak_mb"] for stage in stages.values()),
    }


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("many.town", __doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[250, 1000])
    parser.add_argument("--walk", type=int, help="photos of the whole walk, as the town is as large; default: the most")
    parser.add_argument("--step", type=float, default=TownPhotos().step_m, help="meters between two photos")
    parser.add_argument("--seed", type=int, default=0, help="of the town and the walk")
    parser.add_argument("--megapixels", type=float, default=3.0)
    parser.add_argument("--quality", default="draft", choices=tuple(QUALITY_PRESETS))
    parser.add_argument("--until", default="texture", choices=STAGES[STAGES.index("scene") :])
    parser.add_argument("--max-memory", type=float, default=12, help="GB")
    parser.add_argument("--cache", type=Path, required=True, help="keeps the rendered photos and the runs")
    parser.add_argument("--results", type=Path, default=RESULTS)
    return parser


def main() -> None:
    """Measure every number of photos, and write the results count by count."""
    args = parser().parse_args()
    walk = args.walk or max(args.counts)
    camera = make_camera(*camera_size(args.megapixels), focal_widths=0.9)
    options = TownPhotos(photos=walk, step_m=args.step, seed=args.seed)
    rendered = args.cache / f"town-{walk}-{args.step:g}-{args.seed}-{camera.width}"
    rows: list[Row] = []
    for count in args.counts:
        views = town_views(camera, options, count)
        render(views, options, rendered)
        rows.append(measure(count, rendered, camera, views, args))
        page = f"# Photos of a town\n\n{ABOUT}\n\n{table(rows, COLUMNS)}"
        about = {"megapixels": args.megapixels, "quality": args.quality, "walk": walk, "step": args.step}
        write(args.results, "many-town", document("many", ABOUT, about, {}, rows), page)
        print(table(rows[-1:], COLUMNS), flush=True)


if __name__ == "__main__":
    main()
