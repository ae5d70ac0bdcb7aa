"""Blank areas of a photo, each of which may be sky: even, without depths, and brighter than most surfaces."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.view import DepthArray, GrayImage

LONGER_SIDE = 128
"""Cells along the longer side of a photo. Chosen on `railing`, where twice as many find no more of the sky."""
WINDOW_PX = 5
"""Side of the square in which gray levels vary little."""
MOST_VARIATION = 6.0
"""Largest standard deviation of the gray levels in it, as the mean over a cell. Skies of the real sets have 0.3 to 1.2,
noise and compression included; the ground of castle-P19 has 3, plain walls 1 to 2. Chosen by hand."""
OPEN_SHARE, KNOWN_SHARE = 0.2, 0.5
"""Share of the pixels of a cell with a depth: it is open below the first, known from the second. Chosen by hand."""
BRIGHT_RANK = 0.75
"""Share of the surfaces in a photo that are darker than a sky. Chosen on castle-P19 and `garden`, where skies have 1.0
and 0.81 and more, and most of castle-P19's ground and kitchen1000's furniture 0.0 to 0.4."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoAreas:
    """A photo in cells, and its blank areas; number 0 is everything else."""

    labels: NDArray[np.uint16]
    """(h, w) number of the area of each cell."""
    known: NDArray[np.bool_]
    """(h, w) whether at least half of a cell has a depth."""
    size: NDArray[np.int64]
    """(A,) cells of each area."""
    gray: NDArray[np.float64]
    """(A,) mean gray level of each area."""
    at_border: NDArray[np.bool_]
    """(A,) whether an area touches the border of the photo."""

    @property
    def blank(self) -> NDArray[np.bool_]:
        """(h, w) cells of all areas."""
        return self.labels > 0


def blank_areas(photo: GrayImage, depth: DepthArray) -> PhotoAreas:
    """Find the bright and even areas of a photo in which hardly any depth is known.

    Args:
        photo: (H, W).
        depth: (H, W), 0 where unknown.
    """
    gray = photo.astype(np.float32)
    mean = cv2.blur(gray, (WINDOW_PX, WINDOW_PX))
    variation = np.sqrt(np.maximum(cv2.blur(gray * gray, (WINDOW_PX, WINDOW_PX)) - mean * mean, 0))
    cells, known = _to_cells(gray), _to_cells((depth > 0).astype(np.float32))
    blank = (known < OPEN_SHARE) & (_to_cells(variation) <= MOST_VARIATION)
    labels = cv2.connectedComponents(blank.view(np.uint8), connectivity=4)[1]
    surfaces = known >= KNOWN_SHARE
    labels = _keep_bright(labels, cells, np.sort(cells[surfaces]))
    size = np.bincount(labels.ravel())
    at_border = np.zeros(len(size), bool)
    at_border[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
    at_border[0] = False
    return PhotoAreas(labels.astype(np.uint16), surfaces, size, _mean_gray(labels, cells), at_border)


def _keep_bright(
    labels: NDArray[np.int32], gray: NDArray[np.float32], surfaces: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Return the areas that are brighter than most surfaces, numbered from 1; 0 elsewhere.

    Args:
        labels: (h, w) of all areas.
        gray: (h, w) mean gray levels.
        surfaces: (S,) gray levels of what has a depth, ascending.
    """
    bright = np.searchsorted(surfaces, _mean_gray(labels, gray)) >= max(1.0, BRIGHT_RANK * len(surfaces))
    bright[0] = False
    return np.asarray((np.cumsum(bright) * bright)[labels])


def _mean_gray(labels: NDArray[np.signedinteger], gray: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.asarray(np.bincount(labels.ravel(), gray.ravel()) / np.maximum(np.bincount(labels.ravel()), 1))


def _to_cells(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (h, w) the means over cells of values (H, W)."""
    height, width = values.shape
    scale = min(1.0, LONGER_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)
