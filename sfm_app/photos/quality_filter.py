"""Photos that nothing can be learned from: blurred beyond use, and screenshots among photos. Never all of a set."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from sfm_app.photos.thumbnail_stats import Glance
from sfm_app.types import Photo, UnusablePhoto

BLURRED, BLURRED_MORE = 0.85, 0.15
"""Share of the slope that edges keep when they are blurred once more: at least that, and more than most others by that.
Sharp photos: 0.33 to 0.70. At 0.85, a blur of 0.8 % of the width or a smear of 2.5 %, 1 to 5 % of inliers are left."""
FLAT = 0.5
"""Share of a picture without any change from pixel to pixel: windows, menus, drawings."""
ODD = 0.2
"""A size that fewer of the photos have is an odd one."""


def screened(glances: Sequence[Glance]) -> tuple[list[Glance], list[UnusablePhoto]]:
    """Return what is of use, and what is not; both in the order given."""
    most = float(np.median([glance.blur for glance in glances])) if glances else 0.0
    sizes = Counter(_size(glance.photo) for glance in glances)
    photographic = np.mean([glance.flat < FLAT for glance in glances]) > 0.5 if glances else False
    kept, left_out = [], []
    for glance in glances:
        if glance.blur > max(BLURRED, most + BLURRED_MORE):
            left_out.append(UnusablePhoto(glance.photo.path, "blurred beyond use"))
        elif photographic and glance.flat >= FLAT and sizes[_size(glance.photo)] < ODD * len(glances):
            left_out.append(UnusablePhoto(glance.photo.path, "a screenshot or drawing, of another size"))
        else:
            kept.append(glance)
    return kept, left_out


def _size(photo: Photo) -> tuple[int, int]:
    """Return whichever way the camera was held."""
    return min(photo.width, photo.height), max(photo.width, photo.height)
