"""Write files atomically, and hash them."""

import contextlib
import hashlib
import json
import secrets
import shutil
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePath
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from sfm_app.operating_system import is_link, move, replace_file

PROGRAM, MANIFEST, LOCK, LOG = "sfm-app", "manifest.json", ".lock", "log.txt"
RUN_FOLDERS = ("photos", "frames", "masks", "sparse", "other_models", "dense", "surface", "texture")
"""Folders that a run makes in its output folder."""
RECORD = "export.json"
"""In the folder of an export: its format, its files, and the photo of each picture."""
UNFINISHED = "unfinished.txt"
"""Marker in a folder that a stage is filling: the fingerprint of the inputs."""


@contextlib.contextmanager
def replace_atomically(target: Path) -> Iterator[Path]:
    """Provide a path beside `target`, which replaces it when the block ends without an error."""
    target.parent.mkdir(parents=True, exist_ok=True)
    draft = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")  # machines share process ids
    try:
        yield draft
        replace_file(draft, target)
    finally:
        draft.unlink(missing_ok=True)


@contextlib.contextmanager
def replace_folder(target: Path) -> Iterator[Path]:
    """Provide an empty folder beside `target`, which replaces it when the block ends without an error."""
    draft, old = (target.with_name(f".{target.name}.{state}") for state in ("unfinished", "old"))
    shutil.rmtree(draft, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)
    draft.mkdir(parents=True)
    try:
        yield draft
        if target.exists():
            move(target, old)
        move(draft, target)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def is_made_by_run(folder: Path) -> bool:
    """Return whether a folder is the output of a run, also of an unfinished one."""
    unfinished = (folder / LOCK).is_file() and (folder / LOG).is_file()
    return unfinished or read_object(folder / MANIFEST).get("program") == PROGRAM


def recorded_files(folder: Path) -> list[str]:
    """Return the files that an export lists in its folder; none where no export has made it."""
    known = read_object(folder / RECORD).get("files")
    return [str(name) for name in known] if isinstance(known, list) else []


def read_object(file: Path) -> dict[str, Any]:
    """Return the object of a JSON file; empty if it is missing, unreadable or very large."""
    try:
        found = json.loads(file.read_text(encoding="utf-8")) if file.stat().st_size < 64_000_000 else {}
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


def resume_or_clear(folder: Path, made_from: str) -> bool:
    """Return whether a killed run was filling this folder from the same inputs (fingerprint); if not, remove it."""
    if is_made_from(folder / UNFINISHED, made_from):
        return True
    shutil.rmtree(folder, ignore_errors=True)
    return False


def is_made_from(marker: Path, made_from: str) -> bool:
    """Return whether a marker file, which may be missing, holds this fingerprint."""
    try:
        return marker.read_text(encoding="utf-8") == made_from
    except (OSError, UnicodeDecodeError):
        return False


def mark_unfinished(folder: Path, made_from: str) -> None:
    """Mark a folder as unfinished with the fingerprint of its inputs, so that a killed run can resume."""
    with replace_atomically(folder / UNFINISHED) as path:
        path.write_text(made_from, encoding="utf-8", newline="\n")


def mark_finished(folder: Path) -> None:
    """Mark a folder as complete; the next run that fills it starts afresh."""
    (folder / UNFINISHED).unlink()


def save_files(files: Mapping[str, bytes], folder: Path) -> tuple[Path, ...]:
    """Write files by name, each atomically, the first one last because it refers to the others."""
    paths = tuple(folder / name for name in files)
    for path, data in reversed(list(zip(paths, files.values(), strict=True))):
        with replace_atomically(path) as draft:
            draft.write_bytes(data)
    return paths


MOST_BYTES, MOST_INFLATED = 1_000_000_000, 200
"""Limits of arrays: bytes, and multiple of the file's size. A file that exceeds both is refused; deflate reaches 1000
times with zeros. By hand."""


def load_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an .npz file, no pickles; OSError or ValueError if it is none or exceeds the limits."""
    # opened here, because NumPy leaves a damaged file open
    with path.open("rb") as file:
        with ZipFile(file) as members:
            inflated = sum(member.file_size for member in members.infolist())
        if inflated > max(MOST_BYTES, MOST_INFLATED * path.stat().st_size):
            raise ValueError(f"{path} is refused: it inflates to {inflated} bytes")
        file.seek(0)
        with np.load(file, allow_pickle=False) as stored:
            return dict(stored)


def read_text(path: Path, most_bytes: int) -> str:
    """Return a text file of the user; errors as in `read_bytes` and `decode_text`."""
    return decode_text(read_bytes(path, most_bytes))


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """Return a file; raise an OSError if it cannot be read, a ValueError if it is larger."""
    with path.open("rb") as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise ValueError(f"it is larger than {most_bytes / 1e6:g} MB")
    return data


def decode_text(data: bytes) -> str:
    """Return a text in UTF-8, or in UTF-16 with a byte order mark, as PowerShell writes; ValueError for others."""
    try:
        return data.decode("utf-16" if data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig")
    except UnicodeDecodeError:
        raise ValueError("it is no text in UTF-8 or UTF-16; save it as UTF-8") from None


def digest_file(path: Path) -> str:
    """Return a hash of the bytes of a file; raise an OSError if it cannot be read."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").hexdigest()


def digest_files(root: Path, *names: str) -> str:
    """Return a hash of the names and bytes of files and all files in folders, except links; raise if one is missing."""
    digest = hashlib.blake2b(digest_size=16)
    for name in names:
        place = root / name
        inside = (file for file in place.rglob("*") if file.is_file() and not is_link(file))
        files = sorted(file for file in inside if not file.name.startswith(".")) if place.is_dir() else [place]
        for path in files:
            digest.update(f"{path.relative_to(root).as_posix()!r} {digest_file(path)}\n".encode())
    return digest.hexdigest()


def fingerprint(*parts: Any) -> str:
    """Return a hash of JSON-able parts, independent of the order of keys."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def is_below(name: str) -> bool:
    """Return whether a joined name stays below its folder, judging by the name alone."""
    path = PurePath(name)  # a drive of Windows is not absolute
    return bool(path.parts) and not path.anchor and ".." not in path.parts and "\0" not in name
