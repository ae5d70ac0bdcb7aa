"""COLMAP's SIFT features and raw matches, on the CPU and without its geometric verification.

One worker process finds the features of a whole run. Workers of a cluster find those of a few photos each, and any
worker matches a few pairs: SQLite does not work over a network, so only one process opens the run's database. Workers
copy a snapshot without features into a folder of their own, let COLMAP fill it, and leave the new rows as a file in the
output folder.
"""

import contextlib
import copy
import math
import secrets
import shutil
import sqlite3
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from PIL import Image

from sfm_app.colmap.backend import pycolmap, run_with_progress, translate_errors
from sfm_app.colmap.database import open_database, panorama_names
from sfm_app.colmap.worker_process import ProcessGroup, ProgressReporter, SiftOption
from sfm_app.files import replace_atomically
from sfm_app.numerical import local_deviation
from sfm_app.photos.decode import read_picture, upright_image
from sfm_app.photos.masks import read_mask
from sfm_app.progress import Progress
from sfm_app.settings import MatchSettings
from sfm_app.types import PairId
from sfm_app.types.arrays import ByteArray, FloatArray

Token: TypeAlias = pycolmap.CancellationToken
Extraction: TypeAlias = pycolmap.FeatureExtractionOptions
Size: TypeAlias = tuple[int, int]
"""Width and height in pixels."""


@dataclass(frozen=True, slots=True)
class SiftSettings:
    """Photos and options of SIFT."""

    photos: Path
    masks: Path | None
    """Folder with a mask of every photo, `name.png`: no keypoints where it is black. None without masks."""
    options: MatchSettings
    sift: Mapping[str, SiftOption] = field(default_factory=dict)
    """Options of COLMAP's SIFT that differ from its defaults."""


MOST_GAIN = 4.0
"""Largest gain of local contrast in a flat photo. Chosen on walnut12: with 10, noise gives wrong matches."""
FLAT_WINDOW_PX, FLAT_GRAY, FLAT_SHARE = 7, 5.0, 0.1
"""A photo is flat where fewer windows than this share have this standard deviation of gray levels. A tenth of them
has 1.5 to 2.4 in photos of walnut12 and bathtub23, and 10 to 34 in those of ten other sets."""

SiftFeatures: TypeAlias = tuple[FloatArray, ByteArray]
"""Keypoints (N, 6) in pixels, with their shapes as in COLMAP's database, and descriptors (N, 128)."""


def find_sift(database: Path, settings: SiftSettings, names: Sequence[str], workers: int, progress: Progress) -> None:
    """Find features of photos that have none yet.

    COLMAP doubles the size of every photo before it looks for features. That takes three quarters of the time, and
    gives the finest features, which are also the least exact ones. Without options, only photos with few features at
    their own size are enlarged.
    """
    extraction, panoramas = _extraction_options(settings, workers), panorama_names(database)
    with open_database(database) as reader:
        ids = {image.name: image.image_id for image in reader.read_all_images()}
        cameras = {camera.camera_id: (camera.width, camera.height) for camera in reader.read_all_cameras()}
        sizes = {image.name: cameras[image.camera_id] for image in reader.read_all_images()}
        new = [name for name in names if not reader.exists_keypoints(ids[name])]
    batch = 4 * workers  # photos after which features are entered: what a killed run does again; chosen by hand

    def call(token: Token) -> None:
        for first in range(0, len(new), batch):
            some = {name: sizes[name] for name in new[first : first + batch]}
            features = _find_in_photos({k: some[k] for k in some.keys() - panoramas}, settings, extraction, token)
            for name in some.keys() & panoramas:
                features[name] = _find_in_panorama(name, settings, extraction, token)
            if token.is_cancelled:
                return
            with open_database(database) as target:
                for name, (keypoints, values) in sorted(features.items()):
                    target.write_keypoints(ids[name], np.ascontiguousarray(keypoints, np.float32))
                    descriptors = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, values)
                    target.write_descriptors(ids[name], descriptors)

    def count(reader: pycolmap.Database) -> int:
        return sum(reader.exists_keypoints(ids[name]) for name in new)

    if new:
        _run_with_progress(call, database, count, "features", len(new), progress)


