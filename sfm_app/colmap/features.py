"""COLMAP's SIFT features and raw matches, on the CPU and without its geometric verification.

One worker process finds the features of a whole run. Workers of a cluster find those of a few photos each, and any
worker matches a few pairs: SQLite does not work over a network, so only one process opens the run's database. Workers
copy a snapshot without features into a folder of their own, let COLMAP fill it, and leave the new rows as a file in the
output folder.
"""

import contextlib
import secrets
import shutil
import sqlite3
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.colmap.backend import pycolmap, run_with_progress, translate_errors
from sfm_app.colmap.database import open_database, panorama_names
from sfm_app.colmap.worker_process import ProcessGroup, ProgressReporter, SiftOption
from sfm_app.files import replace_atomically
from sfm_app.photos.decode import read_picture, upright_image
from sfm_app.photos.masks import read_mask
from sfm_app.progress import Progress, track
from sfm_app.settings import MatchSettings
from sfm_app.types import PairId


@dataclass(frozen=True, slots=True)
class SiftSettings:
    """Photos and options of SIFT."""

    photos: Path
    masks: Path | None
    """Folder with a mask of every photo, `name.png`: no keypoints where it is black. None without masks."""
    options: MatchSettings
    sift: Mapping[str, SiftOption] = field(default_factory=dict)
    """Options of COLMAP's SIFT that differ from its defaults."""


Extract = Callable[[Path, Sequence[str], pycolmap.FeatureExtractionOptions, pycolmap.CancellationToken], None]
"""Lets COLMAP enter features of photos with these names in a database, which exists."""


def find_sift(database: Path, settings: SiftSettings, names: Sequence[str], workers: int, progress: Progress) -> None:
    """Find features of photos that have none yet."""
    extraction = _extraction_options(settings, workers)
    panoramas = panorama_names(database)
    extract_panoramas(database, settings, [name for name in names if name in panoramas], extraction, progress)
    plain = [name for name in names if name not in panoramas]
    reader = pycolmap.ImageReaderOptions()
    if settings.masks is not None:
        reader.mask_path = settings.masks

    def extract(
        target: Path,
        chosen: Sequence[str],
        options: pycolmap.FeatureExtractionOptions,
        token: pycolmap.CancellationToken,
    ) -> None:
        pycolmap.extract_features(
            target, settings.photos, list(chosen), reader_options=reader, extraction_options=options,
            device=pycolmap.Device.cpu, cancellation_token=token,
        )  # fmt: skip

    def call(token: pycolmap.CancellationToken) -> None:
        if settings.sift:
            extract(database, plain, extraction, token)
        else:
            extract_as_needed(database, plain, extract, settings, workers, token)

    if plain:
        members = set(plain)
        with open_database(database) as opened:
            ids = [image.image_id for image in opened.read_all_images() if image.name in members]
        _run_with_progress(
            call, database, lambda one: sum(map(one.exists_keypoints, ids)), "features", len(ids), progress
        )


def _extraction_options(settings: SiftSettings, workers: int) -> pycolmap.FeatureExtractionOptions:
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = settings.options.max_image_size_px
    extraction.num_threads = workers
    extraction.use_gpu = False
    extraction.sift.max_num_features = settings.options.max_features
    for name, value in settings.sift.items():
        setattr(extraction.sift, name, value)
    return extraction


# Features of photos at their own size, and of enlarged ones where these are few.
# COLMAP doubles the size of every photo before it looks for features. That takes three quarters of the time, and gives
# the finest features, which are also the least exact ones. Photos with many features do as well without.


def extract_as_needed(
    database: Path,
    names: Sequence[str],
    extract: Extract,
    settings: SiftSettings,
    workers: int,
    token: pycolmap.CancellationToken,
) -> None:
    """Enter SIFT features of photos that have none; those with few at their own size are enlarged. Ours."""
    own_size, enlarged = _extraction_options(settings, workers), _extraction_options(settings, workers)
    own_size.sift.first_octave = 0
    with open_database(database) as before:
        ids = {image.name: image.image_id for image in before.read_all_images()}
        new = [name for name in names if not before.exists_keypoints(ids[name])]
    batch = 16  # photos after which features are entered: what a killed run does again; chosen by hand
    for first in range(0, len(new), batch):
        some = new[first : first + batch]
        with _empty_database() as scratch:
            extract(scratch, some, own_size, token)
            rich = _enter_rich(database, scratch, some, settings.options)
        poor = [name for name in some if name not in rich]
        if poor and not token.is_cancelled:
            extract(database, poor, enlarged, token)


