"""The output folder: its layout, its manifest, and the lock that keeps other runs out."""

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
from sfm_app.files import (
    LOCK,
    LOG,
    MANIFEST,
    PROGRAM,
    RUN_FOLDERS,
    UNFINISHED,
    fingerprint,
    read_object,
    replace_atomically,
)
from sfm_app.numerical import json_text
from sfm_app.operating_system import is_link

# The manifest: the finished stages with their inputs, settings, figures and files.

FORMAT = 2
"""Version of the stages' files; it increases when older programs can no longer read them."""
CHECKSUM = "check"
"""Key of a record's hash. The program ignores a record that was edited or cut off."""
PROBLEM = "problem"
"""Key of the last run's error."""


@dataclass(frozen=True, slots=True)
class StageRecord:
    """Entry of the manifest for one finished stage."""

    fingerprint: str
    """Hash of everything that determines the stage's result."""
    seconds: float
    counts: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, int] = field(default_factory=dict)
    """Files with sizes in bytes; -1 for folders and the database, whose size readers may change."""
    peak_mb: int | None = None
    """Peak memory of the program and its processes, in MB; None if not measured."""
    made_with: Mapping[str, Any] = field(default_factory=dict)
    """Settings and versions that determine the result."""
    digest: str = ""
    """Hash of the files that later runs read; they check it before reading."""
    cpu_seconds: float | None = None
    """Of the program and its processes, on all cores; None if not measured."""
    photos: Mapping[str, str] = field(default_factory=dict)
    """Hash of each photo by name, in the record of the first stage after the photos."""


class Manifest:
    """`manifest.json` of an output folder, and the sizes of the files that it lists."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.path = root / MANIFEST

    def read(self) -> dict[str, Any]:
        """Return the manifest; empty if it is missing or unreadable (then all stages run again)."""
        manifest = read_object(self.path)
        return manifest if isinstance(manifest.get("stages", {}), dict) else {}

    def check_format(self) -> None:
        """Check that this program can read the files of the run; InputError if another version wrote them."""
        manifest = self.read()
        if manifest.get("stages") and manifest.get("program") == PROGRAM and manifest.get("format") != FORMAT:
            raise InputError(
                f"the run in {self.root} was made by another version of sfm-app",
                hint="name another output folder with -o, or remove this one",
            )

    def check_begun(self) -> None:
        """Check that the folder holds a run that this program can read; InputError if not."""
        if not self.read():
            default = self.root.resolve()
            default = default.with_name(f"{default.name}-model")  # where a run without -o writes
            guess = f"\nis it {default}?" if (default / MANIFEST).exists() else ""
            raise InputError(f"{self.root} holds no run", hint=f"name a folder that `sfm-app run` wrote{guess}")
        self.check_format()

    def record(self, stage: str) -> StageRecord | None:
        """Return the record of a finished stage; None if there is none, or it was altered."""
        entry = self.read().get("stages", {}).get(stage)
        try:
            return StageRecord(**entry) if entry.pop(CHECKSUM) == fingerprint(entry) else None
        except (AttributeError, KeyError, TypeError, RecursionError):
            return None

    def changed_files(self, record: StageRecord) -> list[str]:
        """Return the files of a finished stage that are missing or have another size."""
        return [name for name, size in record.files.items() if _size(self.root / name) != size]

    def forget(self, stages: tuple[str, ...]) -> None:
        """Remove stages from the manifest before their files are touched, so that it never lists missing files."""
        manifest = self.read()
        known = manifest.get("stages", {})
        if listed := [stage for stage in stages if stage in known]:
            for stage in listed:
                del known[stage]
            self.write(manifest)

    def finish(self, stage: str, record: StageRecord, head: Mapping[str, Any]) -> None:
        """Add a finished stage; `head` (settings, versions, ...) replaces the rest of the manifest."""
        entry = json.loads(json_text(asdict(record)))
        stages = self.read().get("stages", {}) | {stage: {**entry, CHECKSUM: fingerprint(entry)}}
        self.write({"format": FORMAT, **head, "stages": stages})

    def note_problem(self, problem: Mapping[str, Any]) -> None:
        """Note the error of a run until a stage is finished again; an empty problem removes the entry."""
        manifest = self.read()
        if problem != manifest.get(PROBLEM, {}):
            rest = {key: value for key, value in manifest.items() if key != PROBLEM}
            self.write(rest | ({PROBLEM: problem} if problem else {}))

    def write(self, manifest: Mapping[str, Any]) -> None:
        """Replace the manifest as a whole."""
        with replace_atomically(self.path) as path:
            path.write_text(json_text(manifest), encoding="utf-8", newline="\n")

    def sizes(self, files: tuple[str, ...]) -> dict[str, int]:
        """Return the sizes of a stage's files for its record."""
        sizes = {name: _size(self.root / name) for name in files}
        return {name: size for name, size in sizes.items() if size is not None}


