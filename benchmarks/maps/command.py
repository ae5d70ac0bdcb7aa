"""Orthophoto and elevation model of rendered land, photographed from above, against the truth.

    python -m benchmarks.maps --cache CACHE
    python -m benchmarks.maps --cache CACHE --by gps gcp none --side 60 --pictures FOLDER

The photos have positions with 5 cm of noise (gps), eight control points (gcp), or nothing: then only the error of up is
measured.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

import cv2
import numpy as np

from benchmarks.common.command_line import new_parser
from benchmarks.common.processes import module_command, run_command
from benchmarks.common.results import RESULTS, Row, document, table, write
from benchmarks.maps.land import flight, hills, land, write_control_points, write_positions
from benchmarks.maps.truth import ORIGIN, edge_errors, height_errors, true_map
from sfm_app.colmap.model import posed_images, read_model
from sfm_app.settings import QUALITY_PRESETS
from sfm_app.synthetic.cameras import Views, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder
from sfm_app.synthetic.render import prepare
from sfm_app.synthetic.shapes import SyntheticScene

ABOUT = (
    "All errors in pixels of the raster, inside the square of the flight. Edges: how far visible edges of the "
    "orthophoto are off across themselves, on the ground and at roofs (steps of a meter); found: edges that are alike. "
    "Heights: share of the DSM within 1.5 pixels, median, 90 % of the sizes, and the bending of the whole (dome). "
    "Moved: after the best shift, or without the median, which come from the noise of the positions. Up: its source, "
    "and its error in degrees in the model; control points then level the raster. Ground: the DTM against the hills. "
    "Checks: four points that have no part in the fit, and the root mean squares by which they are off."
)
COLUMNS = (
    "by", "seed", "photos", "pixel cm", "found %", "edges median", "edges 90 %", "roofs median", "roofs 90 %",
    "edges moved 90 %", "covered %", "within 1.5 px %", "moved", "height median", "height |90 %|", "dome", "up",
    "up deg", "ground open %", "ground within 20 cm %", "DSM within 20 cm %", "checks inside", "plan cm",
    "height cm", "CPU s of the maps", "failed",
)  # fmt: skip
NOISE_M = 0.05
HEIGHT_M = 30.0
GROUND_M = 0.2
"""Error of the bare ground that passes. Chosen by hand: three times what half a pixel of noise costs."""


def measure(by: str, seed: int, args: argparse.Namespace) -> Row:
    """Run the program on the photos with one kind of evidence, and compare the rasters with the truth."""
    camera = make_camera(args.width, args.width * 3 // 4, focal_widths=0.9, center=(0.503, 0.496))
    views = flight(camera, args.side, HEIGHT_M, (0.8, 0.65), seed)
    scene = land(args.side + 40.0, seed)
    place = args.cache / f"land-{args.side:g}-{args.width}-{seed}"
    write_photo_folder(place / "photos", scene, views, PhotoOptions(supersampling=2, seed=seed), processes=2)
    write_positions(place / "geo.txt", views, NOISE_M, seed)
    write_control_points(place / "gcp_list.txt", scene, views, args.side, seed)
    out = place / f"{by}-{args.quality}"
    evidence = {
        "gps": ["--positions", f"{place / 'geo.txt'}"],
        "gcp": ["--gcp", f"{place / 'gcp_list.txt'}"],
        "none": [],
    }
    code, said = run_command(
        module_command(
            "sfm_app", "run", f"{place / 'photos'}", "-o", f"{out}", "--quality", args.quality, *evidence[by]
        )
    )
    row: Row = {"method": "sfm-app", "by": by, "seed": seed, "photos": len(views.cam_from_world)}
    if code != 0:
        return row | {"failed": said}
    begun = _spent()
    for product in ("orthophoto", "dsm", *(["dtm"] if by != "none" else [])):
        export = module_command("sfm_app", "export", f"{out}", "--format", product)
        code, said = run_command([*export, *(["--resolution", args.resolution] if args.resolution else [])])
        if code != 0:
            return row | {"failed": said}
        if product == "dsm":
            row["CPU s of the maps"] = _spent() - begun
    row |= _up_error(out, views) | _check_points(out)
    return row if by == "none" else row | _compare(out, scene, args)


def _up_error(out: Path, views: Views) -> Row:
    """Return the method of the up direction, and its error."""
    found = {image.name: image.cam_from_world().rotation.matrix() for image in posed_images(read_model(out / "sparse"))}
    ups = np.array([views.cam_from_world[name][:, :3].T @ R @ [0.0, 1.0, 0.0] for name, R in found.items()])
    up = ups.mean(axis=0)
    counts = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]["scene"]["counts"]
    error = float(np.degrees(np.arctan2(np.hypot(up[0], up[2]), up[1])))
    return {"up": counts["orientation"]["up"], "up deg": error}


def _check_points(out: Path) -> Row:
    """Return how many check points lie inside three of their deviations, and how far they are off; empty without."""
    counts = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]["scale"]["counts"]
    checks = counts.get("check_points")
    if checks is None:
        return {}
    inside = f"{len(checks['inside'])} of {len(checks['inside']) + len(checks['outside'])}"
    return {
        "checks inside": inside,
        "plan cm": 100.0 * checks["plan_rms_m"],
        "height cm": 100.0 * checks["height_rms_m"],
    }


def _spent() -> float:
    """Return the CPU seconds of all finished child processes."""
    return os.times().children_user + os.times().children_system


def _compare(out: Path, scene: SyntheticScene, args: argparse.Namespace) -> Row:
    import rasterio
    from rasterio.windows import from_bounds

    with rasterio.open(out / "orthophoto.tif") as photo, rasterio.open(out / "dsm.tif") as dsm:
        pixel, half = photo.res[0], args.side / 2.0
        box = (ORIGIN[0] - half, ORIGIN[1] - half, ORIGIN[0] + half, ORIGIN[1] + half)
        window = from_bounds(*box, photo.transform).round_offsets().round_lengths()
        colors = photo.read(window=window, boundless=True)
        heights = dsm.read(1, window=window, boundless=True, fill_value=dsm.nodata).astype(np.float64)
        left, top = photo.transform.c + pixel * window.col_off, photo.transform.f - pixel * window.row_off
        heights[heights == dsm.nodata] = np.nan
    begun = time.monotonic()
    truth = true_map(prepare(scene), left, top, pixel, heights.shape)
    gray = cv2.cvtColor(np.moveaxis(colors[:3], 0, 2), cv2.COLOR_RGB2GRAY).astype(np.float32)
    if args.pictures:
        args.pictures.mkdir(parents=True, exist_ok=True)
        for name, image in (("ours", gray), ("truth", truth.gray)):
            cv2.imwrite(str(args.pictures / f"{out.name}-{name}.png"), image.astype(np.uint8))
        error = np.clip(128.0 + 20.0 * (heights - truth.heights) / pixel, 0.0, 255.0)
        cv2.imwrite(str(args.pictures / f"{out.name}-heights.png"), np.nan_to_num(error).astype(np.uint8))
    print(f"truth rendered in {time.monotonic() - begun:.0f} s", file=sys.stderr)
    figures = edge_errors(gray, colors[3] > 0, truth) | height_errors(heights, truth, pixel)
    return {"pixel cm": 100.0 * pixel} | figures | _ground_errors(out, args.side / 2.0)


def _ground_errors(out: Path, half: float) -> Row:
    """Return how far the bare ground and, for comparison, the DSM are from the hills, in the square of the flight."""
    import rasterio

    row: Row = {}
    for product, name in (("dtm", "ground"), ("dsm", "DSM")):
        with rasterio.open(out / f"{product}.tif") as file:
            heights, (rows, columns) = file.read(1).astype(np.float64), np.indices(file.shape)
            east, north = (np.asarray(value) for value in file.transform @ (columns + 0.5, rows + 0.5))
            heights[heights == file.nodata] = np.nan
        x, z = east - ORIGIN[0], ORIGIN[1] - north
        inside = (np.abs(x) < half) & (np.abs(z) < half)
        error = np.abs(heights - hills(x, z) - ORIGIN[2])[inside]
        row[f"{name} open %"] = 100.0 * float(np.mean(np.isnan(error)))
        row[f"{name} within 20 cm %"] = 100.0 * float(np.mean(error < GROUND_M))
    return row


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser("maps", __doc__)
    parser.add_argument("--by", nargs="+", default=["gps", "gcp", "none"], choices=("gps", "gcp", "none"))
    parser.add_argument("--side", type=float, default=32.0, help="of the square that is flown over, in meters")
    parser.add_argument("--width", type=int, default=1200, help="of a photo, in pixels")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of land, flight and noise")
    parser.add_argument("--quality", default="normal", choices=tuple(QUALITY_PRESETS))
    parser.add_argument("--resolution", default="", help="of the rasters; default: that of the program")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of ours and of the truth")
    parser.add_argument("--cache", type=Path, required=True, help="keeps the rendered photos and the runs")
    parser.add_argument("--results", type=Path, default=RESULTS)
    return parser


def main() -> None:
    """Measure every kind of evidence, and write the results."""
    args = parser().parse_args()
    rows: list[Row] = []
    for seed in args.seeds:
        for by in args.by:
            rows.append(measure(by, seed, args))
            print(table(rows[-1:], COLUMNS), flush=True)
    about = {key: str(getattr(args, key)) for key in ("side", "width", "seeds", "quality", "resolution")}
    page = f"# Maps of rendered land\n\n{ABOUT}\n\n{table(rows, COLUMNS)}"
    write(args.results, "maps", document("maps", ABOUT, about, {}, rows), page)


if __name__ == "__main__":
    main()
