"""Photos that come later: cost and accuracy of adding 20 to a finished run of 100, beside a run of all 120.

    python -m benchmarks.many.later --cache CACHE
    python -m benchmarks.many.later --cache CACHE DATA
    python -m benchmarks.many.later --cache CACHE --until depth_maps --sets statue

The rendered statue, and with DATA kitchen1000, every 8th photo. Every sixth photo comes later.
"""

import argparse
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.cameras.score import model_auc, read_models, true_photos
from benchmarks.common.command_line import new_parser
from benchmarks.common.metrics import Pose
from benchmarks.common.photo_sets import link_or_copy
from benchmarks.common.processes import module_command, run_command
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.corpus.score import offset_figures
from sfm_app.pipeline import NAMES
from sfm_app.synthetic.cameras import make_camera
from sfm_app.synthetic.photo_folder import save_truth, write_photo_folder
from sfm_app.synthetic.scenes import statue, statue_views

PHOTOS, STEP, KITCHEN_STEP, SIZE = 120, 6, 8, (360, 480)
STATUE, KITCHEN = "statue", "kitchen1000"
FIRST, GROWN, FRESH = "100 photos", "20 more", "all 120 afresh"
ABOUT = (
    "`sfm-app run` on 100 photos, again after 20 more have been put into the folder, and on all 120 in a new output "
    "folder. CPU seconds of every stage, as in the manifest, with one worker. statue: rendered, 360 x 480 pixels, "
    "AUC@5. kitchen1000: every 8th photo of a video, 640 x 480, against a camera fixed beside it."
)


@dataclass(frozen=True)
class LaterSet:
    """Photos with their truth, some of which come later."""

    name: str
    photos: Sequence[Path]
    truth: Path

    def is_later(self, number: int) -> bool:
        """Return whether the photo of this number is added to the finished run."""
        return number % STEP == STEP // 2

    def fill(self, folder: Path, *, later: bool) -> None:
        """Put the first photos into a folder, or those that come later, too."""
        folder.mkdir(parents=True, exist_ok=True)
        for number, path in enumerate(self.photos):
            if later or not self.is_later(number):
                link_or_copy(path, folder)


def rendered_statue(cache: Path) -> LaterSet:
    """Return the photos of the statue, which are rendered once."""
    place = cache / "later" / STATUE
    if not place.exists():
        beside = place.with_name("rendering")
        views = statue_views(make_camera(*SIZE, focal_widths=1.35), photos=PHOTOS)
        save_truth(write_photo_folder(beside / "photos", statue(), views), beside)
        beside.rename(place)
    return LaterSet(STATUE, sorted((place / "photos").iterdir()), place / "truth.json")


def kitchen(data: Path) -> LaterSet:
    """Return some photos of the kitchen."""
    photos = sorted((data / KITCHEN / "images").iterdir())[::KITCHEN_STEP][:PHOTOS]
    return LaterSet(KITCHEN, photos, data / KITCHEN / "cameras.json")


def measure(photos: LaterSet, cache: Path, until: str) -> Iterator[Row]:
    """Run the program three times: on the first photos, on all in the same folder, and on all from the start."""
    place = cache / "later" / f"runs-{photos.name}"
    shutil.rmtree(place, ignore_errors=True)
    for name, folder, later in ((FIRST, "growing", False), (GROWN, "growing", True), (FRESH, "fresh", True)):
        photos.fill(place / folder, later=later)
        out = place / f"{folder}-out"
        command = module_command(
            "sfm_app", "run", str(place / folder), "-o", str(out), "--until", until, "--workers", "1"
        )
        code, said = run_command(command)
        if code:
            raise SystemExit(f"{photos.name}, {name}: {said}")
        yield {"set": photos.name, "run": name} | figures(photos, out)


def figures(photos: LaterSet, out: Path) -> Row:
    """Return the CPU seconds of a run, and how exact its poses are."""
    stages: Mapping[str, Any] = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]
    spent = {name: stages[name]["cpu_seconds"] for name in NAMES if name in stages}
    models, truth = read_models(out), true_photos(photos.truth, ())
    counts = stages["scene"]["counts"]
    row: Row = {"photos": counts["of"], "placed": counts["registered"], "mapper": counts["mapper"]}
    row |= {f"CPU {name}": seconds for name, seconds in spent.items()} | {"CPU": round(sum(spent.values()), 1)}
    if photos.name == KITCHEN:
        return row | offset_figures(models, truth)
    poses: dict[str, Pose] = {name: photo.pose for name, photo in truth.items() if name in models[0].poses}
    return row | {"AUC@5": round(model_auc(models[0], poses), 4)}


def add_shares(rows: Sequence[Row]) -> None:
    """Add to the runs that went on what they cost, as a share of doing everything afresh."""
    for row in rows:
        if row["run"] == GROWN:
            (fresh,) = (one for one in rows if one["run"] == FRESH and one["set"] == row["set"])
            row["share"] = round(row["CPU"] / fresh["CPU"], 3)


def page(rows: Sequence[Row], until: str) -> str:
    """Return the page."""
    columns = ("set", "run", "photos", "placed", *(f"CPU {name}" for name in NAMES[: NAMES.index(until) + 1]), "CPU",
               "share", "AUC@5", "median center cm", "90 % center cm", "median rotation deg")  # fmt: skip
    return f"# Photos that come later\n\n{ABOUT}\n\n{table(rows, columns)}"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("many.later", __doc__)
    parser.add_argument("data", type=Path, nargs="?", help="folder with kitchen1000")
    parser.add_argument("--cache", type=Path, required=True, help="keeps rendered photos and runs")
    parser.add_argument("--until", default="scene", choices=NAMES[NAMES.index("scene") :])
    parser.add_argument("--sets", nargs="+", default=[STATUE, KITCHEN], choices=[STATUE, KITCHEN])
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--name", default="many-later", help="name of the result files")
    return parser


def main() -> None:
    """Measure the sets, and write the results."""
    args = parser().parse_args()
    sets = [rendered_statue(args.cache.resolve())] if STATUE in args.sets else []
    sets += [kitchen(args.data.resolve())] if args.data and KITCHEN in args.sets else []
    rows = []
    for photos in sets:
        for row in measure(photos, args.cache.resolve(), args.until):
            rows.append(row)
            print(row, flush=True)
    add_shares(rows)
    write(args.results, args.name, document("many", ABOUT, {"until": args.until}, {}, rows), page(rows, args.until))
    print(page(rows, args.until))


if __name__ == "__main__":
    main()
