"""Several inputs as one folder: photos, folders of photos, wildcards and ZIP archives."""

import glob
import shutil
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from sfm_app.errors import ConfigError, InputError
from sfm_app.files import is_below
from sfm_app.operating_system import share_bytes
from sfm_app.photos.files import is_video, list_photos, read_head, resolve_file

MOST_ZIP_BYTES = 100_000_000_000
"""Unpacked size of an archive: thousands of large photos."""
MOST_RATIO = 200
"""Unpacked size by packed size: photos hardly shrink, and bombs shrink a thousandfold."""
ZIP_HINT = "unpack it yourself, and name the folder"


def expand(inputs: Sequence[Path]) -> list[Path]:
    """Return the inputs in order of their names, once each; a wildcard stands for its files."""
    found: set[Path] = set()
    for path in inputs:
        matches = [] if path.exists() else [Path(name) for name in glob.glob(str(path), recursive=True)]  # noqa: PTH207
        found |= set(matches or [path])
    return sorted({path.resolve(): path for path in sorted(found)}.values(), key=lambda path: str(path.resolve()))


def is_single(inputs: Sequence[Path]) -> bool:
    """Return whether the input is one path that is no archive: it is read where it lies."""
    path = inputs[0]
    return len(inputs) == 1 and (not path.is_file() or is_video(read_head(path)) or not zipfile.is_zipfile(path))


def gather(inputs: Sequence[Path], target: Path, out: Path) -> None:
    """Fill a folder with the files of all inputs; an InputError names one that cannot be used."""
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for path in inputs:
        if path.is_dir():
            place = _free(target / (path.resolve().name or "photos"))
            for name, reason in list_photos(path, out).items():
                source = resolve_file(path, name)
                if not reason and isinstance(source, Path):
                    _take(source, place / name)
        elif not path.is_file():
            raise InputError(f"no such file or folder: {path}", hint="name photos, folders or a ZIP archive")
        elif is_video(read_head(path)):
            raise ConfigError(f"{path} is a video among several inputs", hint="run a video alone")
        elif zipfile.is_zipfile(path):
            _unpack(path, _free(target / path.stem))
        else:
            _take(path, _free(target / path.name))


def _free(place: Path) -> Path:
    while place.exists():
        place = place.with_name(f"_{place.name}")
    return place


def _take(source: Path, place: Path) -> None:
    place.parent.mkdir(parents=True, exist_ok=True)
    share_bytes(source.resolve(), place)


def _unpack(archive: Path, target: Path) -> None:
    try:
        with zipfile.ZipFile(archive) as packed:
            members = [one for one in packed.infolist() if not one.is_dir() and not _is_hidden(one.filename)]
            size = sum(one.file_size for one in members)
            if size > min(MOST_ZIP_BYTES, MOST_RATIO * archive.stat().st_size):
                raise InputError(f"{archive} would unpack to {size:,} bytes: too many", hint=ZIP_HINT)
            for one in members:
                if one.header_offset < 0:
                    raise zipfile.BadZipFile("a file begins before the archive")
                if not is_below(one.filename):
                    raise InputError(f"{archive} has a file that leads out of it: {one.filename}", hint=ZIP_HINT)
                place = target / one.filename
                place.parent.mkdir(parents=True, exist_ok=True)
                with packed.open(one) as source, place.open("xb") as copy:  # it ends at the size of the listing
                    shutil.copyfileobj(source, copy)
    except RuntimeError as err:  # a password, or a method of compression that Python lacks
        raise InputError(f"cannot unpack {archive}: {err}", hint=ZIP_HINT) from err
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, FileExistsError, NotADirectoryError) as err:
        raise InputError(f"{archive} is damaged: {err}", hint=ZIP_HINT) from err


def _is_hidden(name: str) -> bool:
    return any(part == "__MACOSX" or (part.startswith(".") and part != "..") for part in PurePosixPath(name).parts)
