"""The output folder: its layout, whether a run made it, and the lock that keeps other runs out."""

import contextlib
import errno
import json
import os
import platform
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from datetime import datetime
from itertools import chain
from pathlib import Path
from typing import Any

from filelock import BaseFileLock, FileLock, Timeout

from sfm_app.errors import InputError
from sfm_app.files import UNFINISHED, fingerprint, replace_atomically
from sfm_app.numerical import json_text
from sfm_app.operating_system import is_link

# The manifest: which stages are finished, what each was made from, counted and wrote, and with what settings.

MANIFEST, PROGRAM = "manifest.json", "sfm-app"
FORMAT = 2
"""Version of the stages' files; raised when other versions of the program can no longer read them."""
CHECKSUM = "check"
"""Key in a record: hash of the rest. A record that was edited or cut off is ignored."""
PROBLEM = "problem"
"""Key of what ended the last run."""
MOST_BYTES = 64_000_000


@dataclass(frozen=True, slots=True)
class StageRecord:
    """Entry of the manifest for one finished stage."""

    fingerprint: str
    """Hash of everything that the stage's result depends on."""
    seconds: float
    counts: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, int] = field(default_factory=dict)
    """What the stage wrote, with the size in bytes; -1 for folders and the database, whose size readers may change."""
    peak_mb: int | None = None
    """Most memory that the program and its processes held during the stage, in MB; None if not measured."""
    made_with: Mapping[str, Any] = field(default_factory=dict)
    """The settings and versions that its result depends on."""
    digest: str = ""
    """Hash of what later runs read of it, so that damage is found before it is read."""
    cpu_seconds: float | None = None
    """Of the program and its processes, on all cores; None if not measured."""
    photos: Mapping[str, str] = field(default_factory=dict)
    """Hash of each photo by name, in the record of the first stage after the photos: a later run tells by it which
    photos came and went."""


class Manifest:
    """`manifest.json` of an output folder, and the sizes of the files that it lists."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.path = root / MANIFEST

    def read(self) -> dict[str, Any]:
        """Return the manifest; empty when it is missing or cannot be read (then everything is redone)."""
        try:
            if self.path.stat().st_size > MOST_BYTES:
                return {}
            found = json.loads(self.path.read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) and isinstance(found.get("stages", {}), dict) else {}

    def check_format(self) -> None:
        """Check that this program can read the files of the run.

        Raises:
            InputError: another version of the program wrote them.
        """
        found = self.read()
        if found.get("stages") and found.get("program") == PROGRAM and found.get("format") != FORMAT:
            raise InputError(
                f"the run in {self.root} was made by another version of sfm-app",
                hint="name another output folder with -o, or remove this one",
            )

    def check_begun(self) -> None:
        """Check that a run has left something that this program can read.

        Raises:
            InputError: there is no run, or another version of the program made it.
        """
        if not self.read():
            beside = self.root.resolve()
            beside = beside.with_name(f"{beside.name}-model")  # where a run without -o writes
            meant = f"\nis it {beside}?" if (beside / MANIFEST).exists() else ""
            raise InputError(
                f"{self.root} holds no run", hint=f"name the folder that `sfm-app run PHOTOS -o OUT` wrote{meant}"
            )
        self.check_format()

    def record(self, stage: str) -> StageRecord | None:
        """Return the record of a finished stage; None where there is none, or it was altered."""
        entry = self.read().get("stages", {}).get(stage)
        try:
            return StageRecord(**entry) if entry.pop(CHECKSUM) == fingerprint(entry) else None
        except (AttributeError, KeyError, TypeError, RecursionError):
            return None

    def changed_files(self, record: StageRecord) -> list[str]:
        """Return the files of a finished stage that are missing or have another size."""
        return [name for name, size in record.files.items() if _size(self.root / name) != size]

    def forget(self, stages: tuple[str, ...]) -> None:
        """Remove stages from the manifest before their files are touched, so that it never lists what is not there."""
        manifest = self.read()
        known = manifest.get("stages", {})
        if listed := [stage for stage in stages if stage in known]:
            for stage in listed:
                del known[stage]
            self.write(manifest)

    def finish(self, stage: str, record: StageRecord, head: Mapping[str, Any]) -> None:
        """Enter a finished stage.

        Args:
            stage: its name.
            record: what is known about its run and its files.
            head: settings, versions, ...; replaces the rest of the manifest.
        """
        entry = json.loads(json_text(asdict(record)))
        stages = self.read().get("stages", {}) | {stage: {**entry, CHECKSUM: fingerprint(entry)}}
        self.write({"format": FORMAT, **head, "stages": stages})

    def note_problem(self, problem: Mapping[str, Any]) -> None:
        """Note what ended a run, until a stage is finished again; an empty problem removes the note.

        Args:
            problem: plain values.
        """
        manifest = self.read()
        if problem != manifest.get(PROBLEM, {}):
            left = {key: value for key, value in manifest.items() if key != PROBLEM}
            self.write(left | ({PROBLEM: problem} if problem else {}))

    def write(self, manifest: Mapping[str, Any]) -> None:
        """Replace the manifest as a whole."""
        with replace_atomically(self.path) as path:
            path.write_text(json_text(manifest), encoding="utf-8", newline="\n")

    def sizes(self, files: tuple[str, ...]) -> dict[str, int]:
        """Return the sizes of a stage's files, as its record holds them."""
        found = {name: _size(self.root / name) for name in files}
        return {name: size for name, size in found.items() if size is not None}


