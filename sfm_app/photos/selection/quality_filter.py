"""Drop photos that cannot help: blurred beyond use, or screenshots among photos. Some photos always remain."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from sfm_app.photos.selection.thumbnail_stats import PhotoStats
from sfm_app.types import Photo, UnusablePhoto

BLURRED, BLURRED_MORE = 0.85, 0.15
"""A photo is blurred if, after one more blur, its edges keep more than the first share of their slope, and more than
the median photo's share plus the second.
Sharp photos: 0.33 to 0.70. At 0.85, a blur of 0.8 % of the width or a smear of 2.5 %, 1 to 5 % of inliers are left."""
FLAT_SHARE = 0.5
"""Share of a picture with no change from pixel to pixel; screenshots and drawings have more."""
ODD_SIZE_SHARE = 0.2
"""A size is odd if a smaller share of the photos has it."""


def drop_unusable(glances: Sequence[PhotoStats]) -> tuple[list[PhotoStats], list[UnusablePhoto]]:
    """Return the usable and the unusable photos, both in the order given."""
    most = float(np.median([glance.blur for glance in glances])) if glances else 0.0
    sizes = Counter(_size_key(glance.photo) for glance in glances)
    photographic = np.mean([glance.flat < FLAT_SHARE for glance in glances]) > 0.5 if glances else False
    kept, left_out = [], []
    for glance in glances:
        if glance.blur > max(BLURRED, most + BLURRED_MORE):
            left_out.append(UnusablePhoto(glance.photo.path, "blurred beyond use"))
        elif (
            photographic
            and glance.flat >= FLAT_SHARE
            and sizes[_size_key(glance.photo)] < ODD_SIZE_SHARE * len(glances)
        ):
            left_out.append(UnusablePhoto(glance.photo.path, "a screenshot or drawing, of another size"))
        else:
            kept.append(glance)
    return kept, left_out


def _size_key(photo: Photo) -> tuple[int, int]:
    """Return the size independent of portrait or landscape orientation."""
    return min(photo.width, photo.height), max(photo.width, photo.height)
