"""The output folder: its layout, whether a run made it, and the lock that keeps other runs out."""

import contextlib
import errno
import os
import platform
import tempfile
from collections.abc import Iterator
from datetime import datetime
from itertools import chain
from pathlib import Path

from filelock import BaseFileLock, FileLock, Timeout

from sfm_app.atomic_io import UNFINISHED
from sfm_app.errors import InputError
from sfm_app.operating_system import is_link
from sfm_app.runtime.manifest import MANIFEST, Manifest

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
