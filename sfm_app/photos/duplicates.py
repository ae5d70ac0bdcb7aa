"""Find copies: one picture saved twice, smaller, or in another format. They add nothing and have no parallax."""

from collections.abc import Sequence

import numpy as np

from sfm_app.photos.thumbnail_stats import SIDE_PX, PhotoStats
from sfm_app.types import Photo, UnusablePhoto

MAX_DIFFERENCE = 0.015
"""Largest root mean square difference between copies, as a share of the contrast. Moving the camera sideways by a
thousandth of the width gives a larger difference; saving a picture again, smaller or as JPEG, a smaller one."""
LEAST_CONTRAST = 4.0
"""Gray levels; pictures with less contrast are not compared."""


def drop_duplicates(glances: Sequence[PhotoStats]) -> tuple[list[Photo], list[UnusablePhoto]]:
    """Return one photo per picture, and the copies of them; both in the order given.

    Of several copies, one with a mask is preferred, then the largest.
    """
    order = sorted(range(len(glances)), key=lambda k: (not glances[k].photo.mask, -_pixel_count(glances[k].photo), k))
    small = np.array([glance.thumbnail for glance in glances], np.float32).reshape(len(glances), SIDE_PX**2)
    contrast = small.std(axis=1)
    kept: list[int] = []
    same: dict[int, int] = {}
    for k in order:
        off = np.sqrt(np.mean((small[kept] - small[k]) ** 2, axis=1)) / max(contrast[k], LEAST_CONTRAST)
        if contrast[k] >= LEAST_CONTRAST and off.min(initial=np.inf) < MAX_DIFFERENCE:
            same[k] = kept[int(off.argmin())]
        else:
            kept.append(k)
    photos = [glances[k].photo for k in sorted(kept)]
    copies = [
        UnusablePhoto(glances[k].photo.path, f"the same picture as {glances[same[k]].photo.path}") for k in sorted(same)
    ]
    return photos, copies


def _pixel_count(photo: Photo) -> int:
    return photo.width * photo.height
