"""Read the user's input: a folder of photos or a video, optional masks, and the hashes of all files."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from stat import S_ISREG
from typing import Any

from sfm_app.errors import ConfigError, InputError
from sfm_app.hashing import digest_file, fingerprint
from sfm_app.photos.files import list_files, resolve_file
from sfm_app.photos.masks import list_masks
from sfm_app.photos.video.video_formats import is_video, read_head
from sfm_app.settings import PhotoSettings, Settings
from sfm_app.types import Photo, PhotoSet

Stamp = tuple[int, int]
"""Size in bytes, and time of the last change in nanoseconds."""
UNREADABLE = "unreadable"
"""Stands for the hash of a file that cannot be read."""
ParallelMap = Callable[[Callable[[str], str], Sequence[str]], Iterable[str]]
"""Calls a function for every item, possibly in parallel, and returns the results in order."""


@dataclass(frozen=True, slots=True)
class Source:
    """A folder of photos or a video, as it was when the run began."""

    path: Path
    video: bool
    files: Mapping[str, str]
    """Hashes of all files of the folder by name; for a video, its hash under an empty name."""
    mask_dir: Path | None
    """Folder of masks, if given."""
    masks: Mapping[str, str]
    """Hashes of the masks by name."""
    stamps: Mapping[Path, Stamp]
    """Sizes and times of the files, to detect later changes."""

    @property
    def fingerprint(self) -> str:
        """Hash of the path, the files and the masks."""
        return fingerprint(str(self.path.resolve()), self.files, self.masks)

    def check_settings(self, settings: Settings) -> None:
        """Check that the settings can be used with the source.

        Raises:
            ConfigError: a setting cannot be used with a video.
        """
        if self.video and settings.photos.images:
            raise ConfigError("--images lists photos of a folder, not frames of a video", hint="leave --images out")

    def content_hash(self, photos: PhotoSet) -> str:
        """Return a hash of the used photos and their masks; other files of the folder do not enter.

        Nor do camera groups: features and matches do not depend on which camera took a photo.
        """
        used = [self._content(photo) | {"group": ""} for photo in photos.photos]
        return fingerprint(used, photos.masks is not None)

    def photo_hashes(self, photos: PhotoSet) -> dict[str, str]:
        """Return a hash of each used photo by name: of its bytes, its mask, its size, and its camera group."""
        return {photo.name: fingerprint(self._content(photo), photos.masks is not None) for photo in photos.photos}

    def _content(self, photo: Photo) -> dict[str, Any]:
        """Return what results depend on of a photo."""
        read = {"bytes": self.files.get(photo.path, self.files.get("")), "mask bytes": self.masks.get(photo.mask)}
        return asdict(photo) | {"notes": ()} | read

    def digests(self) -> dict[str, str]:
        """Return the hashes of the files that can be read, by path in the folder; none for a video."""
        return {name: digest for name, digest in self.files.items() if name and digest != UNREADABLE}

    def check(self, photos: PhotoSet) -> None:
        """Check that the video, these photos and their masks have not changed since the run began.

        Raises:
            InputError: a file has changed.
        """
        used = {self.path} | {self.path / photo.path for photo in photos.photos}
        used |= {photos.masks / photo.mask for photo in photos.photos if photos.masks and photo.mask}
        for path in sorted(used & self.stamps.keys()):
            now = _stamp(path)
            if now != self.stamps[path]:
                what = "is gone" if now is None else "has changed"
                raise InputError(f"{path} {what} since the run began", hint="run again once the files are restored")


def read_source(path: Path, out: Path, options: PhotoSettings, spread: ParallelMap) -> Source:
    """List the input files and compute their hashes.

    Args:
        path: a folder of photos, or a video.
        out: the output folder; its files are not listed.
        options: may name a folder of masks or a list of the photos to use.
        spread: maps a function over files, possibly in parallel.

    Raises:
        InputError: the photos or the masks cannot be used.
    """
    video, mask_dir = is_video(read_head(path)), Path(options.masks) if options.masks else None
    listed = Path(options.images) if options.images else None
    names = [""] if video else list_files(path, out, listed, closed=() if mask_dir is None else (mask_dir,))
    mask_names = [] if mask_dir is None else list_masks(mask_dir, path, out)
    paths = [path / name for name in names] + [mask_dir / name for name in mask_names if mask_dir is not None]
    stamps = {file: stamp for file in paths if (stamp := _stamp(file)) is not None}
    files = {"": digest(path)} if video else _digests(path, names, spread)
    masks = {} if mask_dir is None else _digests(mask_dir, mask_names, spread)
    return Source(path, video, files, mask_dir, masks, stamps)


def digest(file: Path) -> str:
    """Return the hash of the bytes of a file; UNREADABLE if it cannot be read."""
    try:
        return digest_file(file)
    except OSError:
        return UNREADABLE


def _stamp(path: Path) -> Stamp | None:
    """Return size and time of a regular file; None if there is none."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return None
    return (found.st_size, found.st_mtime_ns) if S_ISREG(found.st_mode) else None


def _digests(folder: Path, names: Sequence[str], spread: ParallelMap) -> dict[str, str]:
    """Return the hashes of files in a folder by name; the reason instead of a hash if a file is not read."""

    def file_digest(name: str) -> str:
        place = resolve_file(folder, name)
        return place if isinstance(place, str) else digest(place)

    return dict(zip(names, spread(file_digest, names), strict=True))
