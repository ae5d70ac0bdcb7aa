"""COLMAP's SIFT features and raw matches, on the CPU and without its geometric verification.

One worker process finds and matches the features of a whole run. Workers on other machines take a few photos or
pairs each: SQLite does not work over a network, so only one process opens the run's database. Workers copy a snapshot
without features into a folder of their own, let COLMAP fill it, and leave the new rows as a file in the output folder.
"""

import contextlib
import copy
import math
import re
import secrets
import shutil
import sqlite3
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.colmap.backend import json_options, pycolmap, run_with_progress, translate_errors
from sfm_app.colmap.database import open_database, panorama_names
from sfm_app.colmap.worker_process import TASKS, FeatureTask, MatchTask, ProcessGroup, SiftOption, relay, start_worker
from sfm_app.files import replace_atomically
from sfm_app.numerical import Json
from sfm_app.photos.decode import read_picture, upright_image
from sfm_app.photos.masks import read_mask
from sfm_app.photos.panoramas import PanoramaViews
from sfm_app.progress import Progress, SilentProgress, track
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


def find_and_match(
    database: Path,
    settings: SiftSettings,
    names: Sequence[str],
    workers: int,
    progress: Progress,
    pairs: Sequence[PairId] | None = None,
) -> dict[str, Json]:
    """Find features of photos and match pairs in a worker process; existing features and matches stay.

    Without pairs, every photo is matched with every other. The result is the effective options, for the manifest.
    """
    with start_worker(TASKS, feature_task(database, settings, names, workers, pairs)) as process:
        options = relay(process, progress)
        process.check("matching photos" if options else "finding features")
    return options


def feature_task(
    database: Path, settings: SiftSettings, names: Sequence[str], workers: int, pairs: Sequence[PairId] | None
) -> FeatureTask:
    """Return the task of `find_and_match`."""
    return {
        "do": "find_and_match",
        "database": str(database),
        "photos": str(settings.photos),
        "masks": str(settings.masks) if settings.masks else None,
        "names": list(names),
        "options": settings.options.model_dump(),
        "workers": workers,
        "sift": dict(settings.sift),
        "pairs": None if pairs is None else [list(pair) for pair in pairs],
    }


def do_feature_task(task: FeatureTask, progress: Progress, report: Callable[..., None]) -> None:
    """Find features of photos, or match pairs; report the effective options as `extraction` or `matching`."""
    database, photo_dir, names = Path(task["database"]), Path(task["photos"]), task["names"]
    options = MatchSettings.model_validate(task["options"])
    masks = Path(task["masks"]) if task["masks"] else None
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    if names:
        extraction = _extraction_options(options, task["sift"], task["workers"])
        panoramas = panorama_names(database)
        extract_panoramas(
            database, photo_dir, [name for name in names if name in panoramas], masks, extraction, progress
        )
        plain = [name for name in names if name not in panoramas]
        enough = 0 if task["sift"] else options.enlarge_below

        def call(token: pycolmap.CancellationToken) -> None:
            if task["sift"]:
                _extract(database, photo_dir, plain, reader, extraction, token)
            else:
                extract_as_needed(database, photo_dir, plain, reader, extraction, enough, token)

        if plain:
            members = set(plain)
            with open_database(database) as opened:
                ids = [image.image_id for image in opened.read_all_images() if image.name in members]
            _run_with_progress(
                call, database, lambda one: sum(map(one.exists_keypoints, ids)), "features", len(ids), progress
            )
        report(extraction=json_options(extraction.todict()))
    pairs = None if task["pairs"] is None else [(int(a), int(b)) for a, b in task["pairs"]]
    if pairs != []:
        report(matching=match(database, options, task["workers"], pairs, progress))


def _extraction_options(
    options: MatchSettings, sift: Mapping[str, SiftOption], workers: int
) -> pycolmap.FeatureExtractionOptions:
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.max_image_size = options.max_image_size_px
    extraction.num_threads = workers
    extraction.use_gpu = False
    extraction.sift.max_num_features = options.max_features
    for name, value in sift.items():
        setattr(extraction.sift, name, value)
    return extraction


def _extract(
    database: Path,
    photo_dir: Path,
    names: Sequence[str],
    reader: pycolmap.ImageReaderOptions,
    extraction: pycolmap.FeatureExtractionOptions,
    token: pycolmap.CancellationToken,
) -> None:
    pycolmap.extract_features(
        database, photo_dir, list(names), reader_options=reader, extraction_options=extraction,
        device=pycolmap.Device.cpu, cancellation_token=token,
    )  # fmt: skip


