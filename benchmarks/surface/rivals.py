"""Surface, texture and cost beside pyarchinit-photogrammetry, which gets our cameras and photos.

python -m benchmarks.surface.rivals DATA --pyarchinit PYTHON --cache CACHE --pictures ornament
python -m benchmarks.surface.rivals DATA --pyarchinit PYTHON --cache CACHE --sets fountain-P11 --keep
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import sfm_app
from benchmarks.common.command_line import add_pictures, add_results, is_wanted, new_parser
from benchmarks.common.results import Row, document, table, write
from benchmarks.surface.photos import (
    Likeness,
    likeness,
    photo_scores,
    placed_photo,
    placed_photos,
    psnr_db,
    render_view,
)
from benchmarks.surface.pictures import save_page
from benchmarks.surface.pyarchinit_worker import depth_width
from benchmarks.surface.rendered.detail import detail_scores
from benchmarks.surface.sets import SurfaceSet, dense_stages, finished_model, surface_set
from benchmarks.surface.worker import run_stages
from sfm_app.colmap.backend import pycolmap
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import Camera
from sfm_app.synthetic.render import PreparedModel, render_model, render_shape
from sfm_app.types import Surface
from sfm_app.types.surface import Model, Texture

WORKER = Path(__file__).with_name("pyarchinit_worker.py")
OURS, RIVAL = "sfm-app", "pyarchinit-photogrammetry"
DEPTH, MESH, TEXTURE, TOGETHER = "CPU s: depth maps", "CPU s: mesh", "CPU s: texture", "CPU s: together"
OPTIONS: Mapping[str, Any] = {
    "defaults": {"depth": {}, "meshes": {"all defaults": {}}},
    "sgbm": {"depth": {"quality": "ours"}, "meshes": {"SGBM, Poisson high": {"face_count": "high"}}},
    "patchmatch": {
        "depth": {"quality": "ours", "backend": "patchmatch"},
        "meshes": {
            "PatchMatch, Poisson high": {"face_count": "high"},
            "PatchMatch, TSDF high": {"source": "depth_maps", "face_count": "high"},
        },
    },
}
"""Arguments of the rival's steps that are not the defaults, by run; meshes of one run share its depth maps."""
ABOUT = (
    f"{RIVAL} (GPL, from PyPI, with its native core and Open3D) gets the photos of each set, and the cameras and "
    "sparse points of our run. Ours runs with the preset `normal`, and its kernels are compiled before. CPU seconds "
    "are those of all processes; for depth maps with their fusion into points. Depth maps of the rival are as wide "
    "as ours except at its defaults. SGBM is its own choice of matcher for close objects, PatchMatch its finer one. "
    "Poisson and TSDF are its two kinds of mesh, both at its finest preset, `high`. Poisson closes gaps, also over "
    "sky. Coverage and PSNR: as for real photos in surface-real.md. Common: PSNR on the pixels that all models of "
    "the set cover. Accuracy, completeness and F: as in surface-detail.md."
)
QUOTED_ABOUT = (
    "The reviewers of this project measured these rows in an earlier run; they are not rerun here. OpenMVS is its "
    "branch develop of 2024-10-18 with all defaults, on the CPU only. It had our cameras and undistorted photos. "
    "Ours ran on the same machine in the same hour, with the compilation of its kernels counted. OpenMVS sharpens "
    "its texture. Its ornament is the mesh **before RefineMesh**. Common: the pixels that both cover."
)
_COST = ("photos", "program", "version", DEPTH, MESH, TEXTURE, TOGETHER, "triangles")
_LOOKS = (*_COST, "coverage %", "PSNR dB", "PSNR dB common")
_SHAPE = (*_COST, "F 0.1 %", "F 0.2 %", "F 0.4 %")
_MVS, _OURS = "develop of 2024-10-18", "c2e9d825"
QUOTED: list[Row] = [
    dict(zip(names, values, strict=True))
    for names, values in (
        (_LOOKS, ("fountain-P11", OURS, _OURS, 41, 47, 19, 107, 197297, 87.0, 32.35, 32.53)),
        (_LOOKS, ("fountain-P11", "OpenMVS", _MVS, 237, 286, 31, 554, 121381, 86.9, 29.94, 30.20)),
        (_SHAPE, ("ornament", OURS, _OURS, None, None, None, 99, 163726, 88.7, 94.0, 97.3)),
        (_SHAPE, ("ornament", "OpenMVS before RefineMesh", _MVS, None, None, None, 450, 408694, 78.2, 86.6, 92.0)),
    )
]
COLUMNS = (
    "photos", "program", "version", "settings", "chosen by", "depth maps px", DEPTH, MESH, TEXTURE, TOGETHER,
    "triangles", "coverage %", "PSNR dB", "worst PSNR dB", "PSNR dB common",
)  # fmt: skip
FIGURES = {TOGETHER: -1, "coverage %": 1, "PSNR dB": 1, "PSNR dB common": 1, "F 0.1 %": 1, "F 0.2 %": 1, "F 0.4 %": 1}
"""Figures to compare, and whether more (1) or less (-1) is better."""
LEADERS = ("photos", "figure", "ahead", OURS, f"best of {RIVAL}", "its settings")
TRUE = (
    "photos", "program", "settings",
    *(f"{kind} {limit} %" for limit in (0.1, 0.2, 0.4) for kind in ("accuracy", "completeness", "F")), "flakes %",
)  # fmt: skip


