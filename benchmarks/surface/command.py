"""Surfaces of `sfm-app`: rendered scenes against their truth, real ones against their photos, and the cost.

python -m benchmarks.surface DATA --cache CACHE --left-out 3 --parts castle-P19 5 10 19
python -m benchmarks.surface --sets statue corner --cache CACHE
python -m benchmarks.surface --sets ornament railing garden --cache CACHE --name surface-detail
python -m benchmarks.surface --sets statue@1 facade@1 corner@1 courtyard --cache CACHE --name surface-fresh
python -m benchmarks.surface DATA --sets kitchen1000 --cache CACHE --name surface-kitchen
python -m benchmarks.surface DATA --sets fountain-P11 --cache CACHE --keep --name surface-fountain
"""

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.common.command_line import (
    add_pictures,
    add_results,
    add_settings,
    is_wanted,
    merge_assignments,
    new_parser,
)
from benchmarks.common.results import Row, document, write
from benchmarks.surface.measure import (
    compare_with_kinect,
    compare_with_photos,
    compare_with_truth,
    cost,
    file_sizes,
    score_left_out,
)  # fmt: skip
from benchmarks.surface.photos import placed_photos
from benchmarks.surface.pictures import model_page, save_page
from benchmarks.surface.report import page
from benchmarks.surface.sets import (
    REAL,
    RENDERED,
    SCANNED,
    SurfaceSet,
    dense_stages,
    finished_model,
    first_photos,
    surface_set,
)
from benchmarks.surface.worker import run_stages
from sfm_app.settings import Settings
from sfm_app.synthetic.render import PreparedModel

ABOUT = (
    "Photos only, through the whole program. Rendered scenes: the mesh is moved onto the truth by the camera centers; "
    "accuracy: share of its area within 0.5 % of the scene's size of the true surface (size: diagonal of the box "
    "around all that the photos see); completeness: share of the area of the true surface that two photos see (in the "
    "photo, not hidden, at less than 80 degrees) with mesh within 1 %; F: harmonic mean; median: of the distances, in "
    "% of the size. Detail: the same for other limits; flakes: share of the mesh farther than 1 % of the size from "
    "the truth; edges: distance of creases that three photos see from the mesh; thin things: share of their length, "
    "as far as three photos see it, with mesh within 0.3 % of them; ground at a low angle: share of the ground that "
    "photos see at 10 to 20 degrees with mesh within 0.4 %. sparse: COLMAP's Poisson surface through the sparse "
    "points of the same run, under the trimming that suits it best. Real photos: the finished model is rendered into "
    "the camera of every photo that has a place, lens and all; coverage: share of the photo's pixels that show it; "
    "PSNR: on those, after a gain and an offset per channel; means over the photos, and the worst photo. left out: "
    "photos whose texture was made without them, geometry kept; PSNR in them, and how much lower it is than with "
    "them. A depth camera's scan, for kitchen1000 (every 5th photo): its points are means over cells of 15 mm; the "
    "mesh is moved by the similarity of the worlds, which is fitted to the poses of both cameras jointly with the "
    "fixed offset between them; accuracy 3 cm: share of the mesh's area within 3 cm of the scan, whose points fill a "
    "band (rough: standard deviation across it): of the plane through the points within 5 cm of the nearest one, as "
    "far as a cell from it; of a point: of the nearest point, so of the band's face; completeness 5 cm: share of the "
    "scan's points with mesh within 5 cm; over 10 cm off: share of the area without a point within 10 cm, which the "
    "scan's holes count to; in reach: share of the area that a depth camera of the used photos has in its picture at "
    "0.4 to 3.5 m, not hidden by the mesh (holes for glass and dark things are in reach), and the figures of that "
    "part alone; after ICP: the same once the mesh is moved onto the scan by one more similarity, point to plane, "
    "trimmed. Seconds as in the manifest; MB: most memory of a process that did nothing but that stage; together: all "
    "stages behind the cameras but the files."
)