# Features of photos at their own size, and of enlarged ones where these are few.
# COLMAP doubles the size of every photo before it looks for features. That takes three quarters of the time, and gives
# the finest features, which are also the least exact ones. Photos with many features do as well without.


def extract_as_needed(
    database: Path,
    photo_dir: Path,
    names: Sequence[str],
    reader: pycolmap.ImageReaderOptions,
    extraction: pycolmap.FeatureExtractionOptions,
    enough: int,
    token: pycolmap.CancellationToken,
) -> None:
    """Enter SIFT features of photos that have none; those with fewer than `enough` are enlarged. Ours."""
    with open_database(database) as before:
        ids = {image.name: image.image_id for image in before.read_all_images()}
        new = [name for name in names if not before.exists_keypoints(ids[name])]
    batch = 16  # photos after which features are entered: what a killed run does again; chosen by hand
    for first in range(0, len(new), batch):
        some = new[first : first + batch]
        rich = _enter_rich(database, photo_dir, some, reader, extraction, enough, token)
        poor = [name for name in some if name not in rich]
        if poor and not token.is_cancelled:
            _extract(database, photo_dir, poor, reader, extraction, token)


def _enter_rich(
    database: Path,
    photo_dir: Path,
    names: Sequence[str],
    reader: pycolmap.ImageReaderOptions,
    extraction: pycolmap.FeatureExtractionOptions,
    enough: int,
    token: pycolmap.CancellationToken,
) -> set[str]:
    own = copy.deepcopy(extraction)
    own.sift.first_octave = 0
    with tempfile.TemporaryDirectory(prefix="sfm-app-features-") as folder:
        scratch = Path(folder) / "features.db"
        with open_database(scratch):
            pass  # COLMAP needs an existing file
        _extract(scratch, photo_dir, names, reader, own, token)
        with open_database(scratch) as source, open_database(database) as target:
            of, to = ({image.name: image.image_id for image in one.read_all_images()} for one in (source, target))
            rich = {name for name in names if name in of and source.num_keypoints_for_image(of[name]) >= enough}
            for name in sorted(rich):
                keypoints, descriptors = source.read_keypoints(of[name]), source.read_descriptors(of[name])
                # COLMAP keeps whole octaves; here those of the largest scale remain, in their order
                scale = np.hypot(keypoints[:, 2], keypoints[:, 4])
                rows = np.sort(np.argsort(-scale, kind="stable")[: own.sift.max_num_features])
                data = np.ascontiguousarray(descriptors.data[rows])
                target.write_keypoints(to[name], keypoints[rows])
                target.write_descriptors(to[name], pycolmap.FeatureDescriptors(descriptors.type, data))
    return rich


# Features of perspective views of panoramas, entered as keypoints of the panorama.


