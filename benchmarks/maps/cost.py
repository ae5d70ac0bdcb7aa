"""Seconds and memory of the maps of 75, 150 and 300 photos of 12 megapixels from above, on a made-up surface.

    python -m benchmarks.maps.cost --cache CACHE

Each photo adds 7 % of its pixels to the map, as with 80 % overlap along the path and 65 % across, and as many triangles
and pages of texture as the program makes by default.
"""

import argparse
import json
import shutil
import time
from pathlib import Path

import numpy as np

from benchmarks.common.command_line import new_parser
from benchmarks.common.memory import cpu_seconds, peak_mb
from benchmarks.common.processes import row_of_module
from benchmarks.common.results import RESULTS, Row, document, table, write
from sfm_app.frame.scale import MetricFrame
from sfm_app.maps.products import MapOptions, export_map
from sfm_app.numerical import json_text
from sfm_app.pipeline import NAMES, SCALE, TEXTURE
from sfm_app.products import write_texture
from sfm_app.runtime.workspace import StageRecord, Workspace
from sfm_app.settings import TextureSettings
from sfm_app.synthetic.shapes import grid
from sfm_app.types import Model, Surface, Texture

ABOUT = (
    "Orthophoto and DSM of a made-up surface of a survey, in a process each, read from the run's files; "
    "megapixels of the raster, CPU seconds and memory with Python and GDAL."
)
COLUMNS = ("photos", "product", "megapixels", "triangles", "CPU s", "seconds", "MB", "file MB")
PIXEL_M, PHOTO_PX = 0.02, 12e6
NEW_SHARE = 0.2 * 0.35
TRIANGLES = 8_000
"""Of a photo: 400 000 in a block of 50 photos."""


def make_run(photos: int, place: Workspace) -> None:
    """Write what the program keeps of a textured surface."""
    side_m = PIXEL_M * np.sqrt(photos * PHOTO_PX * NEW_SHARE)
    steps = int(np.sqrt(photos * TRIANGLES / 2.0)) + 1
    flat, faces = grid(np.linspace(-0.5, 0.5, steps), np.linspace(-0.5, 0.5, steps))
    x, z = side_m * flat[:, 1], side_m * flat[:, 0]
    vertices = np.column_stack([x, 3.0 * np.sin(x / 20.0) * np.cos(z / 17.0), z])
    options, rng = TextureSettings(), np.random.default_rng(0)
    count = -(-photos * TRIANGLES // 400_000) * options.max_pages
    small = rng.integers(0, 256, (options.max_atlas_px // 8, options.max_atlas_px // 8, 3), dtype=np.uint8)
    page = np.repeat(np.repeat(small, 8, axis=0), 8, axis=1)
    strip = count * (flat[faces][:, :, 0] + 0.5)  # the pages lie side by side from north to south
    number = np.minimum(strip.mean(axis=1).astype(np.int32), count - 1)
    uv = np.stack([flat[faces][:, :, 1] + 0.5, np.clip(strip - number[:, None], 0.0, 1.0)], axis=2)
    surface = Surface(vertices, faces, np.zeros((len(vertices), 3), np.uint8))
    write_texture(Model(surface, Texture(uv.astype(np.float32), number, (page,) * count)), place)
    place.scale.write_text(json_text(MetricFrame(deviation=0.01, source="GPS").to_dict()), encoding="utf-8")
    for name in NAMES[: NAMES.index("texture") + 1]:
        stage = {"scale": SCALE, "texture": TEXTURE}.get(name)
        place.manifest.finish(name, StageRecord("", 0.0, digest=stage.digest(place) if stage else ""), {})


def export_once(out: Path, product: str) -> Row:
    """Write a product, and return its cost in this process."""
    import rasterio

    begun = time.monotonic()
    (path,) = export_map(out, product, options=MapOptions(f"{PIXEL_M}m"))
    with rasterio.open(path) as file:
        megapixels = file.width * file.height / 1e6
    spent = {"CPU s": cpu_seconds(), "seconds": time.monotonic() - begun, "MB": peak_mb()}
    return {"megapixels": megapixels, **spent, "file MB": path.stat().st_size / 1e6}


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("maps.cost", __doc__)
    parser.add_argument("--counts", type=int, nargs="+", default=[75, 150, 300])
    parser.add_argument("--cache", type=Path, required=True, help="for the made-up runs, which are removed")
    parser.add_argument("--one", nargs=2, metavar=("OUT", "PRODUCT"), help="print the row of one export as JSON")
    parser.add_argument("--results", type=Path, default=RESULTS)
    return parser


def main() -> None:
    """Measure every number of photos, and write the results."""
    args = parser().parse_args()
    if args.one:
        print(json.dumps(export_once(Path(args.one[0]), args.one[1])))
        return
    rows: list[Row] = []
    for photos in args.counts:
        out = args.cache / f"survey-{photos}"
        make_run(photos, Workspace(out))
        for product in ("orthophoto", "dsm"):
            row = row_of_module("benchmarks.maps.cost", "--cache", f"{args.cache}", "--one", f"{out}", product)
            about = {"photos": photos, "product": product, "triangles": photos * TRIANGLES}
            rows.append({"method": "sfm-app", **about, **row})
            print(table(rows[-1:], COLUMNS), flush=True)
        shutil.rmtree(out)
    page = f"# Cost of maps\n\n{ABOUT}\n\n{table(rows, COLUMNS)}"
    write(args.results, "maps-cost", document("maps", ABOUT, {"counts": args.counts}, {}, rows), page)


if __name__ == "__main__":
    main()
