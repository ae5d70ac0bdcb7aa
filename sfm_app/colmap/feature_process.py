"""COLMAP's SIFT features and raw matches, on CPU, without its geometric verification; see `features.py`."""

import copy
import math
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.colmap.backend import json_options, pycolmap, run_with_progress
from sfm_app.colmap.database import open_database, panorama_names
from sfm_app.colmap.worker_process import FeatureTask, ProgressReporter, SiftOption, report, serve
from sfm_app.numerical import Json
from sfm_app.photos.decode import read_picture, upright_image
from sfm_app.photos.masks import read_mask
from sfm_app.photos.panoramas import PanoramaViews
from sfm_app.progress import Progress, track
from sfm_app.settings import MatchSettings

# COLMAP's SIFT features of photos at their own size, and of enlarged ones where these are few.
#
# COLMAP doubles the size of every photo before it looks for features. That takes three quarters of the time and
# gives the finest features, which are also the least exact ones: photos that show much do as well without.

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
        how: COLMAP's options for reading photos and masks, and for finding features; number of features below which a
            photo is enlarged.
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


# COLMAP's SIFT features of panoramas, found in perspective views and entered as keypoints of the panorama.


def extract_panoramas(
    database: Path,
    photo_dir: Path,
    names: Sequence[str],
    mask_dir: Path | None,
    extraction: pycolmap.FeatureExtractionOptions,
    progress: Progress,
) -> None:
    """Find SIFT features of panoramas that have none yet. Ours.

    Of too many features those of the largest scale are kept, as COLMAP does.

    Args:
        mask_dir: has a mask of every photo; None without masks.
        extraction: COLMAP's options; the largest size is that of one view.
    """
    with open_database(database) as reader:
        images = {image.name: image.image_id for image in reader.read_all_images()}
        left = [name for name in names if not reader.exists_keypoints(images[name])]
    for name in track(progress, left, "panoramas", len(left)) if left else ():
        keypoints, descriptors = _find_in_panorama(photo_dir / name, extraction)
        if mask_dir is not None:
            used = read_mask(mask_dir, name)
            column, row = np.clip(keypoints[:, :2].astype(np.int64), 0, np.array(used.shape[::-1]) - 1).T
            keypoints, descriptors = keypoints[used[row, column]], descriptors[used[row, column]]
        best = np.argsort(-keypoints[:, 2], kind="stable")[: extraction.sift.max_num_features]
        with open_database(database) as target:
            target.write_keypoints(images[name], np.ascontiguousarray(keypoints[best, :2], np.float32))
            target.write_descriptors(images[name], _to_descriptors(descriptors[best]))


