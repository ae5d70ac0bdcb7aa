#!/usr/bin/env python3
"""Draw the pictures of the tutorial from the rendered statue: python docs/figures/tutorial.py PHOTOS OUT

PHOTOS: those of `write_photo_folder` for the scene `statue`; OUT: a finished run of them.
"""

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image

import sfm_app
from sfm_app.colmap.dense import read_photo_and_depth
from sfm_app.products import read_texture
from sfm_app.report.pictures import depth_colors
from sfm_app.runtime.workspace import Workspace
from sfm_app.synthetic.cameras import Camera
from sfm_app.synthetic.render import PreparedModel, render_model, render_shape

PICTURES = Path(__file__).parents[1] / "pictures"
SHOWN, HEIGHT = 8, 220
"""Photos on the sheet, and the height of each in pixels."""
QUALITY = 82
Pixels = NDArray[np.uint8]


def draw_sheet(photos: Path) -> None:
    """Draw some of the photos side by side."""
    names = sorted(photos.glob("*.jpg"))
    chosen = [names[k] for k in np.linspace(0, len(names) - 1, SHOWN).astype(int)]
    row = [with_height(np.asarray(Image.open(name).convert("RGB")), HEIGHT) for name in chosen]
    half = SHOWN // 2
    save(np.vstack([np.hstack(row[:half]), np.hstack(row[half:])]), "photos.jpg")


def draw_steps(out: Path) -> None:
    """Draw a photo, the points seen from its place, its depths, the bare mesh, and the model."""
    run = sfm_app.read_run(out)
    if run.scene is None:
        raise SystemExit("the run has no scene")
    name = sorted(run.scene.registered)[3]
    photo, depth = read_photo_and_depth(out / "dense", name)
    found = run.scene.cameras[run.scene.camera_of[name]]
    factor = depth.shape[1] / found.width
    K = np.diag([factor, factor, 1.0]) @ found.K
    camera, pose = Camera(K, depth.shape[1], depth.shape[0]), run.scene.cam_from_world[name]
    model = PreparedModel(read_texture(Workspace(out)))
    size = depth.shape[1], depth.shape[0]
    parts = [
        cv2.resize(photo, size, interpolation=cv2.INTER_AREA),
        points_picture(run, name, size),
        depth_colors(np.asarray(depth, np.float64))[0],
        render_shape(model, camera, pose).with_background(),
        render_model(model, camera, pose).with_background(),
    ]
    save(np.hstack([with_height(np.asarray(part, np.uint8), 420) for part in parts]), "steps.jpg")


def points_picture(run: sfm_app.Run, name: str, size: tuple[int, int]) -> Pixels:
    """Draw the sparse points as the camera of a photo sees them."""
    assert run.scene is not None  # noqa: S101 - for the type checker
    arrays = run.scene.arrays
    row = arrays.photos.index(name)
    R, t = arrays.cam_from_world[row, :, :3], arrays.cam_from_world[row, :, 3]
    X = arrays.points @ R.T + t
    x = X @ arrays.K[row].T
    x = x[:, :2] / x[:, 2:] * (np.array(size) / arrays.sizes[row])
    picture = np.full((size[1], size[0], 3), 255, np.uint8)
    for place, color, depth in zip(x, arrays.colors, X[:, 2], strict=True):
        if depth > 0 and (place > 0).all() and (place < size).all():
            cv2.circle(picture, (int(place[0]), int(place[1])), 2, [int(value) for value in color], -1, cv2.LINE_AA)
    return picture


def draw_places(out: Path) -> None:
    """Draw from above where the photos were taken."""
    arrays = sfm_app.read_run(out).scene.arrays  # type: ignore[union-attr]
    figure, part = plt.subplots(figsize=(4.6, 4.2), layout="constrained")
    near = np.linalg.norm(arrays.points - np.median(arrays.points, axis=0), axis=1)
    shown = near < np.percentile(near, 97)
    part.scatter(arrays.points[shown, 0], -arrays.points[shown, 2], s=1, c=arrays.colors[shown] / 255)
    axes = arrays.cam_from_world[:, 2, :3]
    part.quiver(
        arrays.centers[:, 0], -arrays.centers[:, 2], axes[:, 0], -axes[:, 2], color="#1f6fb2", width=0.006, scale=14
    )
    part.scatter(
        arrays.centers[:, 0], -arrays.centers[:, 2], s=30, color="#1f6fb2", label="a photo, and where it looks"
    )
    part.set(aspect="equal", xticks=[], yticks=[])
    part.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, 0.0))
    for side in part.spines.values():
        side.set_visible(False)
    figure.savefig(PICTURES / "places.png", dpi=100, metadata={"Software": None})


def draw_report(out: Path) -> None:
    """Take a picture of the report in headless Chromium."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        print("no Chromium: report.jpg is left as it is")
        return
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "report.png"
        flags = ["--headless", "--no-sandbox", "--hide-scrollbars", "--use-gl=angle", "--use-angle=swiftshader"]
        more = ["--enable-unsafe-swiftshader", "--virtual-time-budget=20000", "--window-size=1100,1250"]
        command = [browser, *flags, *more, f"--screenshot={place}", (out / "report.html").resolve().as_uri()]
        subprocess.run(command, check=True, capture_output=True)  # noqa: S603 - our own page
        save(np.asarray(Image.open(place).convert("RGB")), "report.jpg")


def with_height(picture: Pixels, height: int) -> Pixels:
    """Return a picture at that height."""
    width = round(picture.shape[1] * height / picture.shape[0])
    return np.asarray(cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def save(picture: Pixels, name: str) -> None:
    """Write a picture into docs/pictures."""
    Image.fromarray(picture).save(PICTURES / name, quality=QUALITY, optimize=True)
    print(name, (PICTURES / name).stat().st_size // 1000, "kB")


if __name__ == "__main__":
    photo_folder, run_folder = map(Path, sys.argv[1:3])
    draw_sheet(photo_folder)
    draw_steps(run_folder)
    draw_places(run_folder)
    draw_report(run_folder)
