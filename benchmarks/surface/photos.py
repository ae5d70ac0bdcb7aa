"""Compare a finished model with its photos: how much of them it covers, and how similar it is there."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.common.results import Row
from sfm_app.colmap.backend import pycolmap
from sfm_app.synthetic.render import Picture, PreparedModel, render_rays

Pixels = NDArray[np.uint8]
FloatArray = NDArray[np.float64]
BLACK = 32
"""Value of the brightest channel below which a pixel counts as black background."""
LEAST_PIXELS = 1000
"""Least number of covered pixels for a PSNR."""


@dataclass(frozen=True, slots=True, eq=False)
class PlacedPhoto:
    """A photo with its estimated camera, lens distortion included."""

    name: str
    pixels: Pixels
    """(H, W, 3) RGB."""
    center: FloatArray
    """(3,) center of the camera."""
    rays: FloatArray
    """(H, W, 3) directions in the world that the pixels see; their depth is 1."""
    camera: "pycolmap.Camera"
    cam_from_world: FloatArray
    """(3, 4)."""


@dataclass(frozen=True, slots=True)
class Likeness:
    """A model rendered into a photo's camera beside that photo."""

    coverage: float
    """Share of the pixels that show the model, 0..1."""
    not_black: float
    """Share of the photo's pixels that are not black background."""
    coverage_not_black: float
    """Share of those that show the model."""
    psnr_db: float
    """PSNR on the covered pixels after adjusting the rendering's exposure; nan where too few are covered."""


def placed_photos(out: Path) -> dict[str, "pycolmap.Image"]:
    """Read the registered photos of the finished run, by name."""
    model = pycolmap.Reconstruction(out / "sparse")
    return {image.name: image for image in sorted(model.images.values(), key=lambda i: i.name) if image.has_pose}


def placed_photo(out: Path, name: str, widest: int | None = None) -> PlacedPhoto:
    """Read one registered photo with its pixels and rays, reduced to `widest` pixels of width."""
    model = pycolmap.Reconstruction(out / "sparse")
    image = next(image for image in model.images.values() if image.name == name)
    camera, pose = model.cameras[image.camera_id], image.cam_from_world().matrix()
    picture = Image.open(out / "photos" / name).convert("RGB")
    if widest and camera.width > widest:
        camera.rescale(widest, round(camera.height * widest / camera.width))
        picture = picture.resize((camera.width, camera.height), Image.Resampling.BOX)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    plane = np.asarray(camera.cam_from_img(np.column_stack([x.ravel(), y.ravel()])), np.float64).reshape(-1, 2)
    rays = np.column_stack([plane, np.ones(len(plane))]) @ pose[:, :3]
    rays = rays.reshape(camera.height, camera.width, 3)
    return PlacedPhoto(name, np.asarray(picture), -pose[:, :3].T @ pose[:, 3], rays, camera, pose)


def render_view(model: PreparedModel, photo: PlacedPhoto) -> Picture:
    """Render the model into the photo's camera."""
    return render_rays(model, photo.center, photo.rays)


def likeness(picture: Picture, photo: Pixels) -> Likeness:
    """Compare a rendering with a photo of the same size: coverage, and PSNR where it covers the photo."""
    covered, lit = picture.covered, photo.max(axis=2) >= BLACK
    psnr = float("nan")
    if covered.sum() >= LEAST_PIXELS:
        psnr = psnr_db(picture.colors[covered], photo[covered])
    on_lit = float(covered[lit].mean()) if lit.any() else 0.0
    return Likeness(float(covered.mean()), float(lit.mean()), on_lit, psnr)


def psnr_db(rendering: Pixels, photo: Pixels) -> float:
    """Compute the PSNR of colors (N, 3) after a gain and an offset per channel compensate the exposure."""
    squares = []
    for a, b in zip(rendering.T.astype(np.float64), photo.T.astype(np.float64), strict=True):
        spread = a.var()
        gain = np.mean((a - a.mean()) * (b - b.mean())) / spread if spread > 0 else 0.0
        squares.append(np.mean((gain * (a - a.mean()) - (b - b.mean())) ** 2))
    return float(10.0 * np.log10(255.0**2 / max(float(np.mean(squares)), 1e-9)))


def photo_scores(found: Mapping[str, Likeness]) -> Row:
    """Average the scores over the photos, and give the worst of them."""
    coverage = [100.0 * one.coverage for one in found.values()]
    psnr = [one.psnr_db for one in found.values() if np.isfinite(one.psnr_db)]
    return {
        "coverage %": round(fmean(coverage), 1),
        "worst coverage %": round(min(coverage), 1),
        "not black %": round(100.0 * fmean(one.not_black for one in found.values()), 1),
        "coverage of not black %": round(100.0 * fmean(one.coverage_not_black for one in found.values()), 1),
        "PSNR dB": round(fmean(psnr), 2) if psnr else None,
        "worst PSNR dB": round(min(psnr), 2) if psnr else None,
    }


def subsample(names: list[str], count: int) -> list[str]:
    """Take `count` evenly spaced names, away from both ends where possible."""
    if count >= len(names):
        return names
    return [names[round(place)] for place in (np.arange(count) + 0.5) / count * (len(names) - 1)]
