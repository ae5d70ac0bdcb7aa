"""What is kept of a photo once it has been looked at: enough to compare it with the others."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.types import Photo

SIDE_PX = 32
"""Side of the small pictures that are compared."""
LOOKED_AT_PX = 1024
"""Longer side at which photos are looked at; smaller ones as they are."""
EDGES = 99
"""Percentile of the slopes that counts as that of edges: noise is less steep."""
NOISE_PX, WIDE_PX = 1.5, 17
"""Blur that takes the noise away, and how wide what is compared with is blurred once more."""
BLOCK_PX = 8
"""Side of the squares that have one color or not."""
DIM, LEAST_PX = 4.0, 200
"""Gray levels of contrast, and pixels, below which nothing can be said about sharpness."""


@dataclass(frozen=True, slots=True, eq=False)
class Glance:
    """A usable photo, and what it looks like."""

    photo: Photo
    small: NDArray[np.float32]
    """(SIDE_PX, SIDE_PX) upright and gray."""
    blur: float = 0.0
    """Share of their slope that edges keep when they are blurred once more; near 1 where they are blurred already."""
    flat: float = 0.0
    """Share of the picture in which neighbors are alike to the last bit."""


def glance(photo: Photo, upright: Image.Image) -> Glance:
    """Measure blur and flat areas of a photo, and make it small.

    Args:
        photo: what is known of it.
        upright: its picture as people see it.
    """
    gray = upright.convert("L")
    return Glance(photo, small_picture(gray), blur_of(gray), flat_share(gray))


def small_picture(gray: Image.Image) -> NDArray[np.float32]:
    """Return what is compared to find copies."""
    return np.asarray(gray.resize((SIDE_PX, SIDE_PX), Image.Resampling.LANCZOS, reducing_gap=6.0), np.float32)


def blur_of(gray: Image.Image) -> float:
    """Return how much of their slope edges keep when they are blurred once more, in [0, 1].

    The worse of both directions.
    """
    gray = gray.copy()
    gray.thumbnail((LOOKED_AT_PX, LOOKED_AT_PX), Image.Resampling.BOX)
    fine = cv2.GaussianBlur(np.asarray(gray, np.float32), (0, 0), NOISE_PX)
    if fine.std() < DIM or min(fine.shape) < LEAST_PX:
        return 0.0
    wide = cv2.blur(fine, (WIDE_PX, 1)), cv2.blur(fine, (1, WIDE_PX))
    kept = [_edges(wide[k], 1 - k) / max(_edges(fine, 1 - k), 1e-6) for k in (0, 1)]
    return round(min(max(kept), 1.0), 3)


def flat_share(picture: Image.Image) -> float:
    """Return share of the picture, in small squares, that has one color."""
    gray = np.asarray(picture)
    height, width = (side // BLOCK_PX * BLOCK_PX for side in gray.shape)
    squares = gray[:height, :width].reshape(height // BLOCK_PX, BLOCK_PX, width // BLOCK_PX, BLOCK_PX)
    return float(np.mean(np.ptp(squares, axis=(1, 3)) == 0)) if squares.size else 0.0


def _edges(image: NDArray[np.float32], axis: int) -> float:
    return float(np.percentile(np.abs(np.diff(image, axis=axis)), EDGES))