def _extraction_options(settings: SiftSettings, workers: int) -> Extraction:
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = settings.options.max_image_size_px
    extraction.num_threads = workers
    extraction.use_gpu = False
    extraction.sift.max_num_features = settings.options.max_features
    extraction.sift.first_octave = -1 if settings.sift else 0
    for name, value in settings.sift.items():
        setattr(extraction.sift, name, value)
    return extraction


def _find_in_photos(
    sizes: Mapping[str, Size], settings: SiftSettings, extraction: Extraction, token: Token
) -> dict[str, SiftFeatures]:
    """Return the features of photos by name, of photos with few after enlarging them."""
    options, masks = settings.options, settings.masks
    features = _drop_masked(_extract(settings.photos, sizes, extraction, token), masks)
    if settings.sift:
        return features
    poor, pictures = dict[str, Size](), dict[str, ByteArray]()
    for name, count in sorted((name, len(found[0])) for name, found in features.items()):
        photo = _read_gray(settings.photos / name) if count < options.enlarge_below else None
        if photo is not None and _is_flat(photo, options):
            pictures[name] = _enlarge(_equalize(photo), options)
        elif count < math.ceil(options.enlarge_below / 2):
            poor[name] = sizes[name]
        elif photo is not None:
            pictures[name] = _enlarge(photo, options)
    doubled = copy.deepcopy(extraction)
    doubled.sift.first_octave = -1
    features |= _drop_masked(_extract(settings.photos, poor, doubled, token), masks)
    for name, (keypoints, values) in _extract_pictures(pictures, extraction, token).items():
        scale = np.array(sizes[name]) / pictures[name].shape[1::-1]
        features[name] = keypoints * scale[[0, 1, 0, 0, 1, 1]], values
    features = _drop_masked(features, masks)
    return {name: _largest(found, options.max_features) for name, found in features.items()}


def _read_gray(path: Path) -> ByteArray | None:
    """Return a photo (H, W); None if OpenCV cannot read it."""
    photo = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    return None if photo is None else np.asarray(photo, np.uint8)


def _is_flat(photo: ByteArray, options: MatchSettings) -> bool:
    """Return whether a photo is so dark, hazy or plain that SIFT's contrast threshold hides its texture."""
    scale = min(1.0, options.max_image_size_px / max(photo.shape))
    gray = np.asarray(cv2.resize(photo, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), np.uint8)
    return bool(np.mean(local_deviation(gray, FLAT_WINDOW_PX) >= FLAT_GRAY) < FLAT_SHARE)


def _equalize(photo: ByteArray) -> ByteArray:
    """Return a photo (H, W) with up to `MOST_GAIN` times its local contrast."""
    # one object per call: its buffers are not for several threads
    return np.asarray(cv2.createCLAHE(clipLimit=MOST_GAIN, tileGridSize=(8, 8)).apply(photo), np.uint8)


def _enlarge(photo: ByteArray, options: MatchSettings) -> ByteArray:
    """Return a photo (H, W) with twice the area at which features are found."""
    factor = math.sqrt(2.0) * min(1.0, options.max_image_size_px / max(photo.shape))
    size = round(factor * photo.shape[1]), round(factor * photo.shape[0])
    return np.asarray(
        cv2.resize(photo, size, interpolation=cv2.INTER_AREA if factor < 1.0 else cv2.INTER_CUBIC), np.uint8
    )


