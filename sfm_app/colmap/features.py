"""COLMAP's SIFT features and raw matches, on CPU, without its geometric verification."""

import sqlite3
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from sfm_app.colmap.backend import interruptible, plain, pycolmap
from sfm_app.progress import Progress
from sfm_app.settings import MatchSettings


def extract_features(
    database: Path, photo_dir: Path, names: Sequence[str], options: MatchSettings, workers: int, progress: Progress
) -> dict[str, Any]:
    """Find SIFT features of all photos; returns the options in force for the manifest."""
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = options.max_image_size_px
    extraction.num_threads = workers
    extraction.use_gpu = False
    extraction.sift.max_num_features = options.max_features

    def call(token: Any) -> None:
        pycolmap.extract_features(
            database, photo_dir, list(names), extraction_options=extraction,
            device=pycolmap.Device.cpu, cancellation_token=token,
        )  # fmt: skip

    _counted(call, database, "keypoints", "features", len(names), progress)
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

    total = sum(1 for _ in combinations(range(photos), 2))
    _counted(call, database, "matches", "matching", total, progress)
    return plain(matching.todict())


def _counted(call: Any, database: Path, table: str, label: str, total: int, progress: Progress) -> None:
    """Run a COLMAP call and show how many rows it has added to a table."""
    progress.start(label, total)
    seen = 0

    def poll() -> None:
        nonlocal seen
        rows = _row_count(database, table)
        if rows > seen:
            progress.advance(rows - seen)
            seen = rows

    try:
        interruptible(call, poll)
        poll()
    finally:
        progress.finish()


def _row_count(database: Path, table: str) -> int:
    """Rows so far, read beside COLMAP's own connection; 0 while it holds the lock."""
    try:
        connection = sqlite3.connect(f"{database.absolute().as_uri()}?mode=ro", uri=True, timeout=0.1)
        try:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])  # noqa: S608
        finally:
            connection.close()
    except sqlite3.Error:
        return 0
