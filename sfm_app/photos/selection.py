"""Which photos are used: duplicates and unusable ones go."""

import json
import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.files import fingerprint, load_arrays, replace_atomically
from sfm_app.settings import PhotoSettings
from sfm_app.types import Photo, UnusablePhoto

# Measure a thumbnail, blur and flat areas of a photo: enough to compare it with the others.

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
    """Measure the blur and flat areas of a photo, and make its thumbnail."""
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


# The statistics of all photos in a file, so that a photo is decoded once for all runs.

logger = logging.getLogger("sfm_app")

READERS = ("sfm-app", "pillow", "opencv-contrib-python-headless")
"""Packages that decode and measure."""
READ_WITH = {"max_megapixels", "min_side_px"}
"""Settings that decide how a file is read."""


def write_stats(
    path: Path, stats: Mapping[str, PhotoStats], digests: Mapping[str, str], options: PhotoSettings
) -> None:
    """Write the statistics of photos."""
    kept = {name: one for name, one in stats.items() if name in digests}
    rows = [
        {"photo": one.photo.to_dict(), "blur": one.blur, "flat": one.flat, "digest": digests[name]}
        for name, one in kept.items()
    ]
    # thumbnails have whole gray levels
    thumbnails = np.array([one.thumbnail for one in kept.values()]).astype(np.uint8)
    known = {"read with": _fingerprint_reading(options), "names": list(kept), "rows": rows}
    with replace_atomically(path) as beside, beside.open("wb") as file:
        np.savez_compressed(file, known=np.array(json.dumps(known)), thumbnails=thumbnails)


def read_stats(path: Path, digests: Mapping[str, str], options: PhotoSettings) -> dict[str, PhotoStats]:
    """Return the statistics of the photos whose files are the same, by path in the folder.

    None are known if the file is missing, damaged, or of other settings or versions.
    """
    try:
        arrays = load_arrays(path)
        known = json.loads(str(arrays["known"]))
        if known["read with"] != _fingerprint_reading(options):
            return {}
        entries = zip(known["names"], known["rows"], arrays["thumbnails"].astype(np.float32), strict=True)
        return {
            name: PhotoStats(Photo.from_dict(row["photo"]), thumbnail, row["blur"], row["flat"])
            for name, row, thumbnail in entries
            if digests.get(name) == row["digest"]
        }
    except Exception as err:  # decoders of damaged bytes raise all kinds of errors
        if path.exists():
            logger.info("the statistics of photos cannot be read back; all photos are read again", exc_info=err)
        return {}


def _fingerprint_reading(options: PhotoSettings) -> str:
    return fingerprint(options.model_dump(include=READ_WITH), {name: version(name) for name in READERS})


# Find copies: one picture saved twice, smaller, or in another format. They add nothing and have no parallax.

MAX_DIFFERENCE = 0.015
"""Largest root mean square difference between copies, as a share of the contrast. Moving the camera sideways by a
thousandth of the width gives a larger difference; saving a picture again, smaller or as JPEG, a smaller one."""
LEAST_COMPARED_CONTRAST = 4.0
"""Gray levels; pictures with less contrast are not compared."""

COMPARED_BLOCK = 512
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
    near = _similar_rows(small, MAX_DIFFERENCE * np.maximum(contrast, LEAST_COMPARED_CONTRAST))
    for k in order:
        others = [j for j in near[k] if j in kept] if contrast[k] >= LEAST_COMPARED_CONTRAST else []
        off = np.sqrt(np.mean((small[others] - small[k]) ** 2, axis=1)) / max(contrast[k], LEAST_COMPARED_CONTRAST)
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
    for start in range(0, len(exact), COMPARED_BLOCK):
        part = slice(start, start + COMPARED_BLOCK)
        apart = squares[part, None] + squares - 2.0 * exact[part] @ exact.T
        close = apart < (1.01 * limits[part, None]) ** 2 * exact.shape[1] + 1e-3
        found += [np.flatnonzero(row).tolist() for row in close]
    return found


def _pixel_count(photo: Photo) -> int:
    return photo.width * photo.height


# Drop photos that cannot help: blurred beyond use, or screenshots among photos. Some photos always remain.

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
