"""The undistorted photos of a dense workspace once more at another size, straight from the originals."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap, translate_errors
from sfm_app.colmap.models.model import posed_images
from sfm_app.colmap.perspective.view_model import PixelMaps
from sfm_app.colmap.wide_views import perspective_lenses, render_views, split_wide_photos, view_name

LargerView = tuple[str, NDArray[np.float64], NDArray[np.uint8], NDArray[np.bool_]]
"""Name of a view, its K (3, 3) in pixels, its gray levels (H, W), and which of its pixels may be used (H, W)."""


class LargerViews:
    """Undistorts photos again, as the dense workspace has them, but at another size.

    Args:
        model_dir: COLMAP model of the photos.
        photo_dir: the photos.
        mask_dir: their masks; None without masks.
        max_side_px: longest side of a view; none is larger than its photo.

    Raises:
        BackendError: COLMAP cannot read the model.
    """

    def __init__(self, model_dir: Path, photo_dir: Path, mask_dir: Path | None, max_side_px: int) -> None:
        self._photo_dir, self._mask_dir = photo_dir, mask_dir
        split = split_wide_photos(model_dir, max_side_px)
        with translate_errors("reading the model"):
            model = pycolmap.Reconstruction(model_dir)
            self._lenses = split or perspective_lenses(model, max_side_px)
            self._camera = {image.name: image.camera_id for image in posed_images(model)}
        self._maps = PixelMaps(model, self._lenses)
        self._views = {name: self._view_names(name, split is not None) for name in sorted(self._camera)}

    def _view_names(self, photo: str, split: bool) -> list[str]:
        count = len(self._lenses[self._camera[photo]].views)
        return [view_name(photo, number) for number in range(count)] if split else [photo]

    def photos(self, names: Sequence[str]) -> list[str]:
        """Return the names of the photos that have any of some views, those of the same camera together.

        Args:
            names: of views.
        """
        wanted = set(names)
        found = [photo for photo, views in self._views.items() if wanted.intersection(views)]
        return sorted(found, key=lambda photo: (self._camera[photo], photo))

    def render(self, photo: str) -> Iterator[LargerView]:
        """Yield the views of a photo.

        Raises:
            BackendError: the photo cannot be read.
        """
        camera_id = self._camera[photo]
        lens, maps = self._lenses[camera_id], self._maps.camera_maps(camera_id)
        with translate_errors(f"looking into {photo}"):
            pictures = render_views(photo, lens, self._photo_dir, self._mask_dir, maps)
            for name, view, (pixels, shown) in zip(self._views[photo], lens.views, pictures, strict=True):
                yield name, view.K, np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8), shown
