"""The user's photos: names and hashes, and their copies in the output folder."""

import filecmp
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path, PurePosixPath
from stat import S_ISREG
from typing import Any

from PIL import Image

from sfm_app.errors import ConfigError, InputError
from sfm_app.files import digest_file, fingerprint, is_below
from sfm_app.operating_system import is_link, link_or_copy
from sfm_app.photos.decode import UnreadableError, large_photo_lock, read_picture, rotate_to_sensor, upright_image
from sfm_app.photos.files import is_video, list_photos, read_head, resolve_file
from sfm_app.photos.masks import list_masks, split_mask_path
from sfm_app.settings import PhotoSettings
from sfm_app.types import GpsPosition, Photo, PhotoSet

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
    """Hashes of the files by name; for a video, one hash under an empty name."""
    left_out: Mapping[str, str]
    """Reasons why files are no photos, by name; these are not opened."""
    mask_dir: Path | None
    masks: Mapping[str, str]
    """Hashes of the masks by name."""
    one_mask: bool
    """True where the user gave one file for all photos."""
    stamps: Mapping[Path, Stamp]
    """Sizes and times of the files, to detect later changes."""
    positions: Mapping[str, GpsPosition] = field(default_factory=dict)
    """By the user's file, by name of the photo."""
    named: Mapping[str, str] = field(default_factory=dict)
    """What the user calls each file where several inputs were gathered."""
    videos: Sequence[str] = ()
    """Names of the videos among gathered files."""
    missing: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Photos that a file of positions names and that are not there, by the file."""

    @property
    def fingerprint(self) -> str:
        """Hash of the path, the files and the masks; gathered files move with the output folder."""
        path = self.named or str(self.path.resolve())
        places = self.positions, self.missing
        return fingerprint(path, self.files, self.left_out, self.masks, self.one_mask, places, self.videos)

    def label(self, name: str) -> str:
        """Return what the user calls a file, or a frame of a video."""
        video, _, frame = name.rpartition("/")
        return f"{self.named.get(video, video)}: {frame}" if video in self.videos else self.named.get(name, name)

    def content_hash(self, photos: PhotoSet) -> str:
        """Return a hash of the used photos and their masks, without camera groups, which do not affect features."""
        used = [self._content(photo) | {"group": ""} for photo in photos.photos]
        return fingerprint(used, photos.has_masks)

    def photo_hashes(self, photos: PhotoSet) -> dict[str, str]:
        """Return a hash of the bytes, mask, size and camera group of each used photo, by name."""
        return {photo.name: fingerprint(self._content(photo), photos.has_masks) for photo in photos.photos}

    def _content(self, photo: Photo) -> dict[str, Any]:
        """Return all values of a photo that results depend on."""
        video = photo.path.rpartition("/")[0]  # a folder of frames has the name of its video
        digest = self.files.get(photo.path, self.files.get(video))
        return asdict(photo) | {"notes": (), "named": "", "bytes": digest, "mask bytes": self.masks.get(photo.mask)}

    def digests(self) -> dict[str, str]:
        """Return the hashes of readable files by path in the folder; none for a video."""
        return {name: digest for name, digest in self.files.items() if name and digest != UNREADABLE}

    def check(self, photos: PhotoSet) -> None:
        """Raise an InputError if the video, a photo or its mask has changed since the run began."""
        used = {self.path} | {self.path / name for name in (*self.videos, *(photo.path for photo in photos.photos))}
        used |= {photos.masks / photo.mask for photo in photos.photos if photos.masks and photo.mask}
        for path in sorted(used & self.stamps.keys()):
            stamp = _stamp(path)
            if stamp != self.stamps[path]:
                change = "is gone" if stamp is None else "has changed"
                name = path.relative_to(self.path).as_posix() if path.is_relative_to(self.path) else ""
                raise InputError(f"{self.named.get(name, path)} {change} since the run began", hint="restore it")


def read_source(path: Path, out: Path, options: PhotoSettings, spread: ParallelMap) -> Source:
    """List the input files and compute their hashes; raise an InputError if the photos or the masks cannot be used."""
    video = is_video(read_head(path))
    mask_dir, one_mask = split_mask_path(options.masks) if options.masks else (None, "")
    listed = Path(options.images) if options.images else None
    if video and listed is not None:
        raise ConfigError("--images lists photos of a folder, not frames of a video", hint="leave --images out")
    closed = () if mask_dir is None or one_mask else (mask_dir,)
    found = {"": ""} if video else list_photos(path, out, listed, closed)
    if one_mask:
        mask = Path(options.masks).resolve()
        found |= {name: "the mask of all photos" for name in found if (path / name).resolve() == mask}
    names = [name for name, reason in found.items() if not reason]
    left_out = {name: reason for name, reason in found.items() if reason}
    mask_names = list_masks(options.masks, path, out) if options.masks else []
    paths = [path / name for name in names] + [mask_dir / name for name in mask_names if mask_dir is not None]
    stamps = {file: stamp for file in paths if (stamp := _stamp(file)) is not None}
    files = {"": digest(path)} if video else _digests(path, names, spread)
    masks = {} if mask_dir is None else _digests(mask_dir, mask_names, spread)
    return Source(path, video, files, left_out, mask_dir, masks, bool(one_mask), stamps)


def digest(file: Path) -> str:
    """Return the hash of the bytes of a file; UNREADABLE if it cannot be read."""
    try:
        return digest_file(file)
    except OSError:
        return UNREADABLE


def _stamp(path: Path) -> Stamp | None:
    try:
        stat = path.stat()
    except (OSError, ValueError):
        return None
    return (stat.st_size, stat.st_mtime_ns) if S_ISREG(stat.st_mode) else None


def _digests(folder: Path, names: Sequence[str], spread: ParallelMap) -> dict[str, str]:
    """Return the hashes of files by name; for a file that is not opened, the reason."""

    def file_digest(name: str) -> str:
        place = resolve_file(folder, name)
        return place if isinstance(place, str) else digest(place)

    return dict(zip(names, spread(file_digest, names), strict=True))


MOST_NAME_BYTES = 200
"""Bytes of a file's name, of which file systems allow 255: later stages append words such as `.geometric.bin`."""


