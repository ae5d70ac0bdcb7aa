"""The output folder: what lies in it, what of it is up to date, and the manifest that says so."""

import contextlib
import errno
import hashlib
import json
import os
import platform
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from sfm_app.errors import InputError

MANIFEST = "manifest.json"
DATABASE = "database.db"
CALIBRATION = "calibration.json"
WRITTEN = ("photos", "frames", "masks", "sparse", "dense", "other_models", DATABASE, CALIBRATION)
"""What a run removes before it writes it."""
SHARED = (DATABASE, CALIBRATION)
"""Files that later stages add to."""
LOCK, HOLDER = ".lock", ".held-by.txt"
LOG, PARTS = "log.txt", "view_graph_parts"
FOLLOWED = (*WRITTEN, LOCK, HOLDER, LOG, PARTS)
"""What a run writes to without replacing it: a link would lead it out of the folder."""
PHOTO_SET, VIEW_GRAPH = "photos.json", "view_graph.npz"
CHECK = "check"
"""In a record: hash of the rest. What was changed by hand, or is half of it, is no record."""
MOST_MANIFEST_BYTES = 64_000_000
UNFINISHED = "unfinished.txt"
"""In a folder while a stage fills it: what it is filled from. It says whether a killed run can go on there."""


@dataclass(frozen=True, slots=True)
class StageRecord:
    """What the manifest says about one finished stage."""

    fingerprint: str
    """Hash of everything that the stage's result depends on."""
    seconds: float
    counts: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, int] = field(default_factory=dict)
    """What the stage wrote, with the size in bytes; -1 for what later stages add to (folders, SHARED)."""
    peak_mb: int | None = None
    """Most memory that the process had held by the end of the stage, in MB; None where the system does not say."""
    made_with: Mapping[str, Any] = field(default_factory=dict)
    """The settings and versions that its result depends on."""
    seal: str = ""
    """Hash of what later runs read of it, so that damage is found before it is read."""


