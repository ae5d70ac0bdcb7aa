"""Find copies: one picture saved twice, smaller, or in another format. They add nothing and have no parallax."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfm_app.photos.selection.thumbnail_stats import SIDE_PX, PhotoStats
from sfm_app.types import Photo, UnusablePhoto

MAX_DIFFERENCE = 0.015
"""Largest root mean square difference between copies, as a share of the contrast. Moving the camera sideways by a
thousandth of the width gives a larger difference; saving a picture again, smaller or as JPEG, a smaller one."""
LEAST_CONTRAST = 4.0
"""Gray levels; pictures with less contrast are not compared."""

BLOCK = 512
"""Photos that are compared with all others at once."""


def drop_duplicates(glances: Sequence[PhotoStats]) -> tuple[list[Photo], list[UnusablePhoto]]:
    """Return one photo per picture, and the copies of them; both in the order given.

    Of several copies, one with a mask is preferred, then the largest.
    """
    order = sorted(range(len(glances)), key=lambda k: (not glances[k].photo.mask, -_pixel_count(glances[k].photo), k))
    small = np.array([glance.thumbnail for glance in glances], np.float32).reshape(len(glances), SIDE_PX**2)
    contrast = small.std(axis=1)
    kept: dict[int, None] = {}
    same: dict[int, int] = {}
    near = _similar_rows(small, MAX_DIFFERENCE * np.maximum(contrast, LEAST_CONTRAST))
    for k in order:
        others = [j for j in near[k] if j in kept] if contrast[k] >= LEAST_CONTRAST else []
        off = np.sqrt(np.mean((small[others] - small[k]) ** 2, axis=1)) / max(contrast[k], LEAST_CONTRAST)
        if off.min(initial=np.inf) < MAX_DIFFERENCE:
            same[k] = others[int(off.argmin())]
        else:
            kept[k] = None
    photos = [glances[k].photo for k in sorted(kept)]
    copies = [
        UnusablePhoto(glances[k].photo.path, f"the same picture as {glances[same[k]].photo.path}") for k in sorted(same)
    ]
    return photos, copies


def _similar_rows(small: NDArray[np.float32], limits: NDArray[np.floating]) -> list[list[int]]:
    """Return for each row (N, D) the rows whose root mean square difference is below its limit, or hardly above."""
    exact = small.astype(np.float64)
    squares, found = np.einsum("nd,nd->n", exact, exact), []
    for start in range(0, len(exact), BLOCK):
        part = slice(start, start + BLOCK)
        apart = squares[part, None] + squares - 2.0 * exact[part] @ exact.T
        close = apart < (1.01 * limits[part, None]) ** 2 * exact.shape[1] + 1e-3
        found += [np.flatnonzero(row).tolist() for row in close]
    return found


def _pixel_count(photo: Photo) -> int:
    return photo.width * photo.height
