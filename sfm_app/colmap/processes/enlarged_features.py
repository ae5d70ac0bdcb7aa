"""COLMAP's SIFT features of photos at their own size, and of enlarged ones where these are few.

COLMAP doubles the size of every photo before it looks for features. That takes three quarters of the time and gives the
finest features, which are also the least exact ones: photos that show much do as well without.
"""

import copy
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import open_database

PHOTOS_AT_ONCE = 16
"""Photos after which features are entered: what a killed run does again. Chosen by hand."""


def find_as_needed(
    database: Path,
    photo_dir: Path,
    names: Sequence[str],
    how: tuple[pycolmap.ImageReaderOptions, pycolmap.FeatureExtractionOptions, int],
    token: pycolmap.CancellationToken,
) -> None:
    """Find SIFT features of photos that have none yet, and enter them. Ours.

    Args:
        database: holds the photos.
        photo_dir: folder with the photos.
        names: names of the photos.
        how: COLMAP's options for reading photos and masks, and for finding features; number of features below which a
            photo is enlarged.
        token: ends the work early.
    """
    reader, extraction, _ = how
    with open_database(database) as before:
        ids = {image.name: image.image_id for image in before.read_all_images()}
        left = [name for name in names if not before.exists_keypoints(ids[name])]
    for first in range(0, len(left), PHOTOS_AT_ONCE):
        some = left[first : first + PHOTOS_AT_ONCE]
        rich = _enter_rich(database, photo_dir, some, how, token)
        poor = [name for name in some if name not in rich]
        if poor and not token.is_cancelled:
            pycolmap.extract_features(
                database, photo_dir, poor, reader_options=reader, extraction_options=extraction,
                device=pycolmap.Device.cpu, cancellation_token=token,
            )  # fmt: skip


def _enter_rich(
    database: Path,
    photo_dir: Path,
    names: Sequence[str],
    how: tuple[pycolmap.ImageReaderOptions, pycolmap.FeatureExtractionOptions, int],
    token: pycolmap.CancellationToken,
) -> set[str]:
    """Enter the features of photos that have enough at their own size, and return their names."""
    reader, extraction, enough = how
    own = copy.deepcopy(extraction)
    own.sift.first_octave = 0
    with tempfile.TemporaryDirectory(prefix="sfm-app-features-") as folder:
        found = Path(folder) / "features.db"
        with open_database(found):
            pass  # COLMAP needs an existing file
        pycolmap.extract_features(
            found, photo_dir, list(names), reader_options=reader, extraction_options=own,
            device=pycolmap.Device.cpu, cancellation_token=token,
        )  # fmt: skip
        with open_database(found) as source, open_database(database) as target:
            of, to = ({image.name: image.image_id for image in one.read_all_images()} for one in (source, target))
            rich = {name for name in names if name in of and source.num_keypoints_for_image(of[name]) >= enough}
            for name in sorted(rich):
                keypoints, descriptors = source.read_keypoints(of[name]), source.read_descriptors(of[name])
                kept = _largest(keypoints, own.sift.max_num_features)
                rows = np.ascontiguousarray(descriptors.data[kept])
                target.write_keypoints(to[name], keypoints[kept])
                target.write_descriptors(to[name], pycolmap.FeatureDescriptors(descriptors.type, rows))
    return rich


def _largest(keypoints: NDArray[np.float32], most: int) -> NDArray[np.int64]:
    """Return the numbers of the keypoints (N, 6) with the largest scale, in their order; COLMAP keeps whole levels."""
    scale = np.hypot(keypoints[:, 2], keypoints[:, 4])
    return np.sort(np.argsort(-scale, kind="stable")[:most])
