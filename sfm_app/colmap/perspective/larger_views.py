"""The undistorted photos of a dense workspace once more at another size, straight from the originals."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap, translate_errors
from sfm_app.colmap.models.model import posed_images
from sfm_app.colmap.perspective.view_model import PixelMaps
from sfm_app.colmap.wide_views import parse_view_name, perspective_lenses, render_views
from sfm_app.geometry.lenses.perspective_views import PerspectiveView
from sfm_app.geometry.lenses.projections import FX
from sfm_app.stereo import View

LargerView = tuple[str, NDArray[np.float64], NDArray[np.uint8], NDArray[np.bool_]]
"""Name of a view, its K (3, 3) in pixels, its gray levels (H, W), and which of its pixels may be used (H, W)."""


class LargerViews:
    """Undistorts photos again, as the dense workspace has them, but at another size.

    Args:
        model_dir: COLMAP model of the photos.
        photo_dir: the photos.
        mask_dir: their masks; None without masks.
        views: of the dense workspace; photos without any are left out.
        max_side_px: longest side of a view; none is larger than its photo.

    Raises:
        BackendError: COLMAP cannot read the model.
    """

    def __init__(
        self, model_dir: Path, photo_dir: Path, mask_dir: Path | None, views: Sequence[View], max_side_px: int
    ) -> None:
        self._photo_dir, self._mask_dir = photo_dir, mask_dir
        with translate_errors("reading the model"):
            model = pycolmap.Reconstruction(model_dir)
            lenses, images = (
                perspective_lenses(model, max_side_px),
                {image.name: image for image in posed_images(model)},
            )
        parts: dict[int, dict[int, PerspectiveView]] = {}
        self._camera, self._numbers = dict[str, int](), dict[str, dict[int, str]]()
        for view in views:
            # a photo that one view is enough for has its own name
            name, number = (view.name, 0) if view.name in images else parse_view_name(view.name)
            image = images[name]
            R = view.R @ image.cam_from_world().matrix()[:, :3].T
            focal_px = float(lenses[image.camera_id].params[FX])
            parts.setdefault(image.camera_id, {}).setdefault(number, _resize(view, R, focal_px, max_side_px))
            self._camera[name] = image.camera_id
            self._numbers.setdefault(name, {})[number] = view.name
        self._order = {key: sorted(found) for key, found in parts.items()}
        self._lenses = {
            key: replace(lenses[key], views=tuple(parts[key][k] for k in order)) for key, order in self._order.items()
        }
        self._maps = PixelMaps(model, self._lenses)

    @property
    def photos(self) -> list[str]:
        """Names of the photos, those of the same camera together: they show the same pixels."""
        return sorted(self._camera, key=lambda photo: (self._camera[photo], photo))

    def render(self, photo: str) -> Iterator[LargerView]:
        """Yield the views of a photo.

        Raises:
            BackendError: the photo cannot be read.
        """
        camera_id, names = self._camera[photo], self._numbers[photo]
        lens, maps = self._lenses[camera_id], self._maps.camera_maps(camera_id)
        with translate_errors(f"looking into {photo}"):
            pictures = render_views(photo, lens, self._photo_dir, self._mask_dir, maps)
            for number, view, (pixels, shown) in zip(self._order[camera_id], lens.views, pictures, strict=True):
                if number in names:
                    gray = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY), np.uint8)
                    yield names[number], view.K, gray, shown


def _resize(view: View, R: NDArray[np.float64], focal_px: float, max_side_px: int) -> PerspectiveView:
    """Return a view in the resolution of its photo, or smaller where its longest side would be too large."""
    scale = min(max_side_px / max(view.width, view.height), focal_px / float(view.K[0, 0]))
    width, height = max(1, round(scale * view.width)), max(1, round(scale * view.height))
    K = np.diag([width / view.width, height / view.height, 1.0]) @ view.K
    return PerspectiveView(R, np.asarray(K, np.float64), width, height)
