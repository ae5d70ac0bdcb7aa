"""Several inputs as one folder: photos, folders of photos, videos, wildcards and ZIP archives."""

import contextlib
import glob
import json
import os
import shutil
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

from sfm_app.errors import InputError
from sfm_app.files import fingerprint, is_below, read_object, replace_atomically, replace_folder
from sfm_app.operating_system import share_bytes
from sfm_app.photos.files import HINT, is_video, list_files, list_photos, read_head, resolve_file
from sfm_app.photos.source import ParallelMap, digest

MOST_ZIP_BYTES = 100_000_000_000
"""Unpacked size of an archive: thousands of large photos."""
MOST_RATIO = 200
"""Unpacked size by packed size: photos hardly shrink, and bombs shrink a thousandfold."""
MOST_NAME_BYTES = 255
"""Bytes of a name on common file systems."""
PREVIEWS, NOTES = (".lrf", ".lrv", ".thm"), (".srt", ".xmp", ".txt")
"""Suffixes of what cameras write beside videos: small copies of them, and texts."""
MISSING_HINT = f'{HINT}, with quotes around a name with spaces: "My photos"'
ZIP_HINT = "unpack it yourself, and name the folder"


@dataclass(frozen=True, slots=True)
class Gathered:
    """The files of several inputs, by their names in one folder."""

    files: dict[str, tuple[Path, str]] = field(default_factory=dict)
    """Path of each, and the member of an archive; empty for a file of its own."""
    labels: dict[str, str] = field(default_factory=dict)
    """What the user calls each: `more/a.jpg`, `pack.zip: a/b.jpg`."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Reasons by the user's names."""

    def add(self, name: str, label: str, place: Path, member: str = "") -> None:
        """Add a file."""
        self.files[name], self.labels[name] = (place, member), label

    def videos(self, folder: Path) -> tuple[list[str], dict[str, str]]:
        """Return the videos in the filled folder, and the films and previews beside others, with reasons."""
        paths = {name: PurePosixPath(name.casefold()) for name in self.files}
        previews = {name for name, path in paths.items() if "/" in name and path.suffix in PREVIEWS}
        found = {name for name in self.files.keys() - previews if is_video(read_head(folder / name))}
        others = [paths[name] for name in self.files.keys() - found]
        photos = {path.with_suffix("") for path in others if path.suffix not in (*PREVIEWS, *NOTES)}
        beside = {name for name in found if "/" in name and paths[name].with_suffix("") in photos}
        left_out = dict.fromkeys(beside, "a video beside the photo of its name")
        return sorted(found - beside), left_out | dict.fromkeys(previews, "a small copy of a video")


def expand(inputs: Sequence[Path]) -> list[Path]:
    """Return the inputs in order of their names, once each; a wildcard stands for its files."""
    found: set[Path] = set()
    for path in inputs:
        matches = [] if path.exists() else [Path(name) for name in glob.glob(str(path), recursive=True)]  # noqa: PTH207
        found |= set(matches or [path])
    if not found:
        raise InputError("no photos are named", hint=HINT)
    return sorted({path.resolve(): path for path in sorted(found)}.values(), key=lambda path: str(path.resolve()))


def is_single(inputs: Sequence[Path], out: Path) -> bool:
    """Return whether the input is one path that is read where it lies: no archive, and no folder of videos alone."""
    path = inputs[0]
    if len(inputs) > 1 or is_video(read_head(path)):
        return len(inputs) == 1
    if path.is_dir():
        names = [name for name in list_files(path, out) if not PurePosixPath(name).name.startswith(".")]
        films = [name for name in names if PurePosixPath(name).suffix.lower() not in (*PREVIEWS, *NOTES)]
        return not films or not all(is_video(read_head(path / name)) for name in films)
    return not (path.is_file() and zipfile.is_zipfile(path))


