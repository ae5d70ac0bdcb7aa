"""SIFT features and raw matches of all photos, written into the database by a separate process."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from sfm_app.colmap.processes.worker_process import FeatureTask, SiftOption, relay, start_worker
from sfm_app.numerical import Json
from sfm_app.progress import Progress
from sfm_app.settings import MatchSettings
from sfm_app.types import PairId

DEFAULT_SIFT: Mapping[str, SiftOption] = MappingProxyType({})
"""No options: COLMAP's defaults."""


def find_and_match(
    database: Path, photo_dir: Path, names: Sequence[str], options: MatchSettings, workers: int, progress: Progress,
    mask_dir: Path | None = None, sift: Mapping[str, SiftOption] = DEFAULT_SIFT, pairs: Sequence[PairId] | None = None,
) -> dict[str, Json]:  # fmt: skip
    """Find features of all photos and match every photo with every other; existing features and matches stay.

    Args:
        database: database file with the photos.
        photo_dir: folder with the photos.
        names: names of the photos.
        options: settings of features and matches.
        workers: threads.
        progress: shows a bar.
        mask_dir: has a mask of every photo, `name.png`: no keypoints where it is black.
        sift: options of COLMAP's SIFT that differ from its defaults.
        pairs: pairs of photos to match, instead of all.

    Returns:
        The effective options, for the manifest.

    Raises:
        BackendError: COLMAP failed.
    """
    task = feature_task(
        (database, photo_dir, mask_dir), names, options, workers, sift, None if pairs is None else list(pairs)
    )
    with start_worker("sfm_app.colmap.processes.feature_process", task) as process:
        found = relay(process, progress)
        process.check("matching photos" if found else "finding features")
    return found


def feature_task(
    paths: tuple[Path, Path, Path | None],
    names: Sequence[str],
    options: MatchSettings,
    workers: int,
    sift: Mapping[str, SiftOption],
    pairs: Sequence[PairId] | None,
) -> FeatureTask:
    """Return the task of a process that finds and matches features.

    Args:
        paths: database, photos, masks.
        names, options, workers, sift, pairs: as in `find_and_match`.
    """
    database, photo_dir, mask_dir = paths
    return {
        "database": str(database),
        "photos": str(photo_dir),
        "masks": str(mask_dir) if mask_dir else None,
        "names": list(names),
        "options": options.model_dump(),
        "workers": workers,
        "sift": dict(sift),
        "pairs": None if pairs is None else [list(pair) for pair in pairs],
    }
