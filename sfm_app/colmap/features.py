"""COLMAP's SIFT features and raw matches, on CPU, without its geometric verification."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sfm_app.colmap.backend import counted, plain, pycolmap
from sfm_app.colmap.database import opened
from sfm_app.progress import Progress
from sfm_app.settings import MatchSettings


def extract_features(
    database: Path, photo_dir: Path, names: Sequence[str], options: MatchSettings, workers: int, progress: Progress,
    mask_dir: Path | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Find SIFT features of all photos; returns the options in force for the manifest.

    Where masks are given every photo needs one, NAME.png: COLMAP passes over photos without.
    """
    reader = pycolmap.ImageReaderOptions()
    if mask_dir is not None:
        reader.mask_path = mask_dir
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = options.max_image_size_px
    extraction.num_threads = workers
    extraction.use_gpu = False
    extraction.sift.max_num_features = options.max_features

    def call(token: Any) -> None:
        pycolmap.extract_features(
            database, photo_dir, list(names), reader_options=reader, extraction_options=extraction,
            device=pycolmap.Device.cpu, cancellation_token=token,
        )  # fmt: skip

    def done(reader: Any) -> int:
        return sum(reader.exists_keypoints(image_id) for image_id in range(1, len(names) + 1))

    _counted(call, database, done, ("features", len(names)), progress)
    return plain(extraction.todict())


def match_exhaustively(
    database: Path, photos: int, options: MatchSettings, workers: int, progress: Progress
) -> dict[str, Any]:
    """Match every photo with every other; returns the options in force for the manifest."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.skip_geometric_verification = True
    matching.num_threads = workers
    matching.use_gpu = False
    matching.sift.max_ratio = options.max_ratio

    def call(token: Any) -> None:
        pycolmap.match_exhaustive(
            database, matching_options=matching, device=pycolmap.Device.cpu, cancellation_token=token
        )

    def done(reader: Any) -> int:
        return int(reader.num_matched_image_pairs())

    _counted(call, database, done, ("matching", math.comb(photos, 2)), progress)
    return plain(matching.todict())


def _counted(
    call: Callable[[Any], None],
    database: Path,
    done: Callable[[Any], int],
    work: tuple[str, int],
    progress: Progress,
) -> None:
    """Run a COLMAP call and show how far it is, as read from the database.

    The reader is COLMAP's own SQLite, opened once before the call: a second SQLite in the process (Python's) would drop
    the locks of the first whenever it closes the file, and COLMAP aborts.
    """
    with opened(database) as reader:
        counted(call, lambda: done(reader), *work, progress)