def _extract_pictures(
    pictures: Mapping[str, ByteArray], extraction: Extraction, token: Token
) -> dict[str, SiftFeatures]:
    """Return the SIFT features of pictures at their own size."""
    own_size, files = copy.copy(extraction), {f"{number:03d}.png": name for number, name in enumerate(pictures)}
    own_size.max_image_size = max((max(picture.shape) for picture in pictures.values()), default=1)
    with tempfile.TemporaryDirectory(prefix="sfm-app-features-") as folder:
        for file, name in files.items():
            Image.fromarray(pictures[name]).save(Path(folder) / file, compress_level=0)
        sizes = {file: pictures[name].shape[1::-1] for file, name in files.items()}
        found = _extract(Path(folder), sizes, own_size, token)
    return {files[file]: features for file, features in found.items()}


def _extract(folder: Path, sizes: Mapping[str, Size], extraction: Extraction, token: Token) -> dict[str, SiftFeatures]:
    """Return the SIFT features of files by their names, of those that COLMAP can read and that have these sizes."""
    with tempfile.TemporaryDirectory(prefix="sfm-app-features-") as scratch:
        database = Path(scratch) / "features.db"
        with open_database(database):
            pass  # COLMAP needs an existing file
        if sizes:
            pycolmap.extract_features(
                database, folder, list(sizes), extraction_options=extraction, device=pycolmap.Device.cpu,
                cancellation_token=token,
            )  # fmt: skip
        with open_database(database) as source:
            read = {camera.camera_id: (camera.width, camera.height) for camera in source.read_all_cameras()}
            return {
                image.name: (
                    np.asarray(source.read_keypoints(image.image_id), np.float64).reshape(-1, 6),
                    np.asarray(source.read_descriptors(image.image_id).data, np.uint8).reshape(-1, 128),
                )
                for image in source.read_all_images()
                if read[image.camera_id] == sizes[image.name]
            }


def _drop_masked(features: Mapping[str, SiftFeatures], masks: Path | None) -> dict[str, SiftFeatures]:
    """Return the features of photos that no mask hides."""
    if masks is None:
        return dict(features)
    kept = {}
    for name, (keypoints, values) in features.items():
        used = read_mask(masks, name)
        column, row = np.clip(keypoints[:, :2].astype(np.int64), 0, np.array(used.shape[::-1]) - 1).T
        kept[name] = keypoints[used[row, column]], values[used[row, column]]
    return kept


def _largest(features: SiftFeatures, most: int) -> SiftFeatures:
    """Return the `most` largest features in their order; COLMAP itself keeps whole octaves."""
    keypoints, values = features
    areas = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    rows = np.sort(np.argsort(-areas, kind="stable")[:most])
    return keypoints[rows], np.ascontiguousarray(values[rows])


def _find_in_panorama(name: str, settings: SiftSettings, extraction: Extraction, token: Token) -> SiftFeatures:
    """Return features of perspective views of a panorama, in its pixels, with their shapes in a view."""
    from sfm_app.photos.panoramas import PanoramaViews  # other processes of COLMAP need no compiler

    pixels = np.asarray(upright_image(read_picture(settings.photos / name)).convert("RGB"), np.uint8)
    views = PanoramaViews.cover((pixels.shape[1], pixels.shape[0]), extraction.max_image_size)
    pixels = views.shrink(pixels)
    pictures = {str(view): views.render(pixels, view) for view in range(len(views.rotations))}
    parts: list[SiftFeatures] = [(np.zeros((0, 6)), np.zeros((0, 128), np.uint8))]
    for view, (seen, values) in sorted(_extract_pictures(pictures, extraction, token).items()):
        own = np.flatnonzero(views.is_nearest(seen[:, :2], int(view)))
        x = views.to_panorama(seen[own, :2], int(view))
        parts.append((np.column_stack([x, seen[own, 2:]]), values[own]))
    found = np.concatenate([keypoints for keypoints, _ in parts]), np.concatenate([values for _, values in parts])
    return _largest(_drop_masked({name: found}, settings.masks)[name], settings.options.max_features)


# Raw matches.


