"""Features of photos by a method of two functions, in COLMAP's database and in parts that keep its descriptors.

A method gets pictures of the right size; its results are checked, scaled to the photos' pixels and freed of masked
points.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.atomic_io import replace_atomically
from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import panorama_names, write_keypoints
from sfm_app.errors import InputError, PluginError
from sfm_app.hashing import load_arrays
from sfm_app.photos.masks import read_mask
from sfm_app.photos.panoramas.feature_views import PanoramaViews
from sfm_app.plugins import FeatureMethod
from sfm_app.progress import track
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import ordered_map
from sfm_app.settings import MatchSettings
from sfm_app.tasks import Task
from sfm_app.types import Features


def find_features(method: FeatureMethod, names: Mapping[int, str], run: RunContext) -> None:
    """Write the features of every photo to its part, and its keypoints to the database.

    Args:
        method: of finding features.
        names: photos by id; those that have a part are skipped.
        run: the run.

    Raises:
        PluginError: the method raises, or returns invalid results.
    """
    place, panoramas = run.workspace, panorama_names(run.workspace.database)
    folders = _Folders(place.photos, run.mask_dir, place.feature_parts)
    find = Task(_find_and_save, method, run.settings.matching, folders)
    left = [
        _Wanted(photo, name, name in panoramas)
        for photo, name in names.items()
        if not part_path(photo, place.feature_parts).exists()
    ]
    found = track(run.progress, ordered_map(run.executor, find, left, run.workers), "features", len(left))
    for photo, keypoints in found:
        with translate_errors("writing keypoints"):
            write_keypoints(run.workspace.database, photo, keypoints)


@dataclass(frozen=True, slots=True)
class _Folders:
    """Where photos, masks and features are."""

    photos: Path
    masks: Path | None
    parts: Path


@dataclass(frozen=True, slots=True)
class _Wanted:
    """A photo whose features are wanted."""

    id: int
    name: str
    panorama: bool


def _find_and_save(
    method: FeatureMethod, options: MatchSettings, folders: _Folders, photo: _Wanted
) -> tuple[int, NDArray[np.float32]]:
    """Write the features of one photo to its part, and return its id and its keypoints."""
    pixels = read_pixels(folders.photos / photo.name)
    features, to_photo, size = _find_in_photo(method, photo.name, pixels, options, panorama=photo.panorama)
    keypoints = features.keypoints * to_photo
    if folders.masks is not None:
        used = read_mask(folders.masks, photo.name)
        column, row = np.clip(keypoints.astype(np.int64), 0, np.array(size) - 1).T
        seen = used[row, column]
        features, keypoints = features.select(seen), keypoints[seen]
    rows = np.arange(min(len(keypoints), options.max_features))
    _save(features.select(rows), part_path(photo.id, folders.parts))
    return photo.id, keypoints[rows].astype(np.float32)


def _find_in_photo(
    method: FeatureMethod, name: str, pixels: NDArray[np.uint8], options: MatchSettings, *, panorama: bool
) -> tuple[Features, NDArray[np.float64], tuple[int, int]]:
    """Return the features of one photo, the scale (x, y) that takes them to its pixels, and its size."""
    height, width = pixels.shape[:2]
    if panorama:
        return _find_in_views(method, name, pixels, options), np.ones(2), (width, height)
    longer = max(width, height)
    if longer > options.max_image_size_px:
        scale = options.max_image_size_px / longer
        size = max(1, round(width * scale)), max(1, round(height * scale))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    shown = pixels.shape[1], pixels.shape[0]
    features = _check_features(method, name, shown, _call_find(method, name, pixels, options))
    return features, np.array([width / shown[0], height / shown[1]]), (width, height)


def _find_in_views(method: FeatureMethod, name: str, pixels: NDArray[np.uint8], options: MatchSettings) -> Features:
    """Return the features of a panorama, found in its perspective views; the best of each view come first."""
    size = pixels.shape[1], pixels.shape[0]
    views = PanoramaViews.cover(size, options.max_image_size_px)
    pixels, found, ranks = views.shrink(pixels), [], []
    for view in range(len(views.rotations)):
        shown = views.render(pixels, view)
        features = _check_features(method, name, (views.side_px,) * 2, _call_find(method, name, shown, options))
        own = np.flatnonzero(views.is_nearest(features.keypoints, view))
        at = views.to_panorama(features.keypoints[own], view)
        found.append(Features(size, at, features.select(own).values))
        ranks.append(own)
    together = {key: np.concatenate([one.values[key] for one in found]) for key in found[0].values}
    every = Features(size, np.concatenate([one.keypoints for one in found]), together)
    return every.select(np.argsort(np.concatenate(ranks), kind="stable"))


def read_pixels(path: Path) -> NDArray[np.uint8]:
    """Return (H, W, 3) RGB of a photo as it is laid out.

    Raises:
        InputError: it can no longer be read.
    """
    data = np.fromfile(path, np.uint8)
    read = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION) if data.size else None
    if read is None:
        raise InputError(f"{path} can no longer be read", hint="run again with --from photos")
    return np.asarray(read, np.uint8)


def _call_find(method: FeatureMethod, name: str, pixels: NDArray[np.uint8], options: MatchSettings) -> Features:
    if method.find is None:
        raise PluginError(f"the features '{method.name}' have no `find`")
    try:
        return method.find(pixels, options)
    except Exception as err:  # a plug-in may raise anything
        raise method_error(method, f"failed on {name}: {type(err).__name__}: {err}") from err


def _check_features(method: FeatureMethod, name: str, size: tuple[int, int], features: Features) -> Features:
    """Return the features after checking that they are valid for a picture of this size."""
    points = np.asarray(features.keypoints, np.float64)
    if features.size != size:
        raise method_error(method, f"report a size of {features.size} for {name} instead of {size}")
    if points.ndim != 2 or points.shape[1] != 2 or any(len(value) != len(points) for value in features.values.values()):
        raise method_error(method, f"have arrays of other shapes than (N, 2) and (N, ...) for {name}")
    if not (np.isfinite(points).all() and (points >= 0).all() and (points <= size).all()):
        raise method_error(method, f"put keypoints outside of {name}")
    return Features(size, points, features.values)


def method_error(method: FeatureMethod, what: str) -> PluginError:
    """Return the error of a feature method.

    Args:
        method: the method.
        what: it did wrong.
    """
    return PluginError(f"the features '{method.name}' {what}", hint="choose others with --features")


def part_path(photo: int, folder: Path) -> Path:
    """Return the file that keeps the features of a photo until all are matched.

    Args:
        photo: id.
        folder: of the parts.
    """
    return folder / f"{photo:06d}.npz"


def _save(features: Features, path: Path) -> None:
    values = {f"value_{name}": value for name, value in features.values.items()}
    with replace_atomically(path) as beside:
        np.savez(beside, allow_pickle=False, size=np.array(features.size), keypoints=features.keypoints, **values)


def load_features(photo: int, folder: Path) -> Features:
    """Read the features of a photo from its part.

    Args:
        photo: id.
        folder: of the parts.
    """
    arrays = load_arrays(part_path(photo, folder))
    values = {name.removeprefix("value_"): value for name, value in arrays.items() if name.startswith("value_")}
    width, height = arrays["size"]
    return Features((int(width), int(height)), arrays["keypoints"], values)
