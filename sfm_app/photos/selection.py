"""Choice of photos: statistics of each, then copies and unusable photos are dropped."""

import json
import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from sfm_app.files import fingerprint, load_arrays, replace_atomically
from sfm_app.settings import PhotoSettings
from sfm_app.types import Photo, UnusablePhoto
from sfm_app.types.arrays import Float32Array

logger = logging.getLogger("sfm_app")

SIDE_PX = 32
"""Side of the thumbnails that are compared."""
COPY = "the same picture as"
"""Beginning of the reason of a copy, before the name of its original."""
READERS = ("sfm-app", "pillow", "opencv-contrib-python-headless")
"""Packages that decode and measure."""


class OPTIONS:
    """Constants of the statistics of photos and of the choice by them."""

    analysis_px: int = 1024
    """Longer side to which photos are reduced for measuring."""
    edge_percentile: int = 99
    """Percentile of the gradients that counts as edge slope; noise has smaller gradients."""
    noise_px: float = 1.5
    """Standard deviation of the blur that removes noise."""
    wide_px: int = 17
    """Width of the additional blur that edges are compared with."""
    block_px: int = 8
    """Side of the squares that are tested for one color."""
    min_sharpness_contrast: float = 4.0
    """Least contrast in gray levels at which sharpness is measured."""
    min_side_px: int = 200
    max_difference: float = 0.015
    """Largest RMS difference between copies, as a share of the contrast. Moving the camera sideways by a thousandth of
    the width gives more; saving a picture again, smaller or as JPEG, gives less."""
    min_contrast: float = 4.0
    """Least contrast in gray levels of pictures that are compared."""
    many_copies: float = 0.25
    """Share of copies from which on the camera hardly moves. Chosen by hand."""
    blurred: float = 0.85
    """Least share of their slope that edges of a blurred photo keep after one more blur. Sharp photos: 0.33 to 0.70. At
    0.85, a blur of 0.8 % of the width or a smear of 2.5 %, 1 to 5 % of the inliers remain."""
    blurred_margin: float = 0.15
    """Least excess of that share over the median photo's."""
    flat_share: float = 0.5
    """Least share of flat squares of screenshots and drawings."""
    odd_size_share: float = 0.2
    """A size is odd if a smaller share of the photos has it."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoStats:
    """A usable photo and its image statistics."""

    photo: Photo
    thumbnail: Float32Array
    """(SIDE_PX, SIDE_PX) upright and gray."""
    blur: float = 0.0
    """Share of their slope that edges keep after one more blur; near 1 if the photo is blurred."""
    flat: float = 0.0
    """Share of the picture in squares of one color."""
    file_bytes: int = 0
    """Size of its file: of two copies, the larger one lost less."""


def measure_photo(photo: Photo, upright: Image.Image) -> PhotoStats:
    """Measure the blur and flat areas of an upright photo, and make its thumbnail."""
    gray = upright.convert("L")
    small = gray.resize((SIDE_PX, SIDE_PX), Image.Resampling.LANCZOS, reducing_gap=6.0)
    return PhotoStats(photo, np.asarray(small, np.float32), edge_blur(gray), flat_share(gray))


def edge_blur(gray: Image.Image) -> float:
    """Return the share of their slope that edges keep after one more blur: the larger of both axes, in [0, 1]."""
    gray = gray.copy()
    gray.thumbnail((OPTIONS.analysis_px, OPTIONS.analysis_px), Image.Resampling.BOX)
    fine = cv2.GaussianBlur(np.asarray(gray, np.float32), (0, 0), OPTIONS.noise_px)
    if fine.std() < OPTIONS.min_sharpness_contrast or min(fine.shape) < OPTIONS.min_side_px:
        return 0.0
    wide = cv2.blur(fine, (OPTIONS.wide_px, 1)), cv2.blur(fine, (1, OPTIONS.wide_px))
    ratios = [_edge_slope(wide[k], 1 - k) / max(_edge_slope(fine, 1 - k), 1e-6) for k in (0, 1)]
    return round(min(max(ratios), 1.0), 3)


def flat_share(picture: Image.Image) -> float:
    """Return the share of small squares of the picture that have one color."""
    gray, block = np.asarray(picture), OPTIONS.block_px
    height, width = (side // block * block for side in gray.shape)
    if not height or not width:
        return 0.0
    rows = gray[:height, :width].reshape(height // block, block, width)  # whole rows first, for speed
    low, high = (ends.reshape(len(rows), -1, block) for ends in (rows.min(axis=1), rows.max(axis=1)))
    return float(np.mean(low.min(axis=2) == high.max(axis=2)))


def _edge_slope(image: Float32Array, axis: int) -> float:
    return float(np.percentile(np.abs(np.diff(image, axis=axis)), OPTIONS.edge_percentile))


def write_stats(
    path: Path, stats: Mapping[str, PhotoStats], digests: Mapping[str, str], options: PhotoSettings
) -> None:
    """Write the statistics of the photos that have a digest; all keys are paths in the folder."""
    stats = {name: one for name, one in stats.items() if name in digests}
    rows = [
        {"photo": one.photo.to_dict(), "values": [one.blur, one.flat, one.file_bytes], "digest": digests[name]}
        for name, one in stats.items()
    ]
    # thumbnails have whole gray levels
    thumbnails = np.array([one.thumbnail for one in stats.values()]).astype(np.uint8)
    known = {"read with": _fingerprint_reading(options), "names": list(stats), "rows": rows}
    with replace_atomically(path) as beside, beside.open("wb") as file:
        np.savez_compressed(file, known=np.array(json.dumps(known)), thumbnails=thumbnails)


def read_stats(path: Path, digests: Mapping[str, str], options: PhotoSettings) -> dict[str, PhotoStats]:
    """Return the statistics of photos with unchanged digests; none of a damaged file or another version."""
    try:
        arrays = load_arrays(path)
        known = json.loads(str(arrays["known"]))
        if known["read with"] != _fingerprint_reading(options):
            return {}
        entries = zip(known["names"], known["rows"], arrays["thumbnails"].astype(np.float32), strict=True)
        return {
            name: PhotoStats(Photo.from_dict(row["photo"]), thumbnail, *row["values"])
            for name, row, thumbnail in entries
            if digests.get(name) == row["digest"]
        }
    except Exception as err:  # decoders of damaged bytes raise all kinds of errors
        if path.exists():
            logger.info("the statistics of photos cannot be read; all photos are decoded again", exc_info=err)
        return {}


def _fingerprint_reading(options: PhotoSettings) -> str:
    return fingerprint(
        options.model_dump(include={"max_megapixels", "min_side_px"}), {name: version(name) for name in READERS}
    )


# Copies: one picture saved twice, smaller, or in another format. They add nothing and have no parallax.


def drop_duplicates(stats: Sequence[PhotoStats]) -> tuple[list[Photo], list[UnusablePhoto]]:
    """Return one photo per picture, masked, large, with EXIF or of many bytes, and its copies, in the given order."""
    from scipy.spatial import cKDTree

    photos = [one.photo for one in stats]
    order = sorted(range(len(stats)), key=lambda k: (_worth(stats[k]), -k), reverse=True)
    small = np.array([one.thumbnail for one in stats], np.float32).reshape(len(stats), SIDE_PX**2)
    contrast = small.std(axis=1)
    originals: set[int] = set()
    original_of: dict[int, int] = {}
    limits = OPTIONS.max_difference * np.maximum(contrast, OPTIONS.min_contrast)
    # rounding must not lose a row: the differences are computed again below
    similar = cKDTree(small).query_ball_point(small, 1.01 * SIDE_PX * limits + 1e-3, return_sorted=True)
    for k in order:
        others = [j for j in similar[k] if j in originals] if contrast[k] >= OPTIONS.min_contrast else []
        rms = np.sqrt(np.mean((small[others] - small[k]) ** 2, axis=1)) / max(contrast[k], OPTIONS.min_contrast)
        if rms.min(initial=np.inf) < OPTIONS.max_difference:
            original_of[k] = others[int(rms.argmin())]
        else:
            originals.add(k)
    copies = [UnusablePhoto(photos[k].label, f"{COPY} {photos[original_of[k]].label}") for k in sorted(original_of)]
    return [photos[k] for k in sorted(originals)], copies


def _worth(one: PhotoStats) -> tuple[bool, int, bool, int]:
    photo = one.photo
    has_exif = bool(photo.group or photo.prior or photo.gps)
    return bool(photo.mask), photo.width * photo.height, has_exif, one.file_bytes


def drop_unusable(stats: Sequence[PhotoStats]) -> tuple[list[PhotoStats], list[UnusablePhoto]]:
    """Return the usable photos, and the unusable ones: blurred photos, and screenshots among photos; in order."""
    median = float(np.median([one.blur for one in stats])) if stats else 0.0
    sizes = Counter(_size_key(one.photo) for one in stats)
    photographic = np.mean([one.flat < OPTIONS.flat_share for one in stats]) > 0.5 if stats else False
    usable, unusable = [], []
    for one in stats:
        odd = sizes[_size_key(one.photo)] < OPTIONS.odd_size_share * len(stats)
        if one.blur > max(OPTIONS.blurred, median + OPTIONS.blurred_margin):
            unusable.append(UnusablePhoto(one.photo.label, "blurred beyond use"))
        elif photographic and one.flat >= OPTIONS.flat_share and odd:
            unusable.append(UnusablePhoto(one.photo.label, "a screenshot or drawing, of another size"))
        else:
            usable.append(one)
    return usable, unusable


def _size_key(photo: Photo) -> tuple[int, int]:
    """Return the size independent of portrait or landscape orientation."""
    return min(photo.width, photo.height), max(photo.width, photo.height)