def match_sift(database: Path, options: MatchSettings, pairs: Sequence[PairId], progress: Progress) -> None:
    """Match pairs of photos on one thread in a scratch database.

    The photos get their ids as names: COLMAP's lists of pairs hold plain ASCII, and end names at blanks.
    """
    matching, pairing = pycolmap.FeatureMatchingOptions(), pycolmap.ImportedPairingOptions()
    matching.skip_geometric_verification = True
    matching.num_threads = 1
    matching.use_gpu = False
    matching.sift.max_ratio = options.max_ratio
    with open_database(database) as target:
        for image in target.read_all_images():
            image.name = str(image.image_id)
            target.update_image(image)

    def call(token: Token) -> None:
        pycolmap.match_image_pairs(
            database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu,
            cancellation_token=token,
        )  # fmt: skip

    def count(reader: pycolmap.Database) -> int:
        return int(reader.num_matched_image_pairs())

    pairing.match_list_path = database.with_name("pairs.txt")
    pairing.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="ascii", newline="\n")
    _run_with_progress(call, database, count, "matching", len(pairs), progress)


def _run_with_progress(
    call: Callable[[pycolmap.CancellationToken], None],
    database: Path,
    count: Callable[[pycolmap.Database], int],
    label: str,
    total: int,
    progress: Progress,
) -> None:
    """Run a COLMAP call, and show its progress as read from the database.

    The reader is COLMAP's own SQLite, opened once before the call: a second SQLite in the process (Python's) would drop
    the locks of the first whenever it closes the file, and COLMAP would abort.
    """
    with open_database(database) as reader:
        run_with_progress(call, lambda: count(reader), label, total, progress)


# Chunks of photos or pairs on any machine; their rows are then entered in the run's database.

FEATURES, MATCHES = ("keypoints", "descriptors"), ("matches", "two_view_geometries")
"""COLMAP's tables of photos, and of pairs."""
_MATCHING = threading.Lock()
"""COLMAP sometimes loses matches if threads of one process match side by side."""


@dataclass(frozen=True, slots=True)
class SiftInputs:
    """Inputs that all chunks share."""

    settings: SiftSettings
    folder: Path
    """Folder for two databases, see `write_inputs`, and for files of new rows, in the output folder."""
    scratch: Path | None = None
    """Folder for temporary databases, on a disk of this machine; None for the usual one."""


@dataclass(frozen=True, slots=True)
class Part:
    """New rows of a few photos or pairs."""

    path: Path
    count: int
    """Photos or pairs of which no progress has been shown."""


PHOTOS_ONLY, WITH_FEATURES = "photos.db", "features.db"
"""Databases for all chunks: the photos and nothing else; the photos with their features, for matching."""


def write_inputs(database: Path, inputs: SiftInputs) -> None:
    """Write the databases for all chunks of work on a database."""
    inputs.folder.mkdir(parents=True)
    _write_snapshot(database, inputs.folder / PHOTOS_ONLY, (*FEATURES, *MATCHES))
    _write_snapshot(database, inputs.folder / WITH_FEATURES, MATCHES)


def _write_snapshot(database: Path, target: Path, without: Sequence[str]) -> None:
    """Copy a database that nobody writes to, atomically, for reading over a network; tables `without` stay empty."""
    with translate_errors("copying the database"), replace_atomically(target) as beside:
        with contextlib.closing(sqlite3.connect(database)) as source:
            source.execute("VACUUM INTO ?", (str(beside),))
        with contextlib.closing(sqlite3.connect(beside, isolation_level=None)) as target_copy:
            for table in without:
                target_copy.execute(f"DELETE FROM {table}")  # noqa: S608 - our names
            target_copy.execute("VACUUM")


def find_in_chunk(inputs: SiftInputs, names: Sequence[str]) -> Part:
    """Find features of some photos, and leave their rows in a file."""
    with translate_errors("finding features"), _scratch_copy(inputs) as database:
        find_sift(database, inputs.settings, names, 1, Progress())
        return Part(_leave_rows(database, FEATURES, inputs.folder), len(names))