def model_triangles(stages: Mapping[str, Any]) -> int | None:
    """Return how many triangles the model has, None where there is none: texturing may cut some of the surface's.

    Args:
        stages: of a manifest, by name.
    """
    counts = [stages.get(stage, {}).get("counts", {}).get("triangles") for stage in ("texture", "mesh")]
    return next((count for count in counts if count), None)


def _size(path: Path) -> int | None:
    if not path.exists():
        return None
    return -1 if path.is_dir() or path.suffix == ".db" else path.stat().st_size


DATABASE, CALIBRATION, SCENE, SCALE = "database.db", "calibration.json", "scene.json", "scale.json"
FOLDERS = ("photos", "frames", "masks", "sparse", "other_models", "dense", "surface", "texture")
OUTPUT_NAMES = (*FOLDERS, DATABASE, CALIBRATION, SCENE, SCALE)
"""Names of files and folders that a run removes before it writes them."""
LOCK, HOLDER = ".lock", ".held-by.txt"
LOG, PARTS, FEATURES, MAPPING = "log.txt", "view_graph_parts", "feature_parts", ".mapping"
EARLIER, PARCELS, SIFT_ROWS = ".earlier", ".cluster", ".sift_rows"
LINK_CHECKED = (*OUTPUT_NAMES, LOCK, HOLDER, LOG, PARTS, FEATURES, MAPPING, EARLIER, PARCELS, SIFT_ROWS)
"""Names that a run writes to without replacing them: a link there would lead it out of the folder."""
FINE = "fine.npz"
PHOTO_SET, PHOTO_STATS, VIEW_GRAPH = "photos.json", ".photo_stats.npz", "view_graph.npz"


