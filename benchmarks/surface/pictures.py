"""A page of pictures per model: a photo, the model from its camera and from beside it, and its bare shape."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.colmap.backend import pycolmap
from sfm_app.synthetic.cameras import Camera
from sfm_app.synthetic.render import PreparedModel, comparison_image

Pixels = NDArray[np.uint8]
TALL_PX, WIDE_PX = 800, 1000
"""Largest height and width of one picture; a page has two by two of them."""
COLORS, PALETTE_PIXELS = 256, 20_000
"""Colors of a page, few to keep PNGs small, and the number of pixels that they are chosen from."""
WIDTHS_PX, BYTES = (1600, 1400, 1200, 1000, 800), 600_000
"""Widths of a page to try, and the largest file."""


def model_page(out: Path, name: str, model: PreparedModel) -> Pixels:
    """Draw photo and model from its camera, below them the model from beside and its bare shape: (H, W, 3)."""
    sparse = pycolmap.Reconstruction(out / "sparse")
    image = next(image for image in sparse.images.values() if image.name == name)
    camera, pose = sparse.cameras[image.camera_id], np.asarray(image.cam_from_world().matrix())
    photo = np.asarray(Image.open(out / "photos" / name).convert("RGB"))
    shrink = min(TALL_PX / camera.height, WIDE_PX / camera.width)
    size = round(camera.width * shrink), round(camera.height * shrink)
    K = np.diag([size[0] / camera.width, size[1] / camera.height, 1.0]) @ camera.calibration_matrix()
    return comparison_image(photo, model, Camera(K, *size), pose)


def save_page(page: Pixels, path: Path) -> None:
    """Write a PNG of at most `WIDTHS_PX[0]` pixels width and `BYTES`, in few colors; narrower if it would be larger."""
    path.parent.mkdir(parents=True, exist_ok=True)
    palette = Image.new("P", (1, 1))
    palette.putpalette(page_palette(page).tobytes())
    for width in WIDTHS_PX:
        shrink = min(1.0, width / page.shape[1])
        size = round(page.shape[1] * shrink), round(page.shape[0] * shrink)
        small = cv2.resize(page, size, interpolation=cv2.INTER_AREA)
        picture = Image.fromarray(small).quantize(palette=palette, dither=Image.Dither.NONE)
        picture.save(path, format="PNG", optimize=True)
        if path.stat().st_size <= BYTES:
            return


def page_palette(page: Pixels) -> Pixels:
    """Choose a palette (COLORS, 3) for a page: white, and k-means of a sample of its other pixels."""
    pixels = page[page.min(axis=2) < 255]
    if not len(pixels):
        return np.full((COLORS, 3), 255, np.uint8)
    some = pixels[np.random.default_rng(0).integers(0, len(pixels), PALETTE_PIXELS)].astype(np.float32)
    cv2.setRNGSeed(0)
    criteria = (cv2.TERM_CRITERIA_MAX_ITER, 10, 0.0)
    _, _, centers = cv2.kmeans(some, COLORS - 1, None, criteria, 1, cv2.KMEANS_PP_CENTERS)
    return np.append(np.round(np.clip(centers, 0, 255)).astype(np.uint8), np.full((1, 3), 255, np.uint8), axis=0)