@contextlib.contextmanager
def _empty_database() -> Iterator[Path]:
    """Provide a database in a folder of its own: COLMAP needs an existing file."""
    with tempfile.TemporaryDirectory(prefix="sfm-app-features-") as folder:
        scratch = Path(folder) / "features.db"
        with open_database(scratch):
            pass
        yield scratch


def _enter_rich(database: Path, scratch: Path, names: Sequence[str], options: MatchSettings) -> set[str]:
    """Enter the features of photos that have enough of them in another database, and return their names."""
    with open_database(scratch) as source, open_database(database) as target:
        of, to = ({image.name: image.image_id for image in one.read_all_images()} for one in (source, target))
        found = [name for name in names if name in of]
        rich = {name for name in found if source.num_keypoints_for_image(of[name]) >= options.enlarge_below}
        for name in sorted(rich):
            keypoints, descriptors = source.read_keypoints(of[name]), source.read_descriptors(of[name])
            # COLMAP keeps whole octaves; here those of the largest scale remain, in their order
            scale = np.hypot(keypoints[:, 2], keypoints[:, 4])
            rows = np.sort(np.argsort(-scale, kind="stable")[: options.max_features])
            data = np.ascontiguousarray(descriptors.data[rows])
            target.write_keypoints(to[name], keypoints[rows])
            target.write_descriptors(to[name], pycolmap.FeatureDescriptors(descriptors.type, data))
    return rich


# Features of perspective views of panoramas, entered as keypoints of the panorama.


def extract_panoramas(
    database: Path,
    settings: SiftSettings,
    names: Sequence[str],
    extraction: pycolmap.FeatureExtractionOptions,
    progress: Progress,
) -> None:
    """Find SIFT features of panoramas that have none yet. Ours.

    Of too many features, those of the largest scale remain, as in COLMAP, whose largest size is that of one view.
    """
    with open_database(database) as reader:
        images = {image.name: image.image_id for image in reader.read_all_images()}
        new = [name for name in names if not reader.exists_keypoints(images[name])]
    for name in track(progress, new, "panoramas", len(new)) if new else ():
        keypoints, descriptors = _find_in_panorama(settings.photos / name, extraction)
        if settings.masks is not None:
            used = read_mask(settings.masks, name)
            column, row = np.clip(keypoints[:, :2].astype(np.int64), 0, np.array(used.shape[::-1]) - 1).T
            keypoints, descriptors = keypoints[used[row, column]], descriptors[used[row, column]]
        best = np.argsort(-keypoints[:, 2], kind="stable")[: extraction.sift.max_num_features]
        data = np.ascontiguousarray(descriptors[best])
        with open_database(database) as target:
            target.write_keypoints(images[name], np.ascontiguousarray(keypoints[best, :2], np.float32))
            target.write_descriptors(
                images[name], pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, data)
            )


def _find_in_panorama(
    path: Path, extraction: pycolmap.FeatureExtractionOptions
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return keypoints (N, 3), x and y in pixels of the panorama and the scale in a view, and descriptors (N, 128)."""
    from sfm_app.photos.panoramas import PanoramaViews  # other processes of COLMAP need no compiler

    pixels = np.asarray(upright_image(read_picture(path)).convert("RGB"), np.uint8)
    views = PanoramaViews.cover((pixels.shape[1], pixels.shape[0]), extraction.max_image_size)
    pixels = views.shrink(pixels)
    keypoints, descriptors = [np.zeros((0, 3))], [np.zeros((0, 128), np.uint8)]
    with _empty_database() as scratch:
        names = [f"{view:02d}.png" for view in range(len(views.rotations))]
        for view, name in enumerate(names):
            Image.fromarray(views.render(pixels, view)).save(scratch.parent / name, compress_level=1)
        pycolmap.extract_features(
            scratch, scratch.parent, names, extraction_options=extraction, device=pycolmap.Device.cpu
        )
        with open_database(scratch) as reader:
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

    def call(token: pycolmap.CancellationToken) -> None:
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
