"""Files of a folder that may be photos or videos."""

import os
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from pathlib import Path

from sfm_app.errors import InputError
from sfm_app.operating_system import is_link

# Recognize videos by their first bytes, not by their names; playlists are not videos.

ENDINGS = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".3gp")
"""Extensions of videos; used only to word error messages."""
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
    """Return whether the sync bytes of an MPEG transport stream are in place."""
    return len(head) == HEAD_BYTES and all(head[k] == 0x47 for k in range(first, HEAD_BYTES, length))


# List the files of a folder and resolve their paths. Nothing outside the folder is read.

HINT = "name the folder that holds the photos"
VIDEO_HINT = "MP4, MOV, MKV, WebM, AVI and MPEG are read: copy the file again, or save it as MP4"


def list_files(folder: Path, out: Path, listed_in: Path | None = None, closed: Sequence[Path] = ()) -> list[str]:
    """Return the names of all files below the folder, with forward slashes, sorted.

    Hidden folders and links to folders are not entered; each counts as one file. The output folder is left out.

    Args:
        folder, out: of the photos; output folder, which may lie in it.
        listed_in: text file of the names to return, one per line, relative to the folder; None for all files.
        closed: other folders that are left out, like the output folder.

    Raises:
        InputError: there is no such folder, or it cannot be read.
    """
    if not folder.is_dir():
        raise _bad_path_error(folder)
    try:
        next(folder.iterdir(), None)
    except OSError as err:
        raise InputError(f"cannot read {folder}: {err.strerror}") from err
    if listed_in is not None:
        return _read_list(listed_in)
    left_out = {place.resolve() for place in (out, *closed)}
    return sorted(path.relative_to(folder).as_posix() for path in _walk(folder, left_out))


def _bad_path_error(path: Path) -> InputError:
    """Return the error for a path that is neither a folder nor a video."""
    if not path.exists():
        what = "file" if path.suffix.lower() in ENDINGS else "folder"
        beside = path.parent.iterdir() if os.access(path.parent, os.R_OK) and path.parent.is_dir() else ()
        near = get_close_matches(path.name, sorted(other.name for other in beside), 1)
        meant = f"\nis it {path.with_name(near[0])}?" if near else ""
        return InputError(f"no such {what}: {path}", hint=f"{HINT}, or a video{meant}")
    if path.suffix.lower() not in ENDINGS or not path.is_file():
        return InputError(f"not a folder: {path}", hint=f"{HINT}, or a video, not a photo")
    if not os.access(path, os.R_OK):
        return InputError(f"cannot read {path}: permission denied")
    return InputError(f"{path} is empty" if not path.stat().st_size else f"not a video: {path}", hint=VIDEO_HINT)


def resolve_file(folder: Path, name: str) -> Path | str:
    """Return the path of a file with links resolved, or the reason why it is not opened.

    Args:
        folder, name: of the photos (nothing outside it is opened); path inside the folder.
    """
    root, place = folder.resolve(), folder / name
    if Path(name).name.startswith("."):
        return "hidden"
    try:
        real = place.resolve()
        there = real.exists()
    except RuntimeError:  # links in a ring
        return "a link that leads nowhere"
    except (OSError, ValueError) as err:  # lists may hold invalid names; folders may be inaccessible
        return f"not readable: {getattr(err, 'strerror', 'no name').lower()}"
    if not real.is_relative_to(root):
        return "a link out of the folder" if is_link(place) else "outside the folder"
    if not there:
        return "a link that leads nowhere" if is_link(place) else "not there"
    if real.is_dir():
        return "a link to a folder" if is_link(place) else "a folder"
    return real if real.is_file() else "not a file"  # reading a pipe would never end


def _read_list(file: Path) -> list[str]:
    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, ValueError) as err:
        reason = err.strerror if isinstance(err, OSError) else "not a UTF-8 text"
        raise InputError(f"cannot read {file}: {reason}", hint="one photo per line, as seen from the folder") from err
    return sorted({Path(line).as_posix() for line in lines if line.strip()})


def _walk(folder: Path, left_out: set[Path]) -> Iterator[Path]:
    for place, folders, files in os.walk(folder):
        here = Path(place)
        closed = [name for name in folders if name.startswith(".") or is_link(here / name)]
        folders[:] = [name for name in folders if name not in closed and (here / name).resolve() not in left_out]
        yield from (here / name for name in (*files, *closed))