def find(inputs: Sequence[Path], out: Path, masks: str = "") -> Gathered:
    """List the files of all inputs; an InputError names one that cannot be used. Nothing is written."""
    found, taken = Gathered(), set[str]()
    mask_place = Path(masks).resolve() if masks else None

    def free(name: str) -> str:
        name = name.lstrip(".") or "photos"
        while name.casefold() in taken:
            name = f"_{name}"
        taken.add(name.casefold())
        return name

    for path in inputs:
        if path.resolve() == mask_place:
            raise InputError(f"{path} cannot be both photos and masks", hint="give the masks a folder of their own")
        if path.is_dir():
            folder = free(path.resolve().name)
            for name, reason in list_photos(path, out, None, [mask_place] if mask_place else ()).items():
                source, label = resolve_file(path, name), str(path / name)
                if reason or isinstance(source, str):
                    found.left_out[label] = reason or str(source)
                elif source != mask_place:
                    found.add(f"{folder}/{name}", label, source)
        elif not path.is_file():
            raise InputError(f"not found: {path}", hint=MISSING_HINT)
        elif not is_video(read_head(path)) and zipfile.is_zipfile(path):
            folder = free(path.stem)
            for name, member in _members(path).items():
                found.add(f"{folder}/{name}", f"{path}: {name}", path.resolve(), member)
        else:
            found.add(free(path.name), str(path), path.resolve())
    return found


def fill(target: Path, found: Gathered, spread: ParallelMap) -> None:
    """Fill a folder with the files of all inputs, unless it holds them; an InputError names a damaged archive."""
    record = _record(target)
    places = sorted({str(place) for place, _ in found.files.values()})
    digests = dict(zip(places, spread(lambda place: digest(Path(place)), places), strict=True))
    made_from = fingerprint({name: (digests[str(place)], member) for name, (place, member) in found.files.items()})
    if read_object(record).get("made_from") == made_from and all((target / name).is_file() for name in found.files):
        return
    record.unlink(missing_ok=True)  # a killed run leaves a folder without record
    with replace_folder(target) as draft:
        packed: dict[Path, dict[str, str]] = {}
        for name, (place, member) in found.files.items():
            (draft / name).parent.mkdir(parents=True, exist_ok=True)
            if member:
                packed.setdefault(place, {})[name] = member
            else:
                share_bytes(place, draft / name)
        for place, members in packed.items():
            _unpack(place, members, draft)
    with replace_atomically(record) as path:
        path.write_text(json.dumps({"made_from": made_from}), encoding="utf-8", newline="\n")


def remove(target: Path) -> None:
    """Remove a folder that `fill` made."""
    _record(target).unlink(missing_ok=True)
    shutil.rmtree(target, ignore_errors=True)


def _record(target: Path) -> Path:
    return target.with_name(f"{target.name}.json")


@contextlib.contextmanager
def _refusing(archive: Path) -> Iterator[None]:
    """Turn the errors of damaged and foreign archives into InputErrors."""
    try:
        yield
    except RuntimeError as err:  # a method of compression that Python lacks, or a password
        raise InputError(f"cannot unpack {archive}: {err}", hint=ZIP_HINT) from err
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, FileExistsError, NotADirectoryError) as err:
        reason = "two of its names clash" if isinstance(err, OSError) else err
        raise InputError(f"{archive} is damaged: {reason}", hint=ZIP_HINT) from err


def _members(archive: Path) -> dict[str, str]:
    """Return the members of an archive by their plain names."""
    with _refusing(archive), zipfile.ZipFile(archive) as packed:
        members = [one for one in packed.infolist() if not one.is_dir() and not _is_hidden(one.filename)]
        size = sum(one.file_size for one in members)
        if not members:
            raise InputError(f"{archive} holds no file", hint="name an archive of photos")
        if size > min(MOST_ZIP_BYTES, MOST_RATIO * archive.stat().st_size):
            raise InputError(f"{archive} would unpack to {size:,} bytes: too many", hint=ZIP_HINT)
        for one in members:
            if one.header_offset < 0:
                raise zipfile.BadZipFile("a file begins before the archive")
            if one.flag_bits & 1:
                raise InputError(f"{archive} is encrypted", hint=ZIP_HINT)
            if not is_below(one.filename):
                raise InputError(f"{archive} has a file that leads out of it: {one.filename}", hint=ZIP_HINT)
            if any(len(os.fsencode(part)) > MOST_NAME_BYTES for part in PurePosixPath(one.filename).parts):
                raise InputError(f"{archive} has a file whose name is too long: {one.filename}", hint=ZIP_HINT)
        return {PurePosixPath(one.filename).as_posix(): one.filename for one in members}


def _unpack(archive: Path, members: Mapping[str, str], target: Path) -> None:
    with _refusing(archive), zipfile.ZipFile(archive) as packed:
        for name, member in members.items():
            with packed.open(member) as source, (target / name).open("xb") as copy:  # it ends at the listed size
                shutil.copyfileobj(source, copy)


def _is_hidden(name: str) -> bool:
    return any(part == "__MACOSX" or (part.startswith(".") and part != "..") for part in PurePosixPath(name).parts)
