"""How well each photo is tied to a finished model: its points, their residuals, and where in the photo they lie."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap, translate_errors
from sfm_app.colmap.models.model import finite_mask, posed_images

CELLS = 8
"""Cells along each side of a photo whose share with points is its coverage. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class PhotoObservations:
    """What one photo sees of a model."""

    points: int
    residual_px: float
    """Mean distance between its keypoints and the points that they observe; NaN without any."""
    coverage: float
    """Share of its cells with a point in them."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelFigures:
    """Figures of a model."""

    photos: dict[str, PhotoObservations]
    """By name, of the posed photos."""
    tracks: NDArray[np.int64]
    """(P,) how many photos see each point."""
    places: NDArray[np.float64]
    """(P, 3) the points."""


def model_figures(model_dir: Path) -> ModelFigures:
    """Return the figures of a model on disk.

    Args:
        model_dir: COLMAP's model.

    Raises:
        BackendError: it cannot be read.
    """
    with translate_errors("reading the sparse model"):
        model = pycolmap.Reconstruction(model_dir)
        places = {key: np.asarray(point.xyz) for key, point in model.points3D.items()}
        photos = {image.name: _observe(image, model.cameras[image.camera_id], places) for image in posed_images(model)}
        keys = [key for key in sorted(places) if finite_mask(places[key])]
        tracks = np.array([model.points3D[key].track.length() for key in keys], np.int64)
    return ModelFigures(photos, tracks, np.array([places[key] for key in keys]).reshape(-1, 3))


def _observe(
    image: pycolmap.Image, camera: pycolmap.Camera, places: dict[int, NDArray[np.float64]]
) -> PhotoObservations:
    seen = image.get_observation_points2D()
    if not seen:
        return PhotoObservations(0, float("nan"), 0.0)
    pixels = np.array([point.xy for point in seen], np.float64)
    pose = image.cam_from_world().matrix()
    local = np.array([places[point.point3D_id] for point in seen]) @ pose[:, :3].T + pose[:, 3]
    off = np.linalg.norm(np.asarray(camera.img_from_cam(local), np.float64) - pixels, axis=1)
    cells = np.clip(pixels / (camera.width, camera.height) * CELLS, 0, CELLS - 1).astype(np.int64)
    coverage = len(np.unique(cells[:, 1] * CELLS + cells[:, 0])) / CELLS**2
    return PhotoObservations(len(seen), float(np.nanmean(off)), coverage)