class Workspace:
    """One output folder."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.manifest = Manifest(root)

    @property
    def photos(self) -> Path:
        """Upright photos that COLMAP can read: links where it can read the file itself, else copies."""
        return self.root / "photos"

    @property
    def frames(self) -> Path:
        """The chosen frames of a video."""
        return self.root / "frames"

    @property
    def frames_marker(self) -> Path:
        """Marker beside the frames until they are read: which were chosen, and from which inputs."""
        return self.root / "frames.unfinished.json"

    @property
    def masks(self) -> Path:
        """Masks of the photos, upright and of their size, where masks are given."""
        return self.root / "masks"

    @property
    def database(self) -> Path:
        """COLMAP's database: photos, keypoints and matches."""
        return self.root / DATABASE

    @property
    def photo_set(self) -> Path:
        """What is known about the photos."""
        return self.root / PHOTO_SET

    @property
    def photo_stats(self) -> Path:
        """What was measured on every photo: a run that knows a file by its bytes does not decode it again."""
        return self.root / PHOTO_STATS

    @property
    def view_graph(self) -> Path:
        """Fundamental matrices."""
        return self.root / VIEW_GRAPH

    @property
    def calibration(self) -> Path:
        """Cameras calibrated from pairs."""
        return self.root / CALIBRATION

    @property
    def scene(self) -> Path:
        """What is known about the scene besides COLMAP's model: refined cameras, and why photos are not placed."""
        return self.root / SCENE

    @property
    def scale(self) -> Path:
        """The frame of exported files: how large the scene is, and where."""
        return self.root / SCALE

    @property
    def sparse(self) -> Path:
        """COLMAP model of the main scene."""
        return self.root / "sparse"

    @property
    def other_models(self) -> Path:
        """COLMAP models of photos that are not connected to the main one, numbered from 1."""
        return self.root / "other_models"

    @property
    def dense(self) -> Path:
        """COLMAP's dense workspace: undistorted photos, depth and normal maps."""
        return self.root / "dense"

    @property
    def surface(self) -> Path:
        """Fused points, and the surface through them."""
        return self.root / "surface"

    @property
    def fine_surface(self) -> Path:
        """The surface before it was simplified, where a normal map is made of it."""
        return self.surface / FINE

    @property
    def texture(self) -> Path:
        """The surface with its texture."""
        return self.root / "texture"

    @property
    def database_marker(self) -> Path:
        """Marker beside the database while it is filled: fingerprint of the inputs."""
        return self.root / f"database.{UNFINISHED}"

    @property
    def feature_parts(self) -> Path:
        """Features of photos while they are found and matched."""
        return self.root / FEATURES

    @property
    def view_graph_parts(self) -> Path:
        """Fundamental matrices while they are estimated."""
        return self.root / PARTS

    @property
    def earlier(self) -> "Workspace":
        """Files of an earlier run with other photos, while this run goes on from them."""
        return Workspace(self.root / EARLIER)

    @property
    def parcels(self) -> Path:
        """Large values on their way between the machines of a cluster."""
        return self.root / PARCELS

    @property
    def sift_rows(self) -> Path:
        """What the workers of a cluster read while they find and match features, and what they have found."""
        return self.root / SIFT_ROWS

    @property
    def log(self) -> Path:
        """What the last runs did, with the traceback of an error."""
        return self.root / LOG

    def create(self) -> None:
        """Make the folder and check that it is writable.

        Raises:
            InputError: it is not, or it holds files that a run would overwrite, or links that it would write through.
        """
        known = any((self.root / name).exists() for name in (LOCK, MANIFEST))
        foreign = [] if known else [name for name in OUTPUT_NAMES if (self.root / name).exists()]
        if foreign:
            raise InputError(
                f"{self.root / foreign[0]} exists, and no run has made it", hint="name another output folder with -o"
            )
        link = next(self._links(), None)
        if link:
            raise InputError(f"{link} is a link, and no run has made it", hint="name another output folder with -o")
        if self.root.is_file():
            raise InputError(f"cannot write to {self.root}: it is a file", hint="name an output folder with -o")
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
        """Yield links that no run has made; links to photos are left out, since laying out replaces them."""
        for path in (self.root / name for name in LINK_CHECKED):
            if is_link(path):
                yield path
            elif path.name != self.photos.name:
                yield from (below for below in path.rglob("*") if is_link(below))

    def check_no_overlap(self, photos: Path, what: str = "photos") -> None:
        """Check that a run would not write over its photos, or its masks.

        Args:
            photos: folder or file with them.
            what: their name in the error message.

        Raises:
            InputError: it would overwrite them.
        """
        folder, out = photos.resolve(), self.root.resolve()
        if folder == out:
            raise InputError(
                f"{photos} cannot be both the {what} and the output", hint="name another output folder with -o"
            )
        if any(folder.is_relative_to(out / name) for name in OUTPUT_NAMES):
            raise InputError(
                f"{photos} lies where the run in {self.root} keeps its own files",
                hint="name another output folder with -o",
            )

    @contextlib.contextmanager
    def hold_lock(self) -> Iterator[None]:
        """Hold the lock that keeps other runs out; the system releases it when this process ends, however it ends.

        Raises:
            InputError: another run is at work here.
        """
        holder = self.root / HOLDER
        lock = FileLock(self.root / LOCK, timeout=0)
        try:
            lock.acquire()
        except Timeout:
            raise InputError(
                f"another run is at work in {self.root}: {_read_holder(holder)}",
                hint="wait for it, end it, or name another output folder with -o",
            ) from None
        try:
            started = datetime.now().astimezone().isoformat(" ", "seconds")
            holder.write_text(
                f"process {os.getpid()} on {platform.node()} since {started}\n", encoding="utf-8", newline="\n"
            )
            yield
        finally:
            with contextlib.suppress(OSError):  # the folder may be gone or read-only: the run reports that itself
                holder.unlink(missing_ok=True)
            self._release(lock)

    def _release(self, lock: BaseFileLock) -> None:
        """Release the lock, but keep its file, which Windows removes: by it, the next run knows that one was here."""
        file = self.root / LOCK
        was_there = file.exists()
        lock.release()
        if was_there and not file.exists():
            with contextlib.suppress(OSError):
                file.touch()

    def check_exists(self) -> None:
        """Check that the folder still exists during a run, and is writable.

        If it was removed and holds only what the run has written since, it is marked as made by a run: otherwise the
        next run would refuse it.

        Raises:
            InputError: it was removed, or is not writable.
        """
        if not (self.root / LOCK).exists():
            left = {path.name for path in self.root.iterdir()} if self.root.is_dir() else set()
            if left and left <= {*LINK_CHECKED, PHOTO_SET, VIEW_GRAPH}:
                (self.root / LOCK).touch()
            raise InputError(f"{self.root} was removed while the run was at work", hint="run again")
        self._check_writable()

    def discard_unfinished(self) -> None:
        """Remove the markers of unfinished work, so that no run resumes it."""
        markers = (self.root.glob(f"{folder}/{UNFINISHED}") for folder in ("*", "*/*"))
        for path in (self.database_marker, self.frames_marker, *chain(*markers)):
            path.unlink(missing_ok=True)


class SubWorkspace(Workspace):
    """A folder inside the output folder, for another hypothesis about the same photos.

    Args:
        of: the run's workspace, which has the photos and masks.
        name: of the folder.
    """

    def __init__(self, of: Workspace, name: str) -> None:
        super().__init__(of.root / name)
        self.of = of

    @property
    def photos(self) -> Path:
        """Photos of the run itself."""
        return self.of.photos

    @property
    def masks(self) -> Path:
        """Masks of the run itself."""
        return self.of.masks


def _cannot_write(folder: Path, err: OSError) -> InputError:
    return InputError(
        f"cannot write to {folder}: {err.strerror}",
        hint="make it writable and run the same command again, or name another output folder with -o",
    )


def _read_holder(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8").strip() or "it has just begun"
    except (OSError, UnicodeDecodeError):
        return "it has just begun"
