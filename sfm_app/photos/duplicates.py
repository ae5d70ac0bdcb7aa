"""Copies: the same picture saved twice, smaller, or as another format. They add nothing, and no pair has a parallax."""

from collections.abc import Sequence

import numpy as np

from sfm_app.photos.thumbnail_stats import SIDE_PX, Glance
from sfm_app.types import Photo, UnusablePhoto

ALIKE = 0.015
"""Root mean square difference, as a share of the contrast, of pictures that are one. A step of a thousandth of the
width to the side makes more of it; saving a picture anew, smaller or as JPEG, less."""
LEAST_CONTRAST = 4.0
"""Gray levels; of pictures with less nothing can be said."""


def without_copies(glances: Sequence[Glance]) -> tuple[list[Photo], list[UnusablePhoto]]:
    """Return the photos, of every picture the largest, of those with a mask where there are any; and the copies.

    Both in the order given.
    """
    order = sorted(range(len(glances)), key=lambda k: (not glances[k].photo.mask, -_pixels(glances[k].photo), k))
    small = np.array([glance.small for glance in glances], np.float32).reshape(len(glances), SIDE_PX**2)
    contrast = small.std(axis=1)
    kept: list[int] = []
    same: dict[int, int] = {}
    for k in order:
        off = np.sqrt(np.mean((small[kept] - small[k]) ** 2, axis=1)) / max(contrast[k], LEAST_CONTRAST)
        if contrast[k] >= LEAST_CONTRAST and off.min(initial=np.inf) < ALIKE:
            same[k] = kept[int(off.argmin())]
        else:
            kept.append(k)
    photos = [glances[k].photo for k in sorted(kept)]
    copies = [
        UnusablePhoto(glances[k].photo.path, f"the same picture as {glances[same[k]].photo.path}") for k in sorted(same)
    ]
    return photos, copies


def _pixels(photo: Photo) -> int:
    return photo.width * photo.height
