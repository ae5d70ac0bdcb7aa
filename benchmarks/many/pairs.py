"""Pairs chosen by retrieval beside all pairs: photos placed, accuracy, pairs matched, and CPU seconds up to the scene.

    python -m benchmarks.many.pairs DATA --cache CACHE
    python -m benchmarks.many.pairs DATA --cache CACHE --sets temple16 --rendered 0

Sets of DATA, and evenly spaced photos of the rendered statue at 12 megapixels. Small sets are told to take few partners
a photo: with the default of 30, retrieval would take all pairs of them. One unmeasured run of a few photos compiles the
kernels.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.cameras.measure import warm_up
from benchmarks.cameras.methods import Method, run
from benchmarks.cameras.score import TruePhoto, accuracy, read_models, true_photos
from benchmarks.cameras.worker import OURS
from benchmarks.common.command_line import new_parser
from benchmarks.common.photo_sets import PhotoSet, link_or_copy, photo_set, steps
from benchmarks.common.results import RESULTS, Row, document, finite_or_none, table, write
from benchmarks.corpus.score import OFFSETS, offset_figures
from benchmarks.hundred.command import PHOTOS, SMALL, photo_folder
from sfm_app.settings import MatchSettings
from sfm_app.synthetic.cameras import make_camera
from sfm_app.synthetic.scenes import statue_views

ABOUT = (
    "`sfm-app run --until scene` with all pairs and with pairs chosen by retrieval, one after the other. CPU: seconds "
    "of all processes up to the scene, and their ratio to those with all pairs. Sets that are smaller than the default "
    "number of partners take a third of the photos as partners."
)
SETS = ("fountain-P11", "Herz-Jesus-P8", "castle-P19", "temple16", "kitchen1000 every:5")
PARTNER_SHARE, LEAST_PARTNERS = 1 / 3, 4
"""Partners of each photo as a share of the photos, in sets that are smaller than the default number of partners."""
FEW_PHOTOS = 10
"""Photos of the first set that compile the kernels."""
ALL, RETRIEVAL = "all", "retrieval"
COLUMNS = ("photos", "pairs", "matched", "of pairs", "placed", "AUC@1", "AUC@5", "median center cm", "CPU s",
           "CPU / all", "failed")  # fmt: skip


def real_set(title: str, data: Path, cache: Path) -> tuple[PhotoSet, dict[str, TruePhoto]]:
    """Return a set of DATA and its truth."""
    name, _, change = title.partition(" ")
    return photo_set(data, name, change, cache), true_photos(data / name / "cameras.json", steps(change))


def rendered_set(count: int, cache: Path) -> tuple[PhotoSet, dict[str, TruePhoto]]:
    """Return a set of the rendered statue and its truth; the poses do not depend on the size of the photos."""
    folder = photo_folder(count, cache)
    views = statue_views(make_camera(*SMALL, focal_widths=1.35), photos=PHOTOS)
    present = {path.name for path in folder.iterdir()}
    truth = {
        Path(name).stem: TruePhoto(views.cameras[name].K, pose, views.cameras[name].width)
        for name, pose in views.cam_from_world.items()
        if name in present
    }
    return PhotoSet(f"statue, {count} photos of 12 MP", folder, {}, "auto", cameras_given=False), truth


def photo_sets(args: argparse.Namespace) -> Iterator[tuple[PhotoSet, dict[str, TruePhoto]]]:
    """Yield the sets that the command line names, each with its truth."""
    for title in args.sets:
        yield real_set(title, args.data, args.cache)
    if args.rendered:
        yield rendered_set(args.rendered, args.cache)


def first_photos(photos: PhotoSet, cache: Path) -> PhotoSet:
    """Return a few photos of a set that lie beside each other."""
    folder = cache / "pairs" / "few"
    folder.mkdir(parents=True, exist_ok=True)
    for path in sorted(photos.folder.iterdir())[:FEW_PHOTOS]:
        link_or_copy(path, folder)
    return replace(photos, folder=folder)


def measure(photos: PhotoSet, truth: Mapping[str, TruePhoto], choice: str, cache: Path) -> Row:
    """Run the program with pairs chosen in one way.

    Args:
        photos: the set.
        truth: poses by name without suffix.
        choice: `matching.pairs`.
        cache: where the run is kept.
    """
    count = sum(1 for _ in photos.folder.iterdir())
    matching: dict[str, Any] = {"pairs": choice}
    if choice == RETRIEVAL and count <= MatchSettings().neighbors + 1:
        matching["neighbors"] = max(LEAST_PARTNERS, round(PARTNER_SHARE * count))
    out = cache / "pairs" / photos.folder.name / choice
    said = run(Method(OURS, settings={"matching": matching}), photos, out)
    stages = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]
    kept = {name: value for name, value in truth.items() if any(photos.folder.glob(f"{name}.*"))}
    models = read_models(out)
    row: Row = {"method": OURS, "photos": photos.name, "pairs": choice, "failed": said["failed"]}
    row |= {"matched": stages["match_graph"]["counts"].get("matched_pairs", count * (count - 1) // 2)}
    row |= {"of pairs": round(row["matched"] / (count * (count - 1) // 2), 3)}
    offset = photos.name.partition(" ")[0] in OFFSETS
    figures = accuracy(models, {} if offset else kept, count) | (offset_figures(models, kept) if offset else {})
    row |= {key: figures.get(key) for key in ("registered", "of", "AUC@1", "AUC@5", "median center cm")}
    row |= {"placed": f"{row['registered']}/{row['of']}"}
    row |= {f"CPU {name}": stage["cpu_seconds"] for name, stage in stages.items()}
    return row | {"CPU s": round(sum(stage["cpu_seconds"] for stage in stages.values()), 1)}


def compare(photos: PhotoSet, truth: Mapping[str, TruePhoto], cache: Path) -> Iterator[Row]:
    """Yield the rows of both choices of pairs."""
    reference = measure(photos, truth, ALL, cache)
    yield reference | {"CPU / all": 1.0}
    chosen = measure(photos, truth, RETRIEVAL, cache)
    yield chosen | {"CPU / all": round(chosen["CPU s"] / reference["CPU s"], 3)}


def page(rows: list[Row]) -> str:
    """Return the page with two rows a set."""
    return f"# Retrieval beside all pairs\n\n{ABOUT}\n\n{table(rows, COLUMNS)}"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("many.pairs", __doc__)
    parser.add_argument("data", type=Path, help="folder with NAME/images and NAME/cameras.json")
    parser.add_argument("--cache", type=Path, required=True, help="keeps copies of photos and the last run of each")
    parser.add_argument("--sets", nargs="*", default=list(SETS), metavar="SET", help='"NAME" or "NAME CHANGE"')
    parser.add_argument("--rendered", type=int, default=PHOTOS, help="photos of the statue; 0 for none")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--name", default="many-pairs", help="name of the result files")
    return parser


def main() -> None:
    """Measure every set in both ways, and write the results set by set."""
    args = parser().parse_args()
    rows: list[Row] = []
    sets = list(photo_sets(args))
    warm_up([first_photos(sets[0][0], args.cache)], [Method(OURS)], args.cache / "pairs" / "warm-up")
    for photos, truth in sets:
        for row in compare(photos, truth, args.cache):
            rows.append({key: finite_or_none(value) for key, value in row.items()})
            print(table(rows[-1:], COLUMNS), file=sys.stderr, flush=True)
            write(
                args.results, args.name, document("many", ABOUT, {"partner share": PARTNER_SHARE}, {}, rows), page(rows)
            )
    print(page(rows))


if __name__ == "__main__":
    main()
