"""Viewing rays of marks in photos, and what the photos of a model see."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.models.model import focal_px, posed_images, seen_points, viewing_rays
from sfm_app.colmap.types import Reconstruction
from sfm_app.scale.measuring import Sightlines
from sfm_app.scale.sighted_points import Sight
from sfm_app.types import Photo

FloatArray = NDArray[np.float64]

MOST_POINTS = 200_000
"""Most points of a model among which the nearest to a place are sought."""


class PosedPhotos:
    """The photos of a model on disk that have a pose.

    Args:
        model_dir: COLMAP's model.

    Raises:
        BackendError: it cannot be read.
    """

    def __init__(self, model_dir: Path) -> None:
        with translate_errors("reading the sparse model"):
            self._model = Reconstruction(model_dir)
            self._ids = {image.name: image.image_id for image in posed_images(self._model)}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the photos."""
        return tuple(self._ids)

    def __contains__(self, photo: str) -> bool:
        """Return whether a photo has a pose."""
        return photo in self._ids

    def sights(self, photo: str, pixels: FloatArray) -> list[Sight]:
        """Return the viewing rays of pixels.

        Args:
            photo: that has a pose.
            pixels: (N, 2) as it is laid out; pixel centers at +0.5.
        """
        number = self._ids[photo]
        with translate_errors("looking along the pixels of a photo"):
            rays = viewing_rays(self._model, number, pixels)
            focal = focal_px(self._model, number)
            center = np.asarray(self._model.images[number].projection_center(), np.float64)
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return [Sight(photo, center, ray, focal) for ray in rays]

    def sightlines(self) -> Sightlines:
        """Return the cameras, and which of them see which points."""
        with translate_errors("reading the sparse model"):
            found = seen_points(self._model, MOST_POINTS)
            ids = list(self._ids.values())
            centers = np.array([self._model.images[number].projection_center() for number in ids], np.float64)
            focals = np.array([focal_px(self._model, number) for number in ids])
            residual = float(self._model.compute_mean_reprojection_error())
        cameras = np.concatenate([np.full(len(rows), k, np.int64) for k, rows in enumerate(found.seen)])
        rows = np.concatenate(found.seen)
        order = np.argsort(rows, kind="stable")
        ends = np.cumsum(np.bincount(rows, minlength=len(found.points)))[:-1]
        return Sightlines(centers, focals, found.points, tuple(np.split(cameras[order], ends)), residual)


def layout_scale(photo: Photo, folder: Path) -> float:
    """Return how much smaller a photo is laid out than its file: 1 where it has its full size, or the file is gone.

    Args:
        photo: as it is laid out.
        folder: of the files.
    """
    if not photo.needs_copy:
        return 1.0
    try:
        with Image.open(folder / photo.path) as image:
            return max(photo.width, photo.height) / max(image.size)
    except OSError:
        return 1.0


def unrotate_pixels(photo: Photo, upright: FloatArray) -> FloatArray:
    """Return pixels of the upright photo as pixels of the photo as it is laid out, in the sensor's orientation.

    Args:
        photo: its size and by how much it is turned.
        upright: (N, 2) x and y in the upright photo, at its laid-out size.
    """
    x, y = upright[:, 0], upright[:, 1]
    if photo.turn_deg == 90:
        return np.column_stack([y, photo.height - x])
    if photo.turn_deg == 180:
        return np.column_stack([photo.width - x, photo.height - y])
    if photo.turn_deg == 270:
        return np.column_stack([photo.width - y, x])
    return np.asarray(upright)


def named_photos(photos: tuple[Photo, ...]) -> Mapping[str, Photo]:
    """Return photos by every name that a user may give them: path in the folder, name, and file name where it is one.

    Args:
        photos: all of them.
    """
    files: dict[str, list[Photo]] = {}
    for photo in photos:
        files.setdefault(photo.path.rpartition("/")[2], []).append(photo)
    alone = {name: found[0] for name, found in files.items() if len(found) == 1}
    return alone | {photo.name: photo for photo in photos} | {photo.path: photo for photo in photos}
