"""Features and matches of all photos: by COLMAP, by plug-ins, and in chunks for several processes."""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import combinations
from pathlib import Path
from threading import Lock
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import panorama_names, photo_names, unmatched_pairs, write_keypoints, write_matches
from sfm_app.colmap.features import (
    FEATURES,
    MATCHES,
    Part,
    SiftInputs,
    SiftSettings,
    count_features,
    enter_rows,
    exhaustive_pairs,
    find_in_chunk,
    find_sift,
    match_chunk,
    match_chunk_apart,
    photos_without_features,
    write_inputs,
)
from sfm_app.colmap.worker_process import ProcessGroup, ProgressReporter, SiftOption, run_worker
from sfm_app.errors import InputError, PluginError
from sfm_app.files import load_arrays, mark_unfinished, replace_atomically, resume_or_clear
from sfm_app.photos.masks import read_mask
from sfm_app.photos.panoramas import PanoramaViews, shrink
from sfm_app.plugins import FeatureMethod
from sfm_app.progress import Progress, track
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.settings import MatchSettings
from sfm_app.tasks import Shared, Task
from sfm_app.types import Features, PairId
from sfm_app.types.arrays import ByteArray, Float32Array, FloatArray

# Features of photos by a plug-in, in COLMAP's database and in parts that keep its descriptors. The method gets
# pictures of the right size; its results are checked, scaled to the photos' pixels and freed of masked points.


def find_features(method: FeatureMethod, names: Mapping[int, str], run: RunContext) -> None:
    """Write the features of photos without a part, and keypoints to the database; PluginError if invalid."""
    place, panoramas = run.workspace, panorama_names(run.workspace.database)
    find = Task(_find_and_save, method, run.settings.matching, place.photos, run.mask_dir, place.feature_parts)
    photos = [
        _PhotoFile(photo, name, name in panoramas)
        for photo, name in names.items()
        if not part_path(photo, place.feature_parts).exists()
    ]
    features = track(run.progress, ordered_map(run.executor, find, photos, run.workers), "features", len(photos))
    for photo, keypoints in features:
        with translate_errors("writing keypoints"):
            write_keypoints(run.workspace.database, photo, keypoints)


@dataclass(frozen=True, slots=True)
class _PhotoFile:
    id: int
    name: str
    panorama: bool


def _find_and_save(
    method: FeatureMethod, options: MatchSettings, photos: Path, masks: Path | None, parts: Path, photo: _PhotoFile
) -> tuple[int, Float32Array]:
    pixels = read_pixels(photos / photo.name)
    features, to_photo, size = _find_in_photo(method, photo.name, pixels, options, panorama=photo.panorama)
    keypoints = features.keypoints * to_photo
    if masks is not None:
        mask = read_mask(masks, photo.name)
        column, row = np.clip(keypoints.astype(np.int64), 0, np.array(size) - 1).T
        unmasked = mask[row, column]
        features, keypoints = features.select(unmasked), keypoints[unmasked]
    rows = np.arange(min(len(keypoints), options.max_features))
    features = features.select(rows)
    values = {f"value_{name}": value for name, value in features.values.items()}
    with replace_atomically(part_path(photo.id, parts)) as beside:
        np.savez(beside, allow_pickle=False, size=np.array(features.size), keypoints=features.keypoints, **values)
    return photo.id, keypoints[rows].astype(np.float32)


def _find_in_photo(
    method: FeatureMethod, name: str, pixels: ByteArray, options: MatchSettings, *, panorama: bool
) -> tuple[Features, FloatArray, tuple[int, int]]:
    """Return the features of one photo, the scale (x, y) that takes them to its pixels, and its size."""
    height, width = pixels.shape[:2]
    if panorama:
        return _find_in_views(method, name, pixels, options), np.ones(2), (width, height)
    features = _find_and_check(method, name, shrink(pixels, options.max_image_size_px / max(width, height)), options)
    return features, np.array([width / features.size[0], height / features.size[1]]), (width, height)