def measure(photos: SurfaceSet, out: Path, args: argparse.Namespace) -> Row:
    """Measure everything about one set."""
    again = () if args.keep else dense_stages()
    said = run_stages(photos.photos, out, ("scene", *dense_stages()), args.settings, again)
    row: Row = {"photos": photos.name, "method": "sfm-app", **cost(said), "of": photos.count}
    if row["failed"]:
        return row
    settings = Settings.from_mapping(args.settings)
    model = finished_model(photos.photos, out, settings)
    names = list(placed_photos(out))
    row |= {"placed": len(names), "triangles": len(model.surface.faces), **file_sizes(out)}
    row["texture pages"] = len(model.texture.pages) if model.texture else 0
    row["seconds per photo"] = round(row["seconds together"] / len(names), 2)
    prepared = PreparedModel(model)
    if is_wanted(args.pictures, photos.name):
        save_page(model_page(out, names[len(names) // 2], prepared), args.results / f"{args.name}-{photos.name}.png")
    if photos.truth is not None and photos.scene is not None:
        return row | compare_with_truth(model.surface, out, photos.truth, photos.scene)
    if photos.kinect is not None:
        row |= compare_with_kinect(model.surface, out, photos.kinect)
    row |= compare_with_photos(prepared, out, names)
    if args.left_out:
        row |= score_left_out(out, prepared, args.settings, count=args.left_out, geometry_too=args.geometry_too)
    return row


def measure_parts(whole: SurfaceSet, counts: Sequence[int], cache: Path, settings: Mapping[str, Any]) -> list[Row]:
    """Measure the cost of growing numbers of photos of a set."""
    rows = []
    for count in counts:
        part = first_photos(whole, count, cache)
        out = cache / "surface" / f"{whole.name}-{count}"
        said = run_stages(part.photos, out, ("scene", *dense_stages()), settings, dense_stages())
        row: Row = {"photos": part.name, "method": "sfm-app", **cost(said), "of": count}
        if not row["failed"]:
            placed = len(placed_photos(out))
            row |= {"placed": placed, "seconds per photo": round(row["seconds together"] / placed, 2)}
        rows.append(row)
        print(json.dumps(row), file=sys.stderr, flush=True)
    return rows


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("surface", __doc__)
    parser.add_argument("data", type=Path, nargs="?", help="folder with NAME/images; rendered scenes need none")
    parser.add_argument("--cache", type=Path, help="keeps rendered photos and the last run of every set")
    parser.add_argument("--sets", nargs="*", metavar="SET", help="rendered scenes and names in DATA; all by default")
    parser.add_argument("--left-out", type=int, default=0, metavar="N", help="leave out N photos of each set in turn")
    parser.add_argument("--geometry-too", action="store_true", help="leave them out of depth maps and mesh, too")
    parser.add_argument(
        "--parts", nargs="+", default=[], metavar=("SET", "COUNT"), help="cost of the first COUNT photos"
    )
    parser.add_argument("--keep", action="store_true", help="reuse stages that are up to date")
    add_settings(parser)
    add_results(parser, "surface")
    add_pictures(parser, "sets")
    return parser


def parse_arguments() -> argparse.Namespace:
    """Read the command line, and resolve the sets and settings."""
    args = parser().parse_args()
    if args.sets is None:
        args.sets = [*RENDERED, *((*REAL, *SCANNED) if args.data else ())]
    args.settings = merge_assignments(args.assignments)
    return args


def main() -> None:
    """Measure all sets, and write the results."""
    args = parse_arguments()
    with tempfile.TemporaryDirectory(prefix="surface-") as scratch:
        cache = (args.cache or Path(scratch)).resolve()
        rows = []
        for name in args.sets:
            rows.append(measure(surface_set(name, args.data, cache), cache / "surface" / name, args))
            print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
        parts = []
        if args.parts:
            whole = surface_set(args.parts[0], args.data, cache)
            parts = measure_parts(whole, [int(count) for count in args.parts[1:]], cache, args.settings)
    options = {"settings": args.settings, "left_out": args.left_out, "geometry_too": args.geometry_too}
    found = document("surface", ABOUT, options, {"sets": list(args.sets), "parts": args.parts}, [*rows, *parts])
    drawn = [row["photos"] for row in rows if not row["failed"] and is_wanted(args.pictures, row["photos"])]
    text = page(ABOUT, rows, parts, {name: f"{args.name}-{name}.png" for name in drawn})
    write(args.results, args.name, found, text)
    print(text)
