"""Dense half of thousands of photos: CPU seconds and memory per photo of depth maps, surface and texture in blocks.

    python -m benchmarks.many.blocks --cache CACHE
    python -m benchmarks.many.blocks --cache CACHE --megapixels 3 --counts 250 1000 --block-points 4000000

The first photos of a walk through the rendered town, with their true poses, so that only the dense stages run.
"""

import argparse
import json
import pickle
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.command_line import new_parser
from benchmarks.common.photo_sets import link_or_copy
from benchmarks.common.processes import row_of_module
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.many.true_town import true_scene
from benchmarks.synthetic.town import TownPhotos, town_of, town_views
from sfm_app.engine.execution import measure_usage
from sfm_app.geometry.triangles import unique_edges
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages import depth_maps, mesh, texture
from sfm_app.synthetic.cameras import make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder
from sfm_app.types import Surface

ABOUT = (
    "The first photos of a walk through a rendered town, with true poses; two workers. CPU: seconds of all processes "
    "per photo. MB: most memory of the stage with its processes. Open: share of the edges in the planes between blocks "
    "that have a triangle on one side only. Bend: median angle in degrees between the triangles at these edges, and at "
    "the edges beside the planes."
)
STAGES = ("depth_maps", "mesh", "texture")
WORKERS = 2
COLUMNS = (
    "photos", *(f"CPU {name}" for name in STAGES), *(f"MB {name}" for name in STAGES), "points", "blocks", "triangles",
    "pages", "open", "bend", "bend beside",
)  # fmt: skip


def camera_size(megapixels: float) -> tuple[int, int]:
    """Return width and height of photos of 4 : 3."""
    width = round((megapixels * 1e6 * 4 / 3) ** 0.5 / 16) * 16
    return width, width * 3 // 4


def prepare(count: int, walk: int, megapixels: float, cache: Path) -> Path:
    """Return a folder with photos and their true scene; what is there already is not made again."""
    camera, options = make_camera(*camera_size(megapixels), focal_widths=0.9), TownPhotos(photos=walk)
    rendered, out = cache / f"town-{walk}-{camera.width}", cache / f"blocks-{walk}-{camera.width}-{count}"
    if (out / "scene.pickle").exists():
        return out
    town, views = town_of(options), town_views(camera, options, count)
    write_photo_folder(rendered, town, views, PhotoOptions(supersampling=1), processes=WORKERS)
    (out / "photos").mkdir(parents=True)
    for name in views.cam_from_world:
        link_or_copy(rendered / name, out / "photos")
    scene = true_scene(out / "sparse", camera, views, town.vertices, town.faces)
    (out / "scene.pickle").write_bytes(pickle.dumps(scene))
    return out


def measure(out: Path, block_points: int) -> Row:
    """Run the dense stages in a prepared folder, and return what they used."""
    scene = pickle.loads((out / "scene.pickle").read_bytes())  # noqa: S301 - written by us
    settings = Settings.from_mapping({"mesh": {"block_points": block_points}})
    row: Row = {"method": "sfm-app", "photos": len(scene.cam_from_world)}
    with make_executor(WORKERS) as executor:
        run = RunContext(settings, Workspace(out), load_plugins(installed=False), executor, WORKERS)
        counts: dict[str, Any] = {}
        for name in STAGES:
            stage = run.with_fingerprint(name)
            with measure_usage() as used:
                if name == "depth_maps":
                    dense = depth_maps.make(scene, stage)
                elif name == "mesh":
                    surface = mesh.make(scene, dense, stage)
                else:
                    texture.make(scene, surface, stage)
            row |= {f"CPU {name}": used.cpu_seconds / row["photos"], f"MB {name}": used.peak_mb}
            counts |= stage.statistics
    row |= {"points": counts["fused_points"], "blocks": counts.get("blocks", 1), "pages": len(counts["pages"])}
    return row | {"triangles": len(surface.faces)} | seams(surface, counts.get("planes", []))


def seams(surface: Surface, planes: Sequence[tuple[int, float]]) -> Row:
    """Return the share of open edges in the planes between blocks, and the angles at them and beside them."""
    edges, edge_of = unique_edges(surface.faces)
    uses = np.bincount(edge_of.ravel())
    inside, beside = np.zeros(len(edges), bool), np.zeros(len(edges), bool)
    for axis, at in planes:
        away = np.abs(surface.vertices[edges, axis] - at).max(axis=1)
        inside |= away < 1e-6
        beside |= away < 1.0
    bends = bend_deg(surface, edge_of, uses)
    two = uses == 2
    found = {"open": 1.0 - two[inside].mean()} if inside.any() else {"open": 0.0}
    places = {"bend": inside & two, "bend beside": beside & ~inside & two}
    return found | {name: float(np.median(bends[where])) if where.any() else 0.0 for name, where in places.items()}


def bend_deg(surface: Surface, edge_of: NDArray[np.int64], uses: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the angle between the two triangles at every edge; 0 where there are not two."""
    corners = surface.vertices[surface.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    faces = np.argsort(edge_of, axis=None, kind="stable") // 3
    first = np.cumsum(uses) - uses
    two = np.flatnonzero(uses == 2)
    cosine = np.sum(normals[faces[first[two]]] * normals[faces[first[two] + 1]], axis=1)
    found = np.zeros(len(uses))
    found[two] = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return found


def page(rows: Sequence[Row]) -> str:
    """Return the page with a row for each number of photos."""
    return f"# Dense stages of many photos\n\n{ABOUT}\n\n{table(rows, COLUMNS)}"


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("many.blocks", __doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[50, 200])
    parser.add_argument("--walk", type=int, help="photos of the whole walk, as the town is as large; default: the most")
    parser.add_argument("--megapixels", type=float, default=0.307)
    parser.add_argument("--block-points", type=int, default=1_000_000)
    parser.add_argument("--cache", type=Path, help="keeps the rendered photos and the runs")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--results", type=Path, default=RESULTS)
    return parser


def main() -> None:
    """Measure every number of photos, and write the results."""
    args = parser().parse_args()
    if args.one:
        print(json.dumps(measure(args.one, args.block_points)))
        return
    rows = []
    with tempfile.TemporaryDirectory(prefix="blocks-") as scratch:
        cache = (args.cache or Path(scratch)).resolve()
        for count in args.counts:
            out = prepare(count, args.walk or max(args.counts), args.megapixels, cache)
            rows.append(
                row_of_module("benchmarks.many.blocks", "--one", str(out), "--block-points", str(args.block_points))
            )
            print(table(rows[-1:], COLUMNS), flush=True)
    options = {"megapixels": args.megapixels, "block_points": args.block_points, "walk": args.walk}
    write(args.results, "many-blocks", document("many", ABOUT, options, {"counts": args.counts}, rows), page(rows))


if __name__ == "__main__":
    main()