def run_ours(photos: SurfaceSet, out: Path, *, keep: bool) -> tuple[Row, Model]:
    """Run the program, and return its costs and its model."""
    again = () if keep else dense_stages()
    said = run_stages(photos.photos, out, ("scene", *dense_stages()), {}, again)
    if failed := next((one.failed for one in said.values() if one.failed), ""):
        raise SystemExit(f"{photos.name}: {failed}")
    stages = json.loads((out / "manifest.json").read_text(encoding="utf-8"))["stages"]
    spent = [stages[stage]["cpu_seconds"] for stage in ("depth_maps", "mesh", "texture")]
    row = {"program": OURS, "version": sfm_app.__version__, "settings": "normal", "chosen by": "our default"}
    return row | costs(spent) | {"depth maps px": depth_width(out / "dense")}, finished_model(
        photos.photos, out, Settings()
    )


def costs(spent: Sequence[float]) -> Row:
    """Return the row of the CPU seconds of depth maps, mesh and texture."""
    return {
        name: round(value) for name, value in zip((DEPTH, MESH, TEXTURE, TOGETHER), (*spent, sum(spent)), strict=True)
    }


def run_rival(python: str, name: str, out: Path, target: Path, *, keep: bool) -> list[tuple[Row, Model]]:
    """Run the rival on the cameras of a run of ours, and return costs and model of each of its meshes."""
    if not (keep and (target / "result.json").exists()):
        command = [python, str(WORKER), str(out), str(target), json.dumps(OPTIONS[name])]
        subprocess.run(command, check=True)
    said = json.loads((target / "result.json").read_text(encoding="utf-8"))
    row: Row = {"program": RIVAL, "version": said["version"], "depth maps px": said["px"]}
    row["chosen by"] = "its author" if name == "defaults" else "us"
    return [
        (
            row
            | {"settings": mesh}
            | costs([said["CPU s"][step] for step in ("depth", f"mesh {mesh}", f"texture {mesh}")]),
            read_model(target / f"{mesh}.npz", target / f"{mesh}.jpg"),
        )
        for mesh in OPTIONS[name]["meshes"]
    ]


def read_model(mesh: Path, page: Path) -> Model:
    """Read the rival's model; the origin of its texture coordinates is the bottom left corner of the page."""
    with np.load(mesh) as stored:
        vertices, faces, uv = (stored[name] for name in ("vertices", "faces", "uv"))
    pages = (np.asarray(Image.open(page).convert("RGB")),)
    uv = np.stack([uv[..., 0], 1.0 - uv[..., 1]], axis=-1).astype(np.float32)
    surface = Surface(vertices.astype(np.float64), faces.astype(np.int64), np.zeros((len(vertices), 3), np.uint8))
    return Model(surface, Texture(uv, np.zeros(len(faces), np.int32), pages))


def compare_photos(out: Path, models: Sequence[PreparedModel]) -> list[Row]:
    """Return the scores of each model on the photos, also on the pixels that all models cover."""
    found: list[dict[str, Likeness]] = [{} for _ in models]
    common: list[list[float]] = [[] for _ in models]
    for photo in (placed_photo(out, name) for name in placed_photos(out)):
        pictures = [render_view(model, photo) for model in models]
        shared = np.logical_and.reduce([picture.covered for picture in pictures])
        for picture, own, values in zip(pictures, found, common, strict=True):
            own[photo.name] = likeness(picture, photo.pixels)
            values.append(psnr_db(picture.colors[shared], photo.pixels[shared]))
    return [
        photo_scores(own) | {"PSNR dB common": round(fmean(values), 2)}
        for own, values in zip(found, common, strict=True)
    ]