def match_chunk(inputs: SiftInputs, pairs: Sequence[PairId], progress: Progress | None = None) -> Part:
    """Match pairs of photos by their ids, in this order, and leave their rows in a file."""
    photos = sorted({photo for pair in pairs for photo in pair})
    with translate_errors("matching photos"), _MATCHING, _scratch_copy(inputs) as database:
        _copy_rows(database, inputs.folder / WITH_FEATURES, FEATURES, photos)
        match_sift(database, inputs.settings.options, pairs, progress or Progress())
        return Part(_leave_rows(database, MATCHES, inputs.folder), len(pairs))


def match_chunk_apart(inputs: SiftInputs, group: ProcessGroup, progress: Progress, pairs: Sequence[PairId]) -> Part:
    """Match some pairs in a process of its own, as `match_chunk` does."""
    call = partial(match_chunk, replace(inputs, scratch=inputs.folder), pairs, ProgressReporter())
    return replace(group.run(call, "matching photos", progress), count=0)


def enter_rows(database: Path, part: Path, tables: Sequence[str]) -> None:
    """Enter the tables of a worker's file into the run's database, and remove the file."""
    with translate_errors("entering the features and matches of workers"):
        _copy_rows(database, part, tables)
    part.unlink()


def photos_without_features(database: Path) -> dict[int, str]:
    """Return the names of photos that have no entry of keypoints or descriptors, by id."""
    with open_database(database) as reader:
        images = sorted(reader.read_all_images(), key=lambda image: image.image_id)
        return {
            image.image_id: image.name
            for image in images
            if not (reader.exists_keypoints(image.image_id) and reader.exists_descriptors(image.image_id))
        }


def count_features(database: Path) -> list[int]:
    """Return the number of keypoints of each photo."""
    with contextlib.closing(sqlite3.connect(database)) as connection:
        return [int(rows) for (rows,) in connection.execute("SELECT rows FROM keypoints ORDER BY image_id")]


def exhaustive_pairs(photos: Sequence[int]) -> list[PairId]:
    """Return all pairs of ascending ids as COLMAP's exhaustive matching takes them; in some, the larger comes first."""
    pairs, block = [], 50  # photos of a block, COLMAP's default
    for first, a in enumerate(photos):
        for second, b in enumerate(photos[first + 1 :], first + 1):
            swapped = first // block != second // block and second % block <= first % block
            pairs.append((b, a) if swapped else (a, b))
    return pairs


@contextlib.contextmanager
def _scratch_copy(inputs: SiftInputs) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="sfm-app-sift-", dir=inputs.scratch) as scratch:
        yield Path(shutil.copy(inputs.folder / PHOTOS_ONLY, scratch))


def _leave_rows(database: Path, tables: Sequence[str], folder: Path) -> Path:
    target = folder / f"rows-{secrets.token_hex(8)}.db"
    rows = database.with_name("rows.db")
    with contextlib.closing(sqlite3.connect(database, isolation_level=None)) as source:
        source.execute("ATTACH ? AS rows", (str(rows),))
        for table in tables:
            source.execute(f"CREATE TABLE rows.{table} AS SELECT * FROM main.{table}")  # noqa: S608 - our names
    with replace_atomically(target) as beside:
        shutil.copyfile(rows, beside)
    return target


def _copy_rows(database: Path, source: Path, tables: Sequence[str], photos: Sequence[int] | None = None) -> None:
    """Copy rows of tables from a database that nobody writes to, all of them or those of some photos."""
    chosen = "" if photos is None else f" WHERE image_id IN ({', '.join(str(int(photo)) for photo in photos)})"
    with contextlib.closing(sqlite3.connect(database, uri=True)) as target:
        target.execute("ATTACH ? AS part", (f"{source.absolute().as_uri()}?immutable=1",))
        with target:
            for table in tables:
                rows = f"SELECT * FROM part.{table}{chosen}"  # noqa: S608 - our names and numbers
                target.execute(f"INSERT OR REPLACE INTO main.{table} {rows}")
        target.execute("DETACH part")
