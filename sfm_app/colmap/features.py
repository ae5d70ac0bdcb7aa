"""COLMAP's SIFT on a few photos or pairs at a time, on any machine; their rows are then entered in the run's database.

SQLite does not work over a network, so that only one process opens the run's database. Workers copy a snapshot without
features into a folder of their own, let COLMAP fill it, and leave the new rows as a file in the output folder.
"""

import contextlib
import secrets
import shutil
import sqlite3
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import cast

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import open_database
from sfm_app.colmap.feature_process import do_task
from sfm_app.colmap.worker_process import FeatureTask, MatchTask, ProcessGroup, SiftOption, relay, start_worker
from sfm_app.files import replace_atomically
from sfm_app.numerical import Json
from sfm_app.progress import Progress, SilentProgress
from sfm_app.settings import MatchSettings
from sfm_app.types import PairId

# SIFT features and raw matches of all photos, written into the database by a separate process.

DEFAULT_SIFT: Mapping[str, SiftOption] = MappingProxyType({})
"""No options: COLMAP's defaults."""


def find_and_match(
    database: Path, photo_dir: Path, names: Sequence[str], options: MatchSettings, workers: int, progress: Progress,
    mask_dir: Path | None = None, sift: Mapping[str, SiftOption] = DEFAULT_SIFT, pairs: Sequence[PairId] | None = None,
) -> dict[str, Json]:  # fmt: skip
    """Find features of all photos and match every photo with every other; existing features and matches stay.

    Args:
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
    with start_worker("sfm_app.colmap.feature_process", task) as process:
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
    """Return the task of a process that finds and matches features."""
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


FEATURES, MATCHES = ("keypoints", "descriptors"), ("matches", "two_view_geometries")
"""COLMAP's tables of what it finds in photos, and in pairs."""
_MATCHING = threading.Lock()
"""COLMAP loses matches now and then where threads of one process match side by side."""
BLOCK = 50
"""Photos of a block in COLMAP's exhaustive matching, by its default."""


@dataclass(frozen=True, slots=True)
class SiftInputs:
    """What a worker needs besides names or pairs."""

    snapshot: Path
    """Database with the photos and nothing else."""
    features: Path
    """Database with the features of all photos; read where pairs are matched."""
    photos: Path
    masks: Path | None
    options: MatchSettings
    sift: Mapping[str, SiftOption]
    folder: Path
    """Where new rows are left, in the output folder."""
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
    """Copy a database that nobody is writing to into one that can be read over a network.

    Args:
        without: tables that stay empty.

    Raises:
        BackendError: the database cannot be read, or the copy not written.
    """
    with translate_errors("copying the database"), replace_atomically(target) as beside:
        with contextlib.closing(sqlite3.connect(database)) as source:
            source.execute("VACUUM INTO ?", (str(beside),))
        with contextlib.closing(sqlite3.connect(beside, isolation_level=None)) as copy:
            for table in without:
                copy.execute(f"DELETE FROM {table}")  # noqa: S608 - our names
            copy.execute("VACUUM")


def find_in_chunk(inputs: SiftInputs, names: Sequence[str]) -> Part:
    """Find features of some photos, and leave their rows in a file.

    Raises:
        BackendError: COLMAP failed.
    """
    with _scratch_copy(inputs) as database:
        in_force = _find_and_match(database, inputs, names, (), SilentProgress())
        return Part(_leave_rows(database, FEATURES, inputs.folder), len(names), in_force)


def match_chunk(inputs: SiftInputs, pairs: Sequence[PairId], progress: Progress | None = None) -> Part:
    """Match some pairs, and leave their rows in a file.

    Args:
        pairs: ids of photos; the order within a pair is that in which COLMAP matches them.

    Raises:
        BackendError: COLMAP failed.
    """
    photos = sorted({photo for pair in pairs for photo in pair})
    with _MATCHING, _scratch_copy(inputs) as database:
        _copy_rows(database, inputs.features, FEATURES, photos)
        in_force = _find_and_match(database, inputs, (), pairs, progress or SilentProgress())
        return Part(_leave_rows(database, MATCHES, inputs.folder), len(pairs), in_force)


def match_chunk_apart(inputs: SiftInputs, group: ProcessGroup, progress: Progress, pairs: Sequence[PairId]) -> Part:
    """Match some pairs in a process of its own.

    Raises:
        BackendError: COLMAP failed, or the group has ended.
    """
    task: MatchTask = {
        "snapshot": str(inputs.snapshot), "features": str(inputs.features), "photos": str(inputs.photos),
        "options": inputs.options.model_dump(), "sift": dict(inputs.sift), "folder": str(inputs.folder),
        "pairs": [list(pair) for pair in pairs],
    }  # fmt: skip
    said = group.run("sfm_app.colmap.match_process", task, "matching photos", progress)
    return Part(Path(str(said["path"])), 0, cast(Mapping[str, Json], said["in_force"]))


def enter_rows(database: Path, part: Path, tables: Sequence[str]) -> None:
    """Enter the rows that a worker has left into the run's database, and remove their file.

    Raises:
        BackendError: the rows cannot be read or entered.
    """
    with translate_errors("entering what workers have found"):
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
    """Return all pairs of photos as COLMAP's exhaustive matching takes them; in some, the larger id comes first.

    Args:
        photos: ids, ascending.
    """
    pairs = []
    for first, a in enumerate(photos):
        for second, b in enumerate(photos[first + 1 :], first + 1):
            swapped = first // BLOCK != second // BLOCK and second % BLOCK <= first % BLOCK
            pairs.append((b, a) if swapped else (a, b))
    return pairs


def _find_and_match(
    database: Path, inputs: SiftInputs, names: Sequence[str], pairs: Sequence[PairId], progress: Progress
) -> dict[str, Json]:
    """Let COLMAP work in this process, which nothing else depends on, and return its options."""
    in_force: dict[str, Json] = {}
    task = feature_task((database, inputs.photos, inputs.masks), names, inputs.options, 1, inputs.sift, pairs)
    with translate_errors("matching photos" if pairs else "finding features"):
        do_task(task, progress, in_force.update)
    return in_force


@contextlib.contextmanager
def _scratch_copy(inputs: SiftInputs) -> Iterator[Path]:
    """Provide a copy of the snapshot on a disk of this machine."""
    with tempfile.TemporaryDirectory(prefix="sfm-app-sift-", dir=inputs.scratch) as scratch:
        yield Path(shutil.copyfile(inputs.snapshot, Path(scratch) / inputs.snapshot.name))


def _leave_rows(database: Path, tables: Sequence[str], folder: Path) -> Path:
    """Write some tables into a file of a folder, and return its path."""
    target = folder / f"rows-{secrets.token_hex(8)}.db"
    found = database.with_name("rows.db")
    with contextlib.closing(sqlite3.connect(database, isolation_level=None)) as source:
        source.execute("ATTACH ? AS rows", (str(found),))
        for table in tables:
            source.execute(f"CREATE TABLE rows.{table} AS SELECT * FROM main.{table}")  # noqa: S608 - our names
    with replace_atomically(target) as beside:
        shutil.copyfile(found, beside)
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