def draw(out: Path, models: Sequence[PreparedModel]) -> NDArray[np.uint8]:
    """Draw the models from the middle photo, one under the other: with its texture, and its bare shape."""
    images = list(placed_photos(out).values())
    image = images[len(images) // 2]
    camera = pycolmap.Reconstruction(out / "sparse").cameras[image.camera_id]
    eye, pose = Camera(camera.calibration_matrix(), camera.width, camera.height), image.cam_from_world().matrix()
    rows = [
        np.concatenate([show(model, eye, pose).with_background() for show in (render_model, render_shape)], axis=1)
        for model in models
    ]
    return np.concatenate(rows)


def measure(photos: SurfaceSet, cache: Path, args: argparse.Namespace) -> list[Row]:
    """Return a row for our model of a set, and one for each of the rival's."""
    out = cache / "surface" / photos.name
    made = [run_ours(photos, out, keep=args.keep)]
    for name in OPTIONS:
        made += run_rival(args.pyarchinit, name, out, out.with_name(f"{photos.name}-{name}"), keep=args.keep)
    models = [PreparedModel(model) for _, model in made]
    centers = {name: image.projection_center() for name, image in placed_photos(out).items()}
    rows: list[Row] = []
    for (row, model), scores in zip(made, compare_photos(out, models), strict=True):
        method = {"photos": photos.name, "method": f"{row['program']}, {row['settings']}"}
        rows.append(method | row | {"triangles": len(model.surface.faces)} | scores)
        if photos.truth is not None and photos.scene is not None:
            rows[-1] |= detail_scores(model.surface, centers, photos.truth, photos.scene)
    if is_wanted(args.pictures, photos.name):
        save_page(draw(out, models), args.results / f"{args.name}-{photos.name}.png")
    return rows


def leaders(rows: list[Row]) -> list[Row]:
    """Return a row per set and figure: ours, the best of the rival's, and which is ahead."""
    found = []
    for photos in dict.fromkeys(row["photos"] for row in rows):
        ours, *others = (row for row in rows if row["photos"] == photos)
        for figure, sign in FIGURES.items():
            if figure in ours:
                best = max(others, key=lambda row: sign * row[figure])
                ahead = RIVAL if sign * (best[figure] - ours[figure]) > 0 else OURS
                values = (photos, figure, ahead, ours[figure], best[figure], best["settings"])
                found.append(dict(zip(LEADERS, values, strict=True)))
    return found


def page(rows: list[Row], pictures: list[str]) -> str:
    """Return the page: who is ahead, all measured rows, quoted rows, and pictures."""
    rendered = [row for row in rows if "F 0.1 %" in row]
    parts = [
        f"# Surfaces and textures beside rivals\n\n{ABOUT}\n",
        "## Who is ahead\n\nOurs, and the best of the rival's settings for each figure.\n\n"
        + table(leaders(rows), LEADERS),
        f"## Measured\n\n{table(rows, COLUMNS)}",
        f"## Rendered photos, against the true surface\n\n{table(rendered, TRUE)}" if rendered else "",
        f"## Quoted: OpenMVS\n\n{QUOTED_ABOUT}\n\n{table(QUOTED, (*_LOOKS, *_SHAPE[-3:]))}",
        "## Pictures\n\nTexture and bare shape: ours at the top, then the rival's in the order of the table.\n"
        if pictures
        else "",
    ]
    return "\n".join([*(part for part in parts if part), *pictures])


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = new_parser("surface.rivals", __doc__)
    parser.add_argument("data", type=Path, help="folder with NAME/images")
    parser.add_argument("--pyarchinit", required=True, metavar="PYTHON", help=f"Python of an environment with {RIVAL}")
    parser.add_argument("--cache", type=Path, required=True, help="keeps rendered photos and all runs")
    parser.add_argument("--sets", nargs="+", default=["fountain-P11", "ornament"], metavar="SET")
    parser.add_argument("--keep", action="store_true", help="reuse finished runs")
    add_results(parser, "surface-rivals")
    add_pictures(parser, "sets")
    return parser.parse_args()


def main() -> None:
    """Measure all sets, and write the results."""
    args = parse_arguments()
    cache, rows = args.cache.resolve(), []
    sets = [surface_set(name, args.data, cache) for name in args.sets]
    run_ours(sets[0], cache / "surface" / sets[0].name, keep=True)  # compiles our kernels
    for photos in sets:
        rows += measure(photos, cache, args)
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    drawn = [f"![{name}]({args.name}-{name}.png)\n" for name in args.sets if is_wanted(args.pictures, name)]
    found = document("surface-rivals", ABOUT, OPTIONS, {"sets": args.sets, "quoted": QUOTED}, rows)
    text = page(rows, drawn)
    write(args.results, args.name, found, text)
    print(text)


if __name__ == "__main__":
    main()