def assign_names(photos: Iterable[Photo]) -> Iterator[Photo]:
    """Yield photos with unique printable names of few bytes, also without case, and an extension that COLMAP writes."""
    photos = list(photos)
    given, taken = {photo.path.casefold() for photo in photos}, set[str]()
    for photo in photos:
        name = "".join(c if c.isprintable() else "_" for c in photo.path)
        if PurePosixPath(name).suffix.lower() not in (".jpg", ".jpeg", ".png"):
            name += ".jpg" if photo.lossy else ".png"
        own = PurePosixPath(name)
        if len(own.name.encode()) > MOST_NAME_BYTES:
            stem = own.stem.encode()[: MOST_NAME_BYTES - len(own.suffix)].decode(errors="ignore")
            name = str(own.with_name(stem + own.suffix))
        while name.casefold() in taken or (name != photo.path and name.casefold() in given):
            name = str(PurePosixPath(name).with_name(f"_{PurePosixPath(name).name}"))
        taken.add(name.casefold())
        yield replace(photo, name=name, original=photo.path)


def lay_out(photo: Photo, folder: Path, target: Path) -> None:
    """Link a photo for COLMAP, or copy it in 8 bits in sensor orientation; UnreadableError if its file has changed."""
    place = target / photo.name
    if not (is_below(photo.name) and place.parent.resolve().is_relative_to(target.resolve())):
        raise UnreadableError("its name leads out of the folder")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.unlink(missing_ok=True)  # writing to an existing link would change its target
    source = resolve_file(folder, photo.path)
    if isinstance(source, str):
        raise UnreadableError(source)
    if not photo.needs_copy:
        # links to video frames are relative, since both move with the output folder
        relative = folder.parent.resolve() == target.parent.resolve()
        link_or_copy(place, os.path.relpath(source, place.parent.resolve()) if relative else source, source)
        return
    with large_photo_lock(source):
        _copy(photo, source, place)


def is_laid_out(photo: Photo, folder: Path, target: Path) -> bool:
    """Return whether the target holds the link to a photo without conversion, or its unchanged copy."""
    place, source = target / photo.name, resolve_file(folder, photo.path)
    if isinstance(source, str) or not place.is_file():
        return False
    return place.resolve() == source or (not is_link(place) and filecmp.cmp(source, place, shallow=False))


def _copy(photo: Photo, source: Path, place: Path) -> None:
    copy = rotate_to_sensor(upright_image(read_picture(source)), photo.turn_deg)
    if copy.size != (photo.width, photo.height):
        copy = copy.resize((photo.width, photo.height), Image.Resampling.LANCZOS)
    if photo.lossy:
        copy.save(place, "JPEG", quality=95)
    else:
        copy.save(place, "PNG", compress_level=1)
