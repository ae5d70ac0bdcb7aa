"""Real photos resampled through other lenses: are the poses as good as those of the photos as they are?

    python -m benchmarks.lenses.warped --data DATA --cache CACHE

Every photo of a set with truth is resampled as a barrel lens (k1 of SIMPLE_RADIAL) and an equidistant fisheye with the
same field of view would have taken it, about its true center. The photos are taken as having no lens themselves.
"""

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.cameras.methods import Method
from benchmarks.cameras.methods import run as run_method
from benchmarks.cameras.score import TruePhoto, accuracy, read_models
from benchmarks.cameras.worker import INCREMENTAL, OURS, RESULT
from benchmarks.common.command_line import new_parser
from benchmarks.common.photo_sets import PhotoSet
from benchmarks.common.results import RESULTS, Row, document, table, write
from sfm_app.camera.projection import image_rays
from sfm_app.camera.rows import PERSPECTIVE
from sfm_app.types import Intrinsics

FloatArray = NDArray[np.float64]
Source = Callable[[FloatArray, FloatArray], FloatArray]
"""Pixels (N, 2) of the photo as it is, from pixels (N, 2) of the resampled photo and K (3, 3)."""

SETS = ("fountain-P11", "castle-P19", "Herz-Jesus-P8")
BARREL_K1 = -0.22
COLUMNS = ("set", "lens", "method", "placed", "AUC@1", "AUC@5", "lens found", "seconds")
ABOUT = (
    "The Strecha sets as they are and resampled (bicubic) as other lenses would have taken them. AUC@1 may fall by at "
    f"most 0.05. barrel: k1 = {BARREL_K1}; fisheye: equidistant with the field of view of the photo. Stock is "
    "pycolmap's incremental mapper, told that all photos share a camera."
)


def barrel_source(pixels: FloatArray, K: FloatArray) -> FloatArray:
    """Return where a barrel lens's pixels lie in the photo without a lens; corners move inwards, so none is lost."""
    camera = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], BARREL_K1, *[0.0] * 7])
    return image_rays(pixels, camera, PERSPECTIVE)[:, :2] @ K[:2, :2].T + K[:2, 2]


def fisheye_source(pixels: FloatArray, K: FloatArray) -> FloatArray:
    """Return where the pixels of an equidistant lens with the same field of view lie in the photo without a lens."""
    about = (pixels - K[:2, 2]) / np.diag(K)[:2]
    edge = K[0, 2] / K[0, 0]  # of the left border, which stays in place
    radius = np.hypot(*about.T) * np.arctan(edge) / edge
    plane = about * (np.tan(radius) / np.maximum(np.hypot(*about.T), 1e-12))[:, None]
    return np.asarray(plane @ K[:2, :2].T + K[:2, 2], np.float64)


LENSES: Mapping[str, Source | None] = {"as it is": None, "barrel": barrel_source, "fisheye": fisheye_source}


def warp_folder(photos: Path, cameras: Mapping[str, FloatArray], source: Source | None, out: Path) -> None:
    """Write every photo as the lens would have taken it, without metadata; black where the photo shows nothing."""
    out.mkdir(parents=True, exist_ok=True)
    for name, K in cameras.items():
        photo = np.asarray(cv2.imread(str(photos / name), cv2.IMREAD_COLOR))
        height, width = photo.shape[:2]
        if source is not None:
            x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
            there = source(np.column_stack([x.ravel(), y.ravel()]), K).astype(np.float32) - np.float32(0.5)
            places = there.reshape(height, width, 2)
            photo = cv2.remap(photo, places, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT)
        cv2.imwrite(str(out / Path(name).with_suffix(".png").name), photo)


def run_set(name: str, lens: str, args: argparse.Namespace) -> list[Row]:
    """Run ours and stock on one set through one lens."""
    truth = json.loads((args.data / name / "cameras.json").read_text(encoding="utf-8"))["images"]
    cameras = {image["file"]: np.array(image["K"]) for image in truth}
    poses = {
        Path(image["file"]).stem: TruePhoto(
            np.array(image["K"]), np.column_stack([image["R"], image["t"]]), image["width"]
        )
        for image in truth
    }
    photos = args.cache / "warped" / f"{name}-{lens.replace(' ', '-')}"
    if not photos.exists():
        warp_folder(args.data / name / "images", cameras, LENSES[lens], photos)
    rows = []
    for method in (Method(OURS), Method(INCREMENTAL, INCREMENTAL)):
        out = args.cache / "warped-runs" / photos.name / method.name.replace(" ", "-")
        if not (args.keep and (out / RESULT).exists()):
            run_method(method, PhotoSet(photos.name, photos, {}, cameras="auto"), out)
        found = accuracy(read_models(out), poses, len(poses))
        rows.append({
            "set": name, "lens": lens, "method": method.name, "placed": f"{found['registered']}/{found['of']}",
            "AUC@1": found["AUC@1"], "AUC@5": found["AUC@5"], "lens found": lens_found(out),
            "seconds": round(sum(json.loads((out / RESULT).read_text(encoding="utf-8"))["seconds"].values()), 1),
        })  # fmt: skip
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    return rows


def lens_found(out: Path) -> str:
    """Return the projection, and k1, of the cameras that a run found before bundle adjustment."""
    path = out / "calibration.json"
    if not path.exists():
        return ""
    cameras = Intrinsics.from_dict(json.loads(path.read_text(encoding="utf-8"))).cameras.values()
    return ", ".join(
        camera.projection if camera.projection == "fisheye" else f"{camera.projection} {camera.radial:+.3f}"
        for camera in cameras
    )


def page(rows: Sequence[Row]) -> str:
    """Return the table."""
    return f"# Real photos through other lenses\n\n{ABOUT}\n\n{table([dict(row) for row in rows], COLUMNS)}"


def main() -> None:
    """Run all sets through all lenses, and publish after each."""
    parser = new_parser("lenses.warped", __doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with the sets")
    parser.add_argument("--cache", type=Path, required=True, help="keeps resampled photos and runs")
    parser.add_argument("--sets", nargs="+", default=list(SETS))
    parser.add_argument("--lenses", nargs="+", default=list(LENSES), choices=list(LENSES))
    parser.add_argument("--keep", action="store_true", help="do not run again what was run")
    parser.add_argument("--results", type=Path, default=RESULTS)
    args = parser.parse_args()
    rows: list[Row] = []
    for name in args.sets:
        for lens in args.lenses:
            rows += run_set(name, lens, args)
            options = {"sets": args.sets, "lenses": args.lenses}
            write(args.results, "lenses-warped", document("lenses.warped", ABOUT, options, {}, rows), page(rows))
    print(page(rows))


if __name__ == "__main__":
    main()