def extract_panoramas(
    database: Path,
    photo_dir: Path,
    names: Sequence[str],
    mask_dir: Path | None,
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
        keypoints, descriptors = _find_in_panorama(photo_dir / name, extraction)
        if mask_dir is not None:
            used = read_mask(mask_dir, name)
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
    pixels = np.asarray(upright_image(read_picture(path)).convert("RGB"), np.uint8)
    views = PanoramaViews.cover((pixels.shape[1], pixels.shape[0]), extraction.max_image_size)
    pixels = views.shrink(pixels)
    keypoints, descriptors = [np.zeros((0, 3))], [np.zeros((0, 128), np.uint8)]
    with tempfile.TemporaryDirectory(prefix="sfm-app-views-") as folder:
        names = [f"{view:02d}.png" for view in range(len(views.rotations))]
        for view, name in enumerate(names):
            Image.fromarray(views.render(pixels, view)).save(Path(folder) / name, compress_level=1)
        scratch = Path(folder) / "views.db"
        with open_database(scratch):
            pass  # COLMAP needs an existing file
        pycolmap.extract_features(
            scratch, Path(folder), names, extraction_options=extraction, device=pycolmap.Device.cpu
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


def match(
    database: Path,
    options: MatchSettings,
    workers: int,
    pairs: Sequence[PairId] | None,
    progress: Progress,
) -> dict[str, Json]:
    """Match pairs of photos, None for every photo with every other, and return the effective options."""
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

    with open_database(database) as reader:
        total = math.comb(reader.num_images(), 2)
    _run_with_progress(call, database, lambda one: int(one.num_matched_image_pairs()), "matching", total, progress)
    return json_options(matching.todict())


def _match_pairs(
    database: Path, matching: pycolmap.FeatureMatchingOptions, pairs: Sequence[PairId], progress: Progress
) -> None:
    """Match pairs of photos.

    COLMAP's lists end names at blanks. If a name is not of plain ASCII, COLMAP matches a copy of the database whose
    photos are named by ids.
    """
    with open_database(database) as reader:
        names = {image.image_id: image.name for image in reader.read_all_images()}
    with tempfile.TemporaryDirectory(dir=database.parent, prefix=".matching") as folder:
        if all(re.fullmatch(r"[!-~]+", name) for name in names.values()):
            _match_listed(database, matching, [(names[a], names[b]) for a, b in pairs], Path(folder), progress)
            return
        renamed = Path(folder) / database.name
        shutil.copyfile(database, renamed)
        with open_database(renamed) as target:
            target.clear_two_view_geometries()
            target.clear_matches()
            for image in target.read_all_images():
                image.name = str(image.image_id)
                target.update_image(image)
        _match_listed(renamed, matching, [(str(a), str(b)) for a, b in pairs], Path(folder), progress)
        with open_database(renamed) as source:
            rows = {pair: source.read_matches(*pair) for pair in pairs}
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

    def count(reader: pycolmap.Database) -> int:
        return int(reader.num_matched_image_pairs()) - before

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

    snapshot: Path
    """Database with the photos and nothing else."""
    features: Path
    """Database with the features of all photos, for matching."""
    settings: SiftSettings
    folder: Path
    """Folder for files of new rows, in the output folder."""
    scratch: Path | None = None
    """Folder for temporary databases, on a disk of this machine; None for the usual one."""


@dataclass(frozen=True, slots=True)
class Part:
    """New rows of a few photos or pairs."""

    path: Path
    count: int
    """Photos or pairs of which no progress has been shown."""
    in_force: Mapping[str, Json]
    """COLMAP's options."""


def write_snapshot(database: Path, target: Path, without: Sequence[str]) -> None:
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
    with _scratch_copy(inputs) as database:
        in_force = _find_and_match_here(database, inputs.settings, names, (), SilentProgress())
        return Part(_leave_rows(database, FEATURES, inputs.folder), len(names), in_force)


def match_chunk(inputs: SiftInputs, pairs: Sequence[PairId], progress: Progress | None = None) -> Part:
    """Match pairs of photos by their ids, in this order, and leave their rows in a file."""
    photos = sorted({photo for pair in pairs for photo in pair})
    with _MATCHING, _scratch_copy(inputs) as database:
        _copy_rows(database, inputs.features, FEATURES, photos)
        in_force = _find_and_match_here(database, inputs.settings, (), pairs, progress or SilentProgress())
        return Part(_leave_rows(database, MATCHES, inputs.folder), len(pairs), in_force)


def match_chunk_apart(inputs: SiftInputs, group: ProcessGroup, progress: Progress, pairs: Sequence[PairId]) -> Part:
    """Match some pairs in a process of its own, as `match_chunk` does."""
    task: MatchTask = {
        "do": "match_chunk", "snapshot": str(inputs.snapshot), "features": str(inputs.features),
        "photos": str(inputs.settings.photos), "options": inputs.settings.options.model_dump(),
        "sift": dict(inputs.settings.sift), "folder": str(inputs.folder), "pairs": [list(pair) for pair in pairs],
    }  # fmt: skip
    results = group.run(task, "matching photos", progress)
    return Part(Path(str(results["path"])), 0, cast(Mapping[str, Json], results["in_force"]))


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


def _find_and_match_here(
    database: Path, settings: SiftSettings, names: Sequence[str], pairs: Sequence[PairId], progress: Progress
) -> dict[str, Json]:
    in_force: dict[str, Json] = {}
    with translate_errors("matching photos" if pairs else "finding features"):
        do_feature_task(feature_task(database, settings, names, 1, pairs), progress, in_force.update)
    return in_force


@contextlib.contextmanager
def _scratch_copy(inputs: SiftInputs) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="sfm-app-sift-", dir=inputs.scratch) as scratch:
        yield Path(shutil.copyfile(inputs.snapshot, Path(scratch) / inputs.snapshot.name))


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
