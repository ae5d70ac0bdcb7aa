"""Features of photos and matches of pairs, found by the chosen method, in COLMAP's database.

COLMAP's SIFT fills the database by itself. Any other method is two functions; `feature_parts` calls the first of them.
"""

import shutil
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfm_app.atomic_io import mark_unfinished, resume_or_clear
from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import photo_names, unmatched_pairs, write_matches
from sfm_app.colmap.features import find_and_match
from sfm_app.errors import PluginError
from sfm_app.estimation.feature_parts import find_features, load_features, method_error
from sfm_app.estimation.in_chunks.sift_chunks import find_in_chunks, match_in_chunks
from sfm_app.numerical import Json
from sfm_app.plugins import FeatureMethod
from sfm_app.progress import track
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.settings import MatchSettings
from sfm_app.tasks import Shared, Task
from sfm_app.types import Features, PairId

PHOTOS_IN_MEMORY = 32
"""Photos whose features are held in memory while pairs are matched; the others are read again."""


def fill_database(method: FeatureMethod, run: RunContext, pairs: Sequence[PairId] | None = None) -> dict[str, Json]:
    """Find features of photos and match them, in the run's database.

    Args:
        method: of finding and matching.
        run: its database lists the photos, which are laid out.
        pairs: the pairs to match, the smaller id first; features are found in their photos only. None for all pairs of
            all photos; without any pair, features are found in all photos.

    Returns:
        The options in force, for the manifest.

    Raises:
        PluginError: the method raises, or returns invalid results.
        BackendError: COLMAP failed.
    """
    in_force = find_all_features(method, run, pairs)
    in_force |= match_pairs(method, run, pairs)
    forget_features(run)
    return in_force


def find_all_features(method: FeatureMethod, run: RunContext, pairs: Sequence[PairId] | None = None) -> dict[str, Json]:
    """Find features of photos; those that a killed run has found are kept.

    Args:
        method, run, pairs: as in `fill_database`.

    Returns:
        The options in force, for the manifest.

    Raises:
        PluginError: the method raises, or returns invalid results.
        BackendError: COLMAP failed.
    """
    place, options = run.workspace, run.settings.matching
    names = photo_names(place.database)
    if pairs:
        names = {photo: names[photo] for photo in sorted({photo for pair in pairs for photo in pair})}
    if method.sift is not None and run.spread:
        return find_in_chunks(method.sift, list(names.values()), run)
    if method.sift is not None:
        return find_and_match(
            place.database, place.photos, list(names.values()), options, run.workers, run.progress, run.mask_dir,
            method.sift, (),
        )  # fmt: skip
    if not resume_or_clear(place.feature_parts, run.fingerprint):
        mark_unfinished(place.feature_parts, run.fingerprint)
    find_features(method, names, run)
    return {"method": method.name, "max_image_size": options.max_image_size_px, "max_features": options.max_features}


def match_pairs(method: FeatureMethod, run: RunContext, pairs: Sequence[PairId] | None = None) -> dict[str, Json]:
    """Match pairs of photos whose features are known; matches that a killed run has found are kept.

    Args:
        method: of matching.
        run: its database has the keypoints.
        pairs: the pairs to match, the smaller id first; None for all.

    Returns:
        The options in force, for the manifest.

    Raises:
        PluginError: the method raises, or returns invalid results.
        BackendError: COLMAP failed.
    """
    place, options = run.workspace, run.settings.matching
    if pairs is not None and not pairs:
        return {}
    if method.sift is not None and (run.spread or run.workers > 1):
        return match_in_chunks(method.sift, pairs, run)
    if method.sift is not None:
        return find_and_match(place.database, place.photos, [], options, 1, run.progress, sift=method.sift, pairs=pairs)
    _match(method, all_pairs(photo_names(place.database)) if pairs is None else pairs, run)
    return {}


def forget_features(run: RunContext) -> None:
    """Remove the parts of features, which are of no use once all pairs are matched.

    Args:
        run: the run.
    """
    shutil.rmtree(run.workspace.feature_parts, ignore_errors=True)


def all_pairs(photos: Sequence[int] | Mapping[int, str]) -> list[PairId]:
    """Return all pairs of photos, the smaller id first."""
    ids = sorted(photos)
    return [(first, second) for place, first in enumerate(ids) for second in ids[place + 1 :]]


def _match(method: FeatureMethod, pairs: Sequence[PairId], run: RunContext) -> None:
    """Write the matches of every pair into the database, also where there are none."""
    options, database = run.settings.matching, run.workspace.database
    reader = FeatureReader(run.workspace.feature_parts, max(PHOTOS_IN_MEMORY, 2 * run.workers))
    match = Task(_read_and_match, method, options, Shared(reader))
    left = unmatched_pairs(database, pairs)
    found = track(run.progress, ordered_map(run.executor, match, left, 2 * run.workers), "matching", len(left))
    for pair, rows in found:
        with translate_errors("writing matches"):
            write_matches(database, pair, rows)


class FeatureReader:
    """Reads the features of photos, and keeps those of some; in another process, it begins with none.

    Args:
        folder: of the parts of features.
        kept: photos whose features stay in memory.
    """

    def __init__(self, folder: Path, kept: int) -> None:
        self._made_of = folder, kept
        self.read = lru_cache(kept)(partial(load_features, folder=folder))

    def __reduce__(self) -> tuple[type["FeatureReader"], tuple[Path, int]]:
        return FeatureReader, self._made_of


def _read_and_match(
    method: FeatureMethod, options: MatchSettings, features: Shared[FeatureReader], pair: PairId
) -> tuple[PairId, NDArray[np.uint32]]:
    first, second = (features.value.read(photo) for photo in pair)
    return pair, _match_pair(method, (first, second), options)


def _match_pair(method: FeatureMethod, pair: tuple[Features, Features], options: MatchSettings) -> NDArray[np.uint32]:
    """Return (M, 2) rows of the matching features of two photos; none where a photo has no features."""
    if method.match is None:
        raise PluginError(f"the features '{method.name}' have no `match`")
    if not len(pair[0]) or not len(pair[1]):
        return np.zeros((0, 2), np.uint32)
    try:
        rows = np.asarray(method.match(*pair, options))
    except Exception as err:  # a plug-in may raise anything
        raise method_error(method, f"failed to match two photos: {type(err).__name__}: {err}") from err
    if rows.size == 0:
        return np.zeros((0, 2), np.uint32)
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.issubdtype(rows.dtype, np.integer):
        raise method_error(method, "have matches that are not (M, 2) integers")
    for column, features in zip(rows.T, pair, strict=True):
        if column.min() < 0 or column.max() >= len(features) or len(np.unique(column)) < len(column):
            raise method_error(method, "match a keypoint twice, or one that does not exist")
    return rows.astype(np.uint32)