class Workspace:
    """One output folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    @property
    def photos(self) -> Path:
        """Upright photos that COLMAP can read: links where the file is fine, copies where not."""
        return self.root / "photos"

    @property
    def frames(self) -> Path:
        """The chosen frames of a video."""
        return self.root / "frames"

    @property
    def frames_marker(self) -> Path:
        """Beside the frames until they are read: which were chosen, and what from."""
        return self.root / "frames.unfinished.json"

    @property
    def masks(self) -> Path:
        """Masks of the photos, upright and of their size, where masks are given."""
        return self.root / "masks"

    @property
    def database(self) -> Path:
        return self.root / DATABASE

    @property
    def photo_set(self) -> Path:
        return self.root / PHOTO_SET

    @property
    def view_graph(self) -> Path:
        return self.root / VIEW_GRAPH

    @property
    def calibration(self) -> Path:
        return self.root / CALIBRATION

    @property
    def sparse(self) -> Path:
        return self.root / "sparse"

    @property
    def other_models(self) -> Path:
        """COLMAP models of photos that do not hang together with the main one, numbered from 1."""
        return self.root / "other_models"

    @property
    def dense(self) -> Path:
        return self.root / "dense"

    @property
    def database_marker(self) -> Path:
        """Beside the database while it is filled: what it is filled from."""
        return self.root / f"database.{UNFINISHED}"

    @property
    def view_graph_parts(self) -> Path:
        """Fundamental matrices while they are estimated."""
        return self.root / PARTS

    @property
    def log(self) -> Path:
        return self.root / LOG

    def create(self) -> None:
        """Make the folder and prove that it can be written to.

        Raises:
            InputError: it cannot, or it holds what a run would write over, or links through which it would write.
        """
        known = any((self.root / name).exists() for name in (LOCK, MANIFEST))
        foreign = [] if known else [name for name in WRITTEN if (self.root / name).exists()]
        if foreign:
            raise InputError(
                f"{self.root / foreign[0]} is there, and no run has made it", hint="name another output folder with -o"
            )
        link = next(self._links(), None)
        if link:
            raise InputError(f"{link} is a link, and no run has made it", hint="name another output folder with -o")
        try:
            self.root.mkdir(parents=True, exist_ok=True)
        except OSError as err:
            raise _cannot_write(self.root, err) from err
        self._check_writable()

    def _check_writable(self) -> None:
        try:
            with tempfile.TemporaryFile(dir=self.root):
                pass
        except OSError as err:
            if err.errno in (errno.ENOSPC, errno.EDQUOT):
                raise
            raise _cannot_write(self.root, err) from err

    def _links(self) -> Iterator[Path]:
        """Links that no run has made; those of the photos are replaced when they are laid out."""
        for path in (self.root / name for name in FOLLOWED):
            if path.is_symlink():
                yield path
            elif path.name != self.photos.name:
                yield from (below for below in path.rglob("*") if below.is_symlink())

    def keep_apart(self, photos: Path, what: str = "photos") -> None:
        """Check that a run would not write over its photos, or its masks.

        Raises:
            InputError: it would.
        """
        folder, out = photos.resolve(), self.root.resolve()
        if folder == out:
            raise InputError(f"{photos} cannot be the {what} and the output", hint="name another output folder with -o")
        if any(folder.is_relative_to(out / name) for name in WRITTEN):
            raise InputError(
                f"{photos} lies where the run in {self.root} keeps its own files",
                hint="name another output folder with -o",
            )

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Keep other runs out; the system lets go of it when this process ends, however it ends.

        Raises:
            InputError: another run is at work here.
        """
        holder = self.root / HOLDER
        lock = FileLock(self.root / LOCK, timeout=0)
        try:
            lock.acquire()
        except Timeout:
            raise InputError(
                f"another run is at work in {self.root}: {_said(holder)}",
                hint="wait for it, end it, or name another output folder with -o",
            ) from None
        try:
            started = datetime.now().astimezone().isoformat(" ", "seconds")
            holder.write_text(f"process {os.getpid()} on {platform.node()} since {started}\n", encoding="utf-8")
            yield
        finally:
            with contextlib.suppress(OSError):  # the folder may be gone, or closed: the run says so itself
                holder.unlink(missing_ok=True)
            lock.release()

    def check_there(self) -> None:
        """Check that the folder of a run at work is still there, and open.

        What the run has written there since it was removed is marked as its own: the next one must not take it for
        foreign.

        Raises:
            InputError: it is gone, or nothing can be written there.
        """
        if not (self.root / LOCK).exists():
            left = {path.name for path in self.root.iterdir()} if self.root.is_dir() else set()
            if left and left <= {*FOLLOWED, PHOTO_SET, VIEW_GRAPH}:
                (self.root / LOCK).touch()
            raise InputError(f"{self.root} was removed while the run was at work", hint="run again")
        self._check_writable()

    def discard_unfinished(self) -> None:
        """Let no run go on with what a stage has left half done."""
        for path in (self.database_marker, self.frames_marker, *self.root.glob(f"*/{UNFINISHED}")):
            path.unlink(missing_ok=True)
        for path in self.dense.glob(f"*/{UNFINISHED}"):
            path.unlink(missing_ok=True)

    def manifest(self) -> dict[str, Any]:
        """The manifest as written last; empty when there is none or it cannot be read (then everything is redone)."""
        path = self.root / MANIFEST
        try:
            if path.stat().st_size > MOST_MANIFEST_BYTES:
                return {}
            found = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) and isinstance(found.get("stages", {}), dict) else {}

    def record(self, stage: str) -> StageRecord | None:
        """The record of a finished stage, if the manifest has one, just as it was written."""
        entry = self.manifest().get("stages", {}).get(stage)
        try:
            return StageRecord(**entry) if entry.pop(CHECK) == fingerprint(entry) else None
        except (AttributeError, KeyError, TypeError, RecursionError):
            return None

    def spoilt(self, record: StageRecord) -> list[str]:
        """Files of a finished stage that are gone or have another size."""
        return [name for name, size in record.files.items() if _size(self.root / name) != size]

    def forget(self, stages: tuple[str, ...]) -> None:
        """Take stages out of the manifest before their files are touched, so that it is never ahead of the files."""
        manifest = self.manifest()
        known = manifest.get("stages", {})
        if any(known.pop(stage, None) for stage in stages):
            self.write_manifest(manifest)

    def finish(self, stage: str, record: StageRecord, head: Mapping[str, Any]) -> None:
        """Enter a finished stage; `head` (settings, versions, ...) replaces the rest of the manifest."""
        entry = json.loads(json.dumps(asdict(record)))
        stages = self.manifest().get("stages", {}) | {stage: {**entry, CHECK: fingerprint(entry)}}
        self.write_manifest({**head, "stages": stages})

    def write_manifest(self, manifest: Mapping[str, Any]) -> None:
        """Replace the manifest as a whole."""
        with self.replacing(self.root / MANIFEST) as path:
            path.write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")

    @contextlib.contextmanager
    def replacing(self, target: Path) -> Iterator[Path]:
        """As the function of that name."""
        with replacing(target) as beside:
            yield beside

    def sizes(self, files: tuple[str, ...]) -> dict[str, int]:
        """Sizes of what a stage wrote, as its record holds them."""
        found = {name: _size(self.root / name) for name in files}
        return {name: size for name, size in found.items() if size is not None}


