"""What the user has given: photos or a video, perhaps masks, and hashes of every file."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from stat import S_ISREG

from sfm_app.context import RunContext
from sfm_app.errors import InputError
from sfm_app.hashing import fingerprint
from sfm_app.parallel import ordered_map
from sfm_app.photos import head_of, is_video, place_of
from sfm_app.stages.photos import files_of, mask_folder, masks_of
from sfm_app.types import PhotoSet

Stamp = tuple[int, int]
"""Size in bytes, and time of the last change in nanoseconds."""


@dataclass(frozen=True, slots=True)
class Source:
    """A folder of photos or a video, as it was when the run began."""

    path: Path
    files: Mapping[str, str]
    """Hashes by name; a video alone has none."""
    masks: Mapping[str, str]
    """Hashes by name."""
    stamps: Mapping[Path, Stamp]
    """Sizes and times of the files, by which it is seen later that one has changed."""

    @property
    def fingerprint(self) -> str:
        """Hash of all of it."""
        return fingerprint(str(self.path.resolve()), self.files, self.masks)

    def content(self, photos: PhotoSet) -> str:
        """Return hash of what stages take from the photos that are used; other files of the folder do not matter.

        Camera groups do not, either: features and matches are the same whoever took the photos.
        """
        used = [
            {**asdict(photo), "group": "", "notes": (), "bytes": self.files.get(photo.path, self.files.get(""))}
            | {"mask bytes": self.masks.get(photo.mask)}
            for photo in photos.photos
        ]
        return fingerprint(used, photos.masks is not None)

    def check(self, photos: PhotoSet) -> None:
        """Check that none of these photos, nor a mask of theirs, nor the video, has changed since.

        Raises:
            InputError: something has.
        """
        used = {self.path} | {self.path / photo.path for photo in photos.photos}
        used |= {photos.masks / photo.mask for photo in photos.photos if photos.masks and photo.mask}
        for path in sorted(used & self.stamps.keys()):
            now = _stamp(path)
            if now != self.stamps[path]:
                what = "is gone" if now is None else "has changed"
                raise InputError(f"{path} {what} since the run began", hint="run again once the files are restored")


def source_of(path: Path, run: RunContext) -> Source:
    """Read everything once.

    Args:
        path: a folder of photos, or a video.
        run: its settings may name masks, or list the photos to use.

    Raises:
        InputError: it cannot be used.
    """
    names = [""] if is_video(head_of(path)) else files_of(path, run)
    masks = mask_folder(run)
    mask_names = [] if masks is None else masks_of(path, run)
    paths = [path / name for name in names] + [masks / name for name in mask_names if masks is not None]
    stamps = {file: stamp for file in paths if (stamp := _stamp(file)) is not None}
    files = {"": digest(path)} if names == [""] else _contents(path, names, run)
    return Source(path, files, {} if masks is None else _contents(masks, mask_names, run), stamps)


def digest(file: Path) -> str:
    """Return hash of the bytes of a file."""
    try:
        with file.open("rb") as opened:
            return hashlib.file_digest(opened, "blake2b").hexdigest()
    except OSError:
        return "unreadable"


def _stamp(path: Path) -> Stamp | None:
    """Return size and time of a file; None where there is none."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return None
    return (found.st_size, found.st_mtime_ns) if S_ISREG(found.st_mode) else None


def _contents(folder: Path, names: Sequence[str], run: RunContext) -> dict[str, str]:
    """Return hashes of files in a folder by name; instead of a hash, why a file is not read."""

    def digest_of(name: str) -> str:
        place = place_of(folder, name)
        return place if isinstance(place, str) else digest(place)

    return dict(zip(names, ordered_map(run.executor, digest_of, names, ahead=4 * run.workers), strict=True))
