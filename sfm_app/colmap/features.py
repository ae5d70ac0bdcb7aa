"""SIFT features and raw matches of all photos: a process of its own fills the database."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from sfm_app.colmap.processes.worker_process import FeatureTask, SiftOption, relay, started
from sfm_app.numerical import Json
from sfm_app.progress import Progress
from sfm_app.settings import MatchSettings
from sfm_app.types import PairId

USUAL: Mapping[str, SiftOption] = MappingProxyType({})
"""SIFT as COLMAP has it."""


def find_and_match(
    database: Path, photo_dir: Path, names: Sequence[str], options: MatchSettings, workers: int, progress: Progress,
    mask_dir: Path | None = None, sift: Mapping[str, SiftOption] = USUAL, pairs: Sequence[PairId] | None = None,
) -> dict[str, Json]:  # fmt: skip
    """Find features of all photos and match every photo with every other; what is in the database stays.

    Args:
        database: knows the photos.
        photo_dir: holds them.
        names: of the photos.
        options: of features and matches.
        workers: threads.
        progress: shown progress.
        mask_dir: has a mask of every photo, `name.png`: no keypoints where it is black.
        sift: options of COLMAP's SIFT that are not to be its defaults.
        pairs: of photos that are matched, instead of all.

    Returns:
        The options in force, for the manifest.

    Raises:
        BackendError: COLMAP failed.
    """
    task: FeatureTask = {
        "database": str(database),
        "photos": str(photo_dir),
        "masks": str(mask_dir) if mask_dir else None,
        "names": list(names),
        "options": options.model_dump(),
        "workers": workers,
        "sift": dict(sift),
        "pairs": None if pairs is None else [list(pair) for pair in pairs],
    }
    with started("sfm_app.colmap.processes.feature_process", task) as process:
        found = relay(process, progress)
        process.check("matching photos" if found else "finding features")
    return found