def _find_in_panorama(
    path: Path, extraction: pycolmap.FeatureExtractionOptions
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return keypoints (N, 3), x and y in pixels of the panorama and the scale in a view, and descriptors (N, 128)."""
    pixels = np.asarray(upright_image(read_picture(path)).convert("RGB"), np.uint8)
    views = PanoramaViews.cover((pixels.shape[1], pixels.shape[0]), extraction.max_image_size)
    pixels = views.shrink(pixels)
    keypoints, descriptors = [np.zeros((0, 3))], [np.zeros((0, 128), np.uint8)]
    with tempfile.TemporaryDirectory(prefix="sfm-app-views-") as folder:
        names = [f"{view:02d}.png" for view in range(len(views.rotations))]
        for view, name in enumerate(names):
            Image.fromarray(views.render(pixels, view)).save(Path(folder) / name, compress_level=1)
        found = Path(folder) / "views.db"
        with open_database(found):
            pass  # COLMAP needs an existing file
        pycolmap.extract_features(found, Path(folder), names, extraction_options=extraction, device=pycolmap.Device.cpu)
        with open_database(found) as reader:
            images = {image.name: image.image_id for image in reader.read_all_images()}
            for view, name in enumerate(names):
                points = np.asarray(reader.read_keypoints(images[name]), np.float64)
                if not len(points):
                    continue  # a clear sky
                own = np.flatnonzero(views.is_nearest(points[:, :2], view))
                scale = np.sqrt(np.abs(points[own, 2] * points[own, 5] - points[own, 3] * points[own, 4]))
                keypoints.append(np.column_stack([views.to_panorama(points[own, :2], view), scale]))
                descriptors.append(np.asarray(reader.read_descriptors(images[name]).data, np.uint8)[own])
    return np.concatenate(keypoints), np.concatenate(descriptors)


def _to_descriptors(rows: NDArray[np.uint8]) -> pycolmap.FeatureDescriptors:
    return pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, np.ascontiguousarray(rows))


PLAIN = re.compile(r"[!-~]+")
"""Names that COLMAP reads from a list as they are: ASCII without blanks."""


def work(task: FeatureTask) -> None:
    """Find features of photos, match pairs of photos, and report the effective options."""
    do_task(task, ProgressReporter(), report)


def do_task(task: FeatureTask, progress: Progress, tell: Callable[..., None]) -> None:
    """Find features of photos, and match pairs of photos.

    Args:
        tell: called with the options in force, as `extraction` or `matching`.
    """
    database, photo_dir, names = Path(task["database"]), Path(task["photos"]), task["names"]
    options = MatchSettings.model_validate(task["options"])
    masks = Path(task["masks"]) if task["masks"] else None
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    if names:
        extraction = extraction_options(options, task["sift"], task["workers"])
        panoramas = panorama_names(database)
        extract_panoramas(
            database, photo_dir, [name for name in names if name in panoramas], masks, extraction, progress
        )
        plain = [name for name in names if name not in panoramas]
        if plain and task["sift"]:
            extract(database, photo_dir, plain, reader, extraction, progress)
        elif plain:
            how = reader, extraction, options.enlarge_below

            def call(token: pycolmap.CancellationToken) -> None:
                find_as_needed(database, photo_dir, plain, how, token)

            _run_with_progress(call, database, *_counter(database, plain), progress)
        tell(extraction=json_options(extraction.todict()))
    pairs = None if task["pairs"] is None else [(int(a), int(b)) for a, b in task["pairs"]]
    if pairs != []:
        tell(matching=match(database, options, task["workers"], pairs, progress))


def extraction_options(
    options: MatchSettings, sift: Mapping[str, SiftOption], workers: int
) -> pycolmap.FeatureExtractionOptions:
    """Return COLMAP's options for finding features."""
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = options.max_image_size_px
    extraction.num_threads = workers
    extraction.use_gpu = False
    extraction.sift.max_num_features = options.max_features
    for name, value in sift.items():
        setattr(extraction.sift, name, value)
    return extraction


def extract(
    database: Path,
    photo_dir: Path,
    names: Sequence[str],
    reader: pycolmap.ImageReaderOptions,
    extraction: pycolmap.FeatureExtractionOptions,
    progress: Progress,
) -> None:
    """Find SIFT features of all photos."""

    def call(token: pycolmap.CancellationToken) -> None:
        pycolmap.extract_features(
            database, photo_dir, list(names), reader_options=reader, extraction_options=extraction,
            device=pycolmap.Device.cpu, cancellation_token=token,
        )  # fmt: skip

    _run_with_progress(call, database, *_counter(database, names), progress)


def _counter(database: Path, names: Sequence[str]) -> tuple[Callable[[pycolmap.Database], int], tuple[str, int]]:
    """Return what counts the photos that have keypoints, and what a bar shows."""
    wanted = set(names)
    with open_database(database) as before:
        ids = [image.image_id for image in before.read_all_images() if image.name in wanted]
    return lambda reader: sum(reader.exists_keypoints(photo) for photo in ids), ("features", len(ids))


def match(
    database: Path,
    options: MatchSettings,
    workers: int,
    pairs: Sequence[tuple[int, int]] | None,
    progress: Progress,
) -> dict[str, Json]:
    """Match pairs of photos, and return the effective options.

    Args:
        pairs: ids of the photos of each pair; None for every photo with every other.
    """
    matching = pycolmap.FeatureMatchingOptions()
    matching.skip_geometric_verification = True
    matching.num_threads = workers
    matching.use_gpu = False
    matching.sift.max_ratio = options.max_ratio
    if pairs is not None:
        _match_pairs(database, matching, pairs, progress)
        return json_options(matching.todict())

    def call(token: pycolmap.CancellationToken) -> None:
        pycolmap.match_exhaustive(
            database, matching_options=matching, device=pycolmap.Device.cpu, cancellation_token=token
        )

    def count_finished(reader: pycolmap.Database) -> int:
        return int(reader.num_matched_image_pairs())

    with open_database(database) as reader:
        photos = reader.num_images()
    _run_with_progress(call, database, count_finished, ("matching", math.comb(photos, 2)), progress)
    return json_options(matching.todict())


def _match_pairs(
    database: Path,
    matching: pycolmap.FeatureMatchingOptions,
    pairs: Sequence[tuple[int, int]],
    progress: Progress,
) -> None:
    """Match pairs of photos.

    COLMAP's lists end names at blanks. Where a name has any, a copy of the database is matched in which photos are
    named by ids.
    """
    with open_database(database) as reader:
        names = {image.image_id: image.name for image in reader.read_all_images()}
    if all(PLAIN.fullmatch(name) for name in names.values()):
        with tempfile.TemporaryDirectory(dir=database.parent, prefix=".matching") as folder:
            _match_listed(database, matching, [(names[a], names[b]) for a, b in pairs], Path(folder), progress)
        return
    _match_in_copy(database, matching, pairs, progress)


def _match_in_copy(
    database: Path,
    matching: pycolmap.FeatureMatchingOptions,
    pairs: Sequence[tuple[int, int]],
    progress: Progress,
) -> None:
    with tempfile.TemporaryDirectory(dir=database.parent, prefix=".matching") as folder:
        copy = Path(folder) / database.name
        shutil.copyfile(database, copy)
        with open_database(copy) as renamed:
            renamed.clear_two_view_geometries()
            renamed.clear_matches()
            for image in renamed.read_all_images():
                image.name = str(image.image_id)
                renamed.update_image(image)
        _match_listed(copy, matching, [(str(a), str(b)) for a, b in pairs], Path(folder), progress)
        with open_database(copy) as found:
            rows = {pair: found.read_matches(*pair) for pair in pairs}
    with open_database(database) as target:
        for pair in (pair for pair in pairs if not target.exists_matches(*pair)):
            target.write_matches(*pair, rows[pair])


def _match_listed(
    database: Path,
    matching: pycolmap.FeatureMatchingOptions,
    pairs: Sequence[tuple[str, str]],
    folder: Path,
    progress: Progress,
) -> None:
    """Match pairs of photos by name; the folder gets a list of them."""
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = folder / "pairs.txt"
    pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="ascii", newline="\n")
    with open_database(database) as reader:
        before = int(reader.num_matched_image_pairs())

    def call(token: pycolmap.CancellationToken) -> None:
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu,
            cancellation_token=token,
        )  # fmt: skip

    def count_finished(reader: pycolmap.Database) -> int:
        return int(reader.num_matched_image_pairs()) - before

    _run_with_progress(call, database, count_finished, ("matching", len(pairs)), progress)


def _run_with_progress(
    call: Callable[[pycolmap.CancellationToken], None],
    database: Path,
    done: Callable[[pycolmap.Database], int],
    what: tuple[str, int],
    progress: Progress,
) -> None:
    """Run a COLMAP call, and show its progress as read from the database.

    The reader is COLMAP's own SQLite, opened once before the call: a second SQLite in the process (Python's) would drop
    the locks of the first whenever it closes the file, and COLMAP would abort.
    """
    with open_database(database) as reader:
        run_with_progress(call, lambda: done(reader), *what, progress)


if __name__ == "__main__":
    serve(work)
