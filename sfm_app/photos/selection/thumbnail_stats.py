"""Measure a thumbnail, blur and flat areas of a photo: enough to compare it with the others."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.types import Photo

SIDE_PX = 32
"""Side of the small pictures that are compared."""
ANALYSIS_PX = 1024
"""Longer side to which photos are downsampled for measuring; smaller ones are not resized."""
EDGE_PERCENTILE = 99
"""Percentile of the gradients that counts as edge slope; noise has smaller gradients."""
NOISE_PX, WIDE_PX = 1.5, 17
"""Standard deviation of the blur that removes noise, and width of the further blur that edges are compared with."""
BLOCK_PX = 8
"""Side of the squares that are tested for having one color."""
LEAST_CONTRAST, LEAST_PX = 4.0, 200
"""Contrast in gray levels and shorter side in pixels, below which sharpness is not measured."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoStats:
    """A usable photo and its image statistics."""

    photo: Photo
    thumbnail: NDArray[np.float32]
    """(SIDE_PX, SIDE_PX) upright and gray."""
    blur: float = 0.0
    """Share of their slope that edges keep when they are blurred once more; near 1 if the photo is already blurred."""
    flat: float = 0.0
    """Share of the picture in which neighboring pixels are exactly equal."""


def measure_photo(photo: Photo, upright: Image.Image) -> PhotoStats:
    """Measure the blur and flat areas of a photo, and make its thumbnail.

    Args:
        photo: metadata.
        upright: its picture, upright.
    """
    gray = upright.convert("L")
    return PhotoStats(photo, make_thumbnail(gray), edge_blur(gray), flat_share(gray))


def make_thumbnail(gray: Image.Image) -> NDArray[np.float32]:
    """Return the thumbnail that is compared to find copies."""
    return np.asarray(gray.resize((SIDE_PX, SIDE_PX), Image.Resampling.LANCZOS, reducing_gap=6.0), np.float32)


def edge_blur(gray: Image.Image) -> float:
    """Return the share of their slope that edges keep when they are blurred once more, in [0, 1].

    The larger value of the horizontal and vertical directions.
    """
    gray = gray.copy()
    gray.thumbnail((ANALYSIS_PX, ANALYSIS_PX), Image.Resampling.BOX)
    fine = cv2.GaussianBlur(np.asarray(gray, np.float32), (0, 0), NOISE_PX)
    if fine.std() < LEAST_CONTRAST or min(fine.shape) < LEAST_PX:
        return 0.0
    wide = cv2.blur(fine, (WIDE_PX, 1)), cv2.blur(fine, (1, WIDE_PX))
    kept = [_edge_slope(wide[k], 1 - k) / max(_edge_slope(fine, 1 - k), 1e-6) for k in (0, 1)]
    return round(min(max(kept), 1.0), 3)


def flat_share(picture: Image.Image) -> float:
    """Return the share of small squares of the picture that have one color."""
    gray = np.asarray(picture)
    height, width = (side // BLOCK_PX * BLOCK_PX for side in gray.shape)
    if not height or not width:
        return 0.0
    rows = gray[:height, :width].reshape(height // BLOCK_PX, BLOCK_PX, width)  # whole rows first: many times as fast
    low, high = (ends.reshape(len(rows), -1, BLOCK_PX) for ends in (rows.min(axis=1), rows.max(axis=1)))
    return float(np.mean(low.min(axis=2) == high.max(axis=2)))


def _edge_slope(image: NDArray[np.float32], axis: int) -> float:
    return float(np.percentile(np.abs(np.diff(image, axis=axis)), EDGE_PERCENTILE))