def model_triangles(stages: Mapping[str, Any]) -> int | None:
    """Return the model's triangles by the records of stages; texturing may cut some of the surface's."""
    counts = [stages.get(stage, {}).get("counts", {}).get("triangles") for stage in ("texture", "mesh")]
    return next((count for count in counts if count), None)


def _size(path: Path) -> int | None:
    if not path.exists():
        return None
    return -1 if path.is_dir() or path.suffix == ".db" else path.stat().st_size


DATABASE, CALIBRATION, SCENE, SCALE = "database.db", "calibration.json", "scene.json", "scale.json"
INPUTS = ".inputs"
OUTPUT_NAMES = (*RUN_FOLDERS, DATABASE, CALIBRATION, SCENE, SCALE, INPUTS)
"""Files and folders that a run replaces."""
HOLDER, ELSEWHERE = ".held-by.txt", "name another output folder with -o"
PARTS, FEATURES, MAPPING = "view_graph_parts", "feature_parts", ".mapping"
EARLIER, CLUSTER_FILES, SIFT_ROWS = ".earlier", ".cluster", ".sift_rows"
LINK_CHECKED = (*OUTPUT_NAMES, LOCK, HOLDER, LOG, PARTS, FEATURES, MAPPING, EARLIER, CLUSTER_FILES, SIFT_ROWS)
"""Names that a run writes to: a link there would lead it out of the folder."""
FINE = "fine.npz"
PHOTO_SET, PHOTO_STATS, VIEW_GRAPH = "photos.json", ".photo_stats.npz", "view_graph.npz"