def _find_in_views(method: FeatureMethod, name: str, pixels: ByteArray, options: MatchSettings) -> Features:
    """Return the features of a panorama from its perspective views; the best of each view come first."""
    size = pixels.shape[1], pixels.shape[0]
    views = PanoramaViews.cover(size, options.max_image_size_px)
    pixels, parts, ranks = views.shrink(pixels), [], []
    for view in range(len(views.rotations)):
        features = _find_and_check(method, name, views.render(pixels, view), options)
        own = np.flatnonzero(views.is_nearest(features.keypoints, view))
        keypoints = views.to_panorama(features.keypoints[own], view)
        parts.append(Features(size, keypoints, features.select(own).values))
        ranks.append(own)
    values = {key: np.concatenate([part.values[key] for part in parts]) for key in parts[0].values}
    joined = Features(size, np.concatenate([part.keypoints for part in parts]), values)
    return joined.select(np.argsort(np.concatenate(ranks), kind="stable"))


def read_pixels(path: Path) -> ByteArray:
    """Return (H, W, 3) RGB of a photo in the workspace; InputError if it can no longer be read."""
    data = np.fromfile(path, np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    if pixels is None:
        raise InputError(f"{path} can no longer be read", hint="run again with --from photos")
    return np.asarray(pixels, np.uint8)


def _find_and_check(method: FeatureMethod, name: str, pixels: ByteArray, options: MatchSettings) -> Features:
    if method.find is None:
        raise PluginError(f"the features '{method.name}' have no `find`")
    try:
        features = method.find(pixels, options)
    except Exception as err:  # a plug-in may raise anything
        raise _method_error(method, f"failed on {name}: {type(err).__name__}: {err}") from err
    size = pixels.shape[1], pixels.shape[0]
    points = np.asarray(features.keypoints, np.float64)
    if features.size != size:
        raise _method_error(method, f"report a size of {features.size} for {name} instead of {size}")
    if points.ndim != 2 or points.shape[1] != 2 or any(len(value) != len(points) for value in features.values.values()):
        raise _method_error(method, f"have arrays of other shapes than (N, 2) and (N, ...) for {name}")
    if not (np.isfinite(points).all() and (points >= 0).all() and (points <= size).all()):
        raise _method_error(method, f"put keypoints outside of {name}")
    return Features(size, points, features.values)


def _method_error(method: FeatureMethod, what: str) -> PluginError:
    return PluginError(f"the features '{method.name}' {what}", hint="choose others with --features")


def part_path(photo: int, folder: Path) -> Path:
    """Return the file that keeps the features of a photo until all are matched."""
    return folder / f"{photo:06d}.npz"


def load_features(photo: int, folder: Path) -> Features:
    """Read the features of a photo from its part in `folder`."""
    arrays = load_arrays(part_path(photo, folder))
    values = {name.removeprefix("value_"): value for name, value in arrays.items() if name.startswith("value_")}
    width, height = arrays["size"]
    return Features((int(width), int(height)), arrays["keypoints"], values)


# Chunks of pairs with few photos each, since every chunk makes its own indexes of features. A chunk grows photo by
# photo: the next is the one with most pairs among its photos.


def cut_pairs(pairs: Sequence[PairId], size: int) -> list[list[PairId]]:
    """Return all pairs in chunks of `size` > 0, the last perhaps smaller, whatever the order of the pairs."""
    names = sorted({photo for pair in pairs for photo in pair})
    number = {name: k for k, name in enumerate(names)}
    remaining: list[dict[int, PairId]] = [{} for _ in names]
    for pair in sorted(pairs, key=sorted):
        a, b = (number[photo] for photo in pair)
        remaining[a][b] = remaining[b][a] = pair
    chunks = list[list[PairId]]()
    while any(remaining):
        chunks.append(_grow_chunk(remaining, size))
    return chunks


def _grow_chunk(remaining: list[dict[int, PairId]], size: int) -> list[PairId]:
    """Take the pairs of one chunk out of the remaining ones, by photo and partner, and return them."""
    count = len(remaining)
    links, degree = np.zeros(count, np.int64), np.array([len(partners) for partners in remaining])
    outside, chunk = degree > 0, list[PairId]()
    while len(chunk) < size and outside.any():
        # of the photos with most links, the one that leaves fewest pairs to other chunks
        best = int(np.argmax(np.where(outside, links * (count + 1) + count - degree, -1)))
        inside = [other for other in remaining[best] if not outside[other]][: size - len(chunk)]
        for other in inside:
            chunk.append(remaining[best].pop(other))
            del remaining[other][best]
        degree[best] -= len(inside)
        outside[best] = False
        links[list(remaining[best])] += 1
    return chunk


# COLMAP's SIFT in chunks, on a cluster or in processes of this machine; this process enters their rows in order. Each
# process has one thread: with several, COLMAP's matcher loses matches now and then (of 1540 pairs of small photos,
# one or two differ in half of the runs).


class CHUNKS:
    """Sizes of chunks of work."""

    most_photos: int = 8
    """Photos whose features a worker detects at once: a process of COLMAP's takes a second to start. Chosen by hand."""
    chunk_s: float = 30.0
    """Seconds that a chunk of pairs should take. Chosen by hand."""
    feature_s: float = 1.1e-5
    """Seconds that a pair takes for each feature of its photos. An index of a photo's descriptors costs as much as 1.5
    pairs, and each chunk makes its own. Measured on castle-P19 and kitchen1000."""
    least_pairs: int = 64
    """Fewest pairs of a chunk. Chosen by hand."""
    most_pairs: int = 4096
    """Most pairs of a chunk. Chosen by hand."""
    photos_in_memory: int = 32
    """Photos whose features stay in memory while pairs are matched; the others are read again. Chosen by hand."""


Item = TypeVar("Item")


def find_in_chunks(sift: Mapping[str, SiftOption], names: Sequence[str], run: RunContext) -> None:
    """Find features of photos that have none on a cluster."""
    chosen = set(names)
    missing = [name for name in photos_without_features(run.workspace.database).values() if name in chosen]
    parts = chunks(missing, CHUNKS.most_photos, run.spread)
    _do_in_chunks(partial(Task, find_in_chunk), parts, FEATURES, sift, run)


def match_in_chunks(sift: Mapping[str, SiftOption], pairs: Sequence[PairId] | None, run: RunContext) -> None:
    """Match pairs, all if None, on a cluster or in processes of this machine, except those in the database."""
    database = run.workspace.database
    wanted = exhaustive_pairs(sorted(photo_names(database))) if pairs is None else pairs
    missing = unmatched_pairs(database, wanted)
    features = count_features(database)
    pair_s = CHUNKS.feature_s * max(sum(features) / max(len(features), 1), 1.0)
    most = min(max(int(CHUNKS.chunk_s / pair_s), CHUNKS.least_pairs), CHUNKS.most_pairs)
    parts = cut_pairs(missing, chunk_size(len(missing), most, run.spread or run.workers))
    if run.spread:
        _do_in_chunks(partial(Task, match_chunk), parts, MATCHES, sift, run)
        return
    group, counter = ProcessGroup(), _PairCounter(run.progress)
    try:
        _do_in_chunks(lambda inputs: partial(match_chunk_apart, inputs, group, counter), parts, MATCHES, sift, run)
    finally:
        group.stop()


class _PairCounter(Progress):
    def __init__(self, progress: Progress) -> None:
        self._progress, self._lock = progress, Lock()

    def advance(self, steps: int = 1) -> None:
        with self._lock:
            self._progress.advance(steps)


def chunks(items: Sequence[Item], most: int, workers: int) -> list[Sequence[Item]]:
    """Return items in chunks of about the same size, at most `most`, equally many for each worker."""
    size = chunk_size(len(items), most, workers)
    return [items[first : first + size] for first in range(0, len(items), size)]


def chunk_size(count: int, most: int, workers: int) -> int:
    """Return the items of each chunk, at most `most`, so that all workers get equally many chunks."""
    rounds = -(-count // (most * max(1, workers)))
    return max(1, -(-count // max(1, rounds * workers)))


def _do_in_chunks(
    prepare: Callable[[SiftInputs], Callable[[Sequence[Item]], Part]],
    parts: Sequence[Sequence[Item]],
    tables: tuple[str, str],
    sift: Mapping[str, SiftOption],
    run: RunContext,
) -> None:
    place, label = run.workspace, "matching" if tables is MATCHES else "features"
    folder = place.sift_rows
    shutil.rmtree(folder, ignore_errors=True)
    if not parts:
        return
    masks = run.mask_dir.absolute() if run.mask_dir else None
    settings = SiftSettings(place.photos.absolute(), masks, run.settings.matching, dict(sift))
    inputs = SiftInputs(settings, folder.absolute())
    write_inputs(place.database, inputs)
    run.progress.start(label, sum(len(part) for part in parts))
    try:
        for part in ordered_map(run.executor, prepare(inputs), parts, ahead=run.workers):
            enter_rows(place.database, part.path, tables)
            run.progress.advance(part.count)
    finally:
        run.progress.finish()
        shutil.rmtree(folder, ignore_errors=True)


# All features and matches, by COLMAP's SIFT or by a plug-in of two functions.


def fill_database(method: FeatureMethod, run: RunContext, pairs: Sequence[PairId] | None = None) -> None:
    """Find features of photos and match them, in the run's database.

    Features are computed in the photos of `pairs` only, with the smaller id first; for None, all photos and all pairs.
    Without any pair, all photos get features. PluginError if the method raises, or returns invalid results.
    """
    find_all_features(method, run, pairs)
    match_pairs(method, run, pairs)
    forget_features(run)


def find_all_features(method: FeatureMethod, run: RunContext, pairs: Sequence[PairId] | None = None) -> None:
    """Find features of photos, except those of a killed run; arguments and errors as in `fill_database`."""
    place, names = run.workspace, photo_names(run.workspace.database)
    if pairs:
        names = {photo: names[photo] for photo in sorted({photo for pair in pairs for photo in pair})}
    if method.sift is None:
        if not resume_or_clear(place.feature_parts, run.fingerprint):
            mark_unfinished(place.feature_parts, run.fingerprint)
        find_features(method, names, run)
    elif run.spread:
        find_in_chunks(method.sift, list(names.values()), run)
    else:
        settings = SiftSettings(place.photos, run.mask_dir, run.settings.matching, method.sift)
        find = partial(find_sift, place.database, settings, list(names.values()), run.workers, ProgressReporter())
        run_worker(find, "finding features", run.progress)


def match_pairs(method: FeatureMethod, run: RunContext, pairs: Sequence[PairId] | None = None) -> None:
    """Match pairs of photos with known features, except those of a killed run; see `fill_database`."""
    if pairs is not None and not pairs:
        return
    if method.sift is not None:
        match_in_chunks(method.sift, pairs, run)
    else:
        _match(method, all_pairs(photo_names(run.workspace.database)) if pairs is None else pairs, run)


def forget_features(run: RunContext) -> None:
    """Remove the parts of features, once all pairs are matched."""
    shutil.rmtree(run.workspace.feature_parts, ignore_errors=True)


def all_pairs(photos: Sequence[int] | Mapping[int, str]) -> list[PairId]:
    """Return all pairs of photos, the smaller id first."""
    return list(combinations(sorted(photos), 2))


def _match(method: FeatureMethod, pairs: Sequence[PairId], run: RunContext) -> None:
    options, database = run.settings.matching, run.workspace.database
    reader = FeatureReader(run.workspace.feature_parts, max(CHUNKS.photos_in_memory, 2 * run.workers))
    match = Task(_read_and_match, method, options, Shared(reader))
    unmatched = unmatched_pairs(database, pairs)
    matches = ordered_map(run.executor, match, unmatched, 2 * run.workers)
    for pair, rows in track(run.progress, matches, "matching", len(unmatched)):
        with translate_errors("writing matches"):
            write_matches(database, pair, rows)


class FeatureReader:
    """Reads the features of photos; those of `count` photos stay in memory. In another process it begins with none."""

    def __init__(self, folder: Path, count: int) -> None:
        self._arguments = folder, count
        self.read = lru_cache(count)(partial(load_features, folder=folder))

    def __reduce__(self) -> tuple[type["FeatureReader"], tuple[Path, int]]:
        return FeatureReader, self._arguments


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
        raise _method_error(method, f"failed to match two photos: {type(err).__name__}: {err}") from err
    if rows.size == 0:
        return np.zeros((0, 2), np.uint32)
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.issubdtype(rows.dtype, np.integer):
        raise _method_error(method, "have matches that are not (M, 2) integers")
    for column, features in zip(rows.T, pair, strict=True):
        if column.min() < 0 or column.max() >= len(features) or len(np.unique(column)) < len(column):
            raise _method_error(method, "match a keypoint twice, or one that does not exist")
    return rows.astype(np.uint32)