@contextlib.contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A path beside `target` to write to; it takes the target's place when the block ends without an error."""
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = target.with_name(f".{target.stem}.{os.getpid()}{target.suffix}")
    try:
        yield beside
        beside.replace(target)
    finally:
        beside.unlink(missing_ok=True)


def can_go_on(folder: Path, made_from: str) -> bool:
    """Whether a killed run was filling this folder from the same inputs; if not, what is there is removed.

    Args:
        folder: may be missing.
        made_from: fingerprint of the inputs.
    """
    if is_made_from(folder / UNFINISHED, made_from):
        return True
    shutil.rmtree(folder, ignore_errors=True)
    return False


def is_made_from(marker: Path, made_from: str) -> bool:
    """Whether a file says so."""
    try:
        return marker.read_text(encoding="utf-8") == made_from
    except (OSError, UnicodeDecodeError):
        return False


def mark_unfinished(folder: Path, made_from: str) -> None:
    """From now on a run that is killed can go on in this folder, which is made if it is missing."""
    with replacing(folder / UNFINISHED) as path:
        path.write_text(made_from, encoding="utf-8")


def mark_finished(folder: Path) -> None:
    """The folder is filled; the next time it is filled from nothing."""
    (folder / UNFINISHED).unlink()


def save_files(files: Mapping[str, bytes], folder: Path) -> tuple[Path, ...]:
    """Write files, each complete or not at all, the first one last: it names the others."""
    paths = tuple(folder / name for name in files)
    for path, data in reversed(list(zip(paths, files.values(), strict=True))):
        with replacing(path) as beside:
            beside.write_bytes(data)
    return paths


def fingerprint(*parts: Any) -> str:
    """Hash of JSON-able parts, independent of the order of keys."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def _cannot_write(folder: Path, err: OSError) -> InputError:
    return InputError(
        f"cannot write to {folder}: {err.strerror}",
        hint="make it writable, and the same command goes on; or name another output folder with -o",
    )


def _said(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8").strip() or "it has just begun"
    except (OSError, UnicodeDecodeError):
        return "it has just begun"


def _size(path: Path) -> int | None:
    if not path.exists():
        return None
    return -1 if path.is_dir() or path.name in SHARED else path.stat().st_size