class Workspace:
    """One output folder."""

    def __init__(self, root: Path) -> None:
        self.root, self.manifest, self._is_held = root, Manifest(root), False
        self.inputs = root / INPUTS
        """The files of several inputs."""
        self.photos = root / "photos"
        """Upright photos that COLMAP can read: links if it can read the file itself, else copies."""
        self.frames = root / "frames"
        self.frames_marker = root / "frames.unfinished.json"
        """Chosen frames and fingerprint of the inputs, until the frames are read."""
        self.masks = root / "masks"
        """Upright masks of the photos' size, if any."""
        self.database = root / DATABASE
        """COLMAP's database: photos, keypoints and matches."""
        self.photo_set = root / PHOTO_SET
        self.photo_stats = root / PHOTO_STATS
        """Measurements of every photo: a run that knows a file by its bytes does not decode it again."""
        self.view_graph = root / VIEW_GRAPH
        self.calibration = root / CALIBRATION
        """Cameras calibrated from pairs."""
        self.scene = root / SCENE
        """Refined cameras, and reasons for unplaced photos."""
        self.scale = root / SCALE
        """Frame of exported files."""
        self.sparse = root / "sparse"
        """COLMAP model of the main scene."""
        self.other_models = root / "other_models"
        """COLMAP models of photos without connection to the main scene, numbered from 1."""
        self.dense = root / "dense"
        """COLMAP's dense workspace: undistorted photos, depth and normal maps."""
        self.surface = root / "surface"
        """Fused points, and the surface through them."""
        self.fine_surface = self.surface / FINE
        """Surface before simplification, for a normal map."""
        self.texture = root / "texture"
        self.database_marker = root / f"database.{UNFINISHED}"
        """Fingerprint of the inputs while the database is filled."""
        self.feature_parts = root / FEATURES
        """Features of photos while they are found and matched."""
        self.view_graph_parts = root / PARTS
        """Fundamental matrices while they are estimated."""
        self.cluster_files = root / CLUSTER_FILES
        """Large values for the workers of a cluster."""
        self.sift_rows = root / SIFT_ROWS
        """Features and matches that the workers of a cluster exchange."""
        self.log = root / LOG
        """Log of the last runs, with the traceback of an error."""

    @property
    def earlier(self) -> "Workspace":
        """Files of an earlier run with other photos, while this run resumes from them."""
        return Workspace(self.root / EARLIER)

    def create(self) -> None:
        """Make the folder; InputError if it is not writable, or has files or links that a run would overwrite."""
        known = any((self.root / name).exists() for name in (LOCK, MANIFEST))
        foreign = [] if known else [name for name in OUTPUT_NAMES if (self.root / name).exists()]
        if foreign:
            raise InputError(f"{self.root / foreign[0]} exists, and no run has made it", hint=ELSEWHERE)
        link = next(self._links(), None)
        if link:
            raise InputError(f"{link} is a link, and no run has made it", hint=ELSEWHERE)
        if self.root.is_file():
            raise InputError(f"cannot write to {self.root}: it is a file", hint=ELSEWHERE)
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
        """Yield links that no run has made, except those to photos, which each run replaces."""
        for path in (self.root / name for name in LINK_CHECKED):
            if is_link(path):
                yield path
            elif path.name != self.photos.name:
                yield from (below for below in path.rglob("*") if is_link(below))

    def check_no_overlap(self, photos: Path, what: str = "photos") -> None:
        """Check that a run would not overwrite its photos or masks (`what`); InputError if it would."""
        folder, out = photos.resolve(), self.root.resolve()
        if folder == out:
            raise InputError(f"{photos} cannot be both the {what} and the output", hint=ELSEWHERE)
        if any(folder.is_relative_to(out / name) for name in OUTPUT_NAMES):
            raise InputError(f"{photos} lies where the run in {self.root} keeps its own files", hint=ELSEWHERE)

    @contextlib.contextmanager
    def hold_lock(self) -> Iterator[None]:
        """Hold the lock that keeps other runs out (InputError) until the outermost block, or this process, ends."""
        if self._is_held:
            yield
            return
        holder = self.root / HOLDER
        lock = FileLock(self.root / LOCK, timeout=0)
        try:
            lock.acquire()
        except Timeout:
            raise InputError(
                f"another run is at work in {self.root}: {_read_holder(holder)}",
                hint=f"wait for it, end it, or {ELSEWHERE}",
            ) from None
        try:
            started = datetime.now().astimezone().isoformat(" ", "seconds")
            holder.write_text(f"process {os.getpid()} on {platform.node()} since {started}", encoding="utf-8")
            self._is_held = True
            yield
        finally:
            self._is_held = False
            with contextlib.suppress(OSError):  # the folder may be gone or read-only, which the run reports
                holder.unlink(missing_ok=True)
            self._release(lock)

    def _release(self, lock: BaseFileLock) -> None:
        """Release the lock, and keep its file, which Windows removes: it marks the folder as made by a run."""
        file = self.root / LOCK
        was_there = file.exists()
        lock.release()
        if was_there and not file.exists():
            with contextlib.suppress(OSError):
                file.touch()

    def check_exists(self) -> None:
        """Check that the folder still exists during a run, and is writable; if it was made again, it stays a run's."""
        if not (self.root / LOCK).exists():
            names = {path.name for path in self.root.iterdir()} if self.root.is_dir() else set()
            if names and names <= {*LINK_CHECKED, PHOTO_SET, VIEW_GRAPH}:
                (self.root / LOCK).touch()
            raise InputError(f"{self.root} was removed during the run", hint="run again")
        self._check_writable()

    def discard_unfinished(self) -> None:
        """Remove the markers of unfinished work, so that no run resumes it."""
        markers = (self.root.glob(f"{folder}/{UNFINISHED}") for folder in ("*", "*/*", f"{self.frames.name}/**"))
        for path in (self.database_marker, self.frames_marker, *chain(*markers)):
            path.unlink(missing_ok=True)


class SubWorkspace(Workspace):
    """A folder inside a run's output folder, for another hypothesis about the same photos."""

    def __init__(self, of: Workspace, name: str) -> None:
        super().__init__(of.root / name)
        self.photos, self.masks = of.photos, of.masks


def _cannot_write(folder: Path, err: OSError) -> InputError:
    return InputError(f"cannot write to {folder}: {err.strerror}", hint=f"make it writable, or {ELSEWHERE}")


def _read_holder(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8").strip() or "it has just begun"
    except (OSError, UnicodeDecodeError):
        return "it has just begun"
