"""What a stage's result depends on: photos, settings, versions. And why a stage has to be done again."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from stat import S_ISREG
from typing import Any

from sfm_app.colmap.backend import versions as colmap_versions
from sfm_app.context import RunContext
from sfm_app.errors import InputError
from sfm_app.hashing import fingerprint
from sfm_app.parallel import ordered_map
from sfm_app.photos import head_of, is_video, place_of
from sfm_app.stages.photos import files_of, mask_folder, masks_of
from sfm_app.types import PhotoSet

Stamp = tuple[int, int]
"""Size in bytes, and time of the last change in nanoseconds."""

OTHER_PHOTOS = "the photos have changed"
CHANGES = 3
"""So many are named."""


@dataclass(frozen=True, slots=True)
class Source:
    """What the user has given: a folder of photos or a video, perhaps masks, and hashes of every file."""

    place: Path
    files: Mapping[str, str]
    """By name; a video alone has none."""
    masks: Mapping[str, str]
    """By name."""
    stamps: Mapping[Path, Stamp]
    """Sizes and times of the files, by which it is seen later that one has changed."""

    @property
    def print(self) -> str:
        """Hash of all of it."""
        return fingerprint(str(self.place.resolve()), self.files, self.masks)

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
        used = {self.place} | {self.place / photo.path for photo in photos.photos}
        used |= {photos.masks / photo.mask for photo in photos.photos if photos.masks and photo.mask}
        for path in sorted(used & self.stamps.keys()):
            now = _stamp(path)
            if now != self.stamps[path]:
                what = "is gone" if now is None else "has changed"
                raise InputError(f"{path} {what} since the run began", hint="run again when all is as it shall be")


def source_of(place: Path, run: RunContext) -> Source:
    """Read everything once.

    Raises:
        InputError: it cannot be used.
    """
    names = [""] if is_video(head_of(place)) else files_of(place, run)
    masks = mask_folder(run)
    mask_names = [] if masks is None else masks_of(place, run)
    paths = [place / name for name in names] + [masks / name for name in mask_names if masks is not None]
    stamps = {path: stamp for path in paths if (stamp := _stamp(path)) is not None}
    files = {"": digest(place)} if names == [""] else _contents(place, names, run)
    return Source(place, files, {} if masks is None else _contents(masks, mask_names, run), stamps)


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


def digest(file: Path) -> str:
    """Return hash of the bytes of a file."""
    try:
        with file.open("rb") as opened:
            return hashlib.file_digest(opened, "blake2b").hexdigest()
    except OSError:
        return "unreadable"


def stage_print(name: str, settings: Sequence[str], inputs: Sequence[str], run: RunContext) -> str:
    """Return hash of everything that a stage's result depends on: its inputs, its settings, the versions."""
    return fingerprint(name, made_with(settings, run), inputs)


def made_with(settings: Sequence[str], run: RunContext) -> dict[str, Any]:
    """Return the values of these settings, and the versions of what computes the result."""
    return {"settings": {key: value_of(run.settings.model_dump(), key) for key in settings}, "versions": versions()}


def why_again(name: str, settings: Sequence[str], inputs: str, run: RunContext) -> str | None:
    """Return why a stage has to be done; empty where it never was, None where it is up to date.

    Args:
        name: of the stage.
        settings: that its result depends on.
        inputs: its `stage_print`.
        run: the run.
    """
    record = run.workspace.manifest.record(name)
    if record is None:
        return ""
    if spoilt := run.workspace.manifest.spoilt(record):
        return f"{spoilt[0]} is gone or was changed"
    if record.fingerprint == inputs:
        return None
    found = list(_changes(record.made_with, json.loads(json.dumps(made_with(settings, run)))))
    more = f" and {len(found) - CHANGES} more" if len(found) > CHANGES else ""
    return f"{', '.join(found[:CHANGES])}{more}" if found else OTHER_PHOTOS


def _changes(before: Any, now: Mapping[str, Any], name: str = "") -> Iterator[str]:
    """Yield values that are others now, by their dotted names."""
    for key, new in now.items():
        old = before.get(key) if isinstance(before, Mapping) else None
        inner = f"{name}.{key}".removeprefix(".").removeprefix("settings.").removeprefix("versions.")
        if isinstance(new, dict):
            yield from _changes(old, new, inner.removeprefix("settings").removeprefix("versions"))
        elif old != new:
            yield f"{inner} {json.dumps(old)} -> {json.dumps(new)}"


def value_of(values: Any, key: str) -> Any:
    """Return a value of nested mappings by its dotted name; None where there is none."""
    for name in key.split("."):
        values = values.get(name) if isinstance(values, Mapping) else None
    return values


def manifest_head(run: RunContext) -> dict[str, Any]:
    """Return what the manifest says besides the stages."""
    return {"program": "sfm-app", "versions": versions(), "settings": run.settings.model_dump()}


def versions() -> dict[str, str]:
    """Return versions of what computes the result."""
    parts = ("sfm-app", "numpy", "numba", "opencv-contrib-python-headless", "open3d")
    return {name: version(name) for name in parts} | colmap_versions()
