"""The statistics of all photos in a file, so that a photo is decoded once for all runs."""

import json
import logging
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path

import numpy as np

from sfm_app.atomic_io import replace_atomically
from sfm_app.hashing import fingerprint, load_arrays
from sfm_app.photos.selection.thumbnail_stats import PhotoStats
from sfm_app.settings import PhotoSettings
from sfm_app.types import Photo

logger = logging.getLogger("sfm_app")

READERS = ("sfm-app", "pillow", "opencv-contrib-python-headless")
"""Packages that decode and measure."""
READ_WITH = {"max_megapixels", "min_side_px"}
"""Settings that decide how a file is read."""


def write_stats(
    path: Path, stats: Mapping[str, PhotoStats], digests: Mapping[str, str], options: PhotoSettings
) -> None:
    """Write the statistics of photos.

    Args:
        path: the file, replaced.
        stats: by path in the folder.
        digests: hash of the bytes of each file, by the same path; photos without one are left out.
        options: what they were read with.
    """
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

    Args:
        path: the file.
        digests: hash of the bytes of each file now, by path in the folder.
        options: what photos are read with.
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
