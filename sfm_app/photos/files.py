"""Files of a folder that may be photos or videos."""

import os
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path

from sfm_app.errors import InputError
from sfm_app.files import read_text
from sfm_app.operating_system import is_link

EXTENSIONS = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".3gp")
"""Of videos, for error messages only: videos are recognized by their first bytes, and playlists are none."""
HEAD_BYTES = 400
"""Enough for three packets of an MPEG transport stream."""
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1")
AVIF_BRANDS = (b"avif", b"avis")
OTHER_BRANDS = (*HEIC_BRANDS, *AVIF_BRANDS, b"crx ", b"M4A ", b"M4B ", b"M4P ")
"""Photos and sound in the container of MP4."""
ATOMS = (b"moov", b"mdat", b"wide", b"free", b"skip")
"""First atoms of QuickTime files without a brand."""


def read_head(path: Path) -> bytes:
    """Return the first bytes of a regular file; empty if it cannot be read."""
    try:
        if not path.is_file():  # reading a pipe would never end
            return b""
        with path.open("rb") as file:
            return file.read(HEAD_BYTES)
    except OSError:
        return b""


def is_video(head: bytes) -> bool:
    """Return whether a file begins like MP4, QuickTime, Matroska, WebM, AVI or MPEG."""
    if head[4:8] == b"ftyp":
        return head[8:12] not in OTHER_BRANDS
    return (
        head[4:8] in ATOMS
        or head[:4] == b"\x1a\x45\xdf\xa3"
        or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")
        or head[:4] == b"\0\0\x01\xba"
        or _has_packets(head, first=0, length=188)
        or _has_packets(head, first=4, length=192)
    )


def _has_packets(head: bytes, first: int, length: int) -> bool:
    return len(head) == HEAD_BYTES and all(head[k] == 0x47 for k in range(first, HEAD_BYTES, length))


MOST_LIST_BYTES = 100_000_000
"""Largest list of photos: a million names."""
HINT = "name the folder that holds the photos"


def list_files(folder: Path, out: Path, listed_in: Path | None = None, closed: Sequence[Path] = ()) -> list[str]:
    """Return the names of all files below the folder, with forward slashes, sorted.

    Hidden folders and links to folders are not entered; each counts as one file. The output folder `out` and the
    folders `closed` are left out.

    `listed_in` is a text file with the names to return instead, one per line, relative to the folder. An InputError
    says that the folder does not exist or cannot be read.
    """
    if not folder.is_dir():
        raise _bad_path_error(folder)
    try:
        next(folder.iterdir(), None)
    except OSError as err:
        raise InputError(f"cannot read {folder}: {err.strerror}") from err
    if listed_in is not None:
        return _read_list(listed_in)
    excluded = {place.resolve() for place in (out, *closed)}
    return sorted(path.relative_to(folder).as_posix() for path in _walk(folder, excluded))


def _bad_path_error(path: Path) -> InputError:
    if not path.exists():
        kind = "file" if path.suffix.lower() in EXTENSIONS else "folder"
        siblings = path.parent.iterdir() if os.access(path.parent, os.R_OK) and path.parent.is_dir() else ()
        similar = get_close_matches(path.name, sorted(other.name for other in siblings), 1)
        suggestion = f"\nis it {path.with_name(similar[0])}?" if similar else ""
        return InputError(f"no such {kind}: {path}", hint=f"{HINT}, or a video{suggestion}")
    if path.suffix.lower() not in EXTENSIONS or not path.is_file():
        return InputError(f"not a folder: {path}", hint=f"{HINT}, or a video, not a photo")
    if not os.access(path, os.R_OK):
        return InputError(f"cannot read {path}: permission denied")
    hint = "MP4, MOV, MKV, WebM, AVI and MPEG are read: copy the file again, or save it as MP4"
    return InputError(f"{path} is empty" if not path.stat().st_size else f"not a video: {path}", hint=hint)


def resolve_file(folder: Path, name: str) -> Path | str:
    """Return the path of a file in a folder with links resolved, or the reason why it is not opened."""
    root, place = folder.resolve(), folder / name
    if Path(name).name.startswith("."):
        return "hidden"
    try:
        real = place.resolve()
        exists = real.exists()
    except RuntimeError:  # a cycle of links
        return "a broken link"
    except (OSError, ValueError) as err:  # lists may hold invalid names; folders may be inaccessible
        return f"not readable: {getattr(err, 'strerror', 'no name').lower()}"
    if not real.is_relative_to(root):
        return "a link out of the folder" if is_link(place) else "outside the folder"
    if not exists:
        return "a broken link" if is_link(place) else "missing"
    if real.is_dir():
        return "a link to a folder" if is_link(place) else "a folder"
    return real if real.is_file() else "not a file"  # reading a pipe would never end


def _read_list(file: Path) -> list[str]:
    try:
        lines = read_text(file, MOST_LIST_BYTES).splitlines()
    except (OSError, ValueError) as err:
        reason = err.strerror if isinstance(err, OSError) else str(err)
        raise InputError(f"cannot read {file}: {reason}", hint="one photo per line, as seen from the folder") from err
    return sorted({Path(line).as_posix() for line in lines if line.strip()})


def _walk(folder: Path, excluded: set[Path]) -> Iterator[Path]:
    for place, folders, files in os.walk(folder):
        here = Path(place)
        closed = [name for name in folders if name.startswith(".") or is_link(here / name)]
        folders[:] = [name for name in folders if name not in closed and (here / name).resolve() not in excluded]
        yield from (here / name for name in (*files, *closed))
