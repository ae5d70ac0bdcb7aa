"""Files that appear whole or not at all, and folders that a killed run can go on filling."""

import contextlib
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

UNFINISHED = "unfinished.txt"
"""In a folder while a stage fills it: what it is filled from. It says whether a killed run can go on there."""


@contextlib.contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """Provide a path beside `target` to write to; it takes the target's place when the block ends without an error."""
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = target.with_name(f".{target.stem}.{os.getpid()}{target.suffix}")
    try:
        yield beside
        beside.replace(target)
    finally:
        beside.unlink(missing_ok=True)


def can_go_on(folder: Path, made_from: str) -> bool:
    """Return whether a killed run was filling this folder from the same inputs; if not, what is there is removed.

    Args:
        folder: may be missing.
        made_from: fingerprint of the inputs.
    """
    if is_made_from(folder / UNFINISHED, made_from):
        return True
    shutil.rmtree(folder, ignore_errors=True)
    return False


def is_made_from(marker: Path, made_from: str) -> bool:
    """Return whether a marker holds this fingerprint.

    Args:
        marker: text file; may be missing.
        made_from: fingerprint of the inputs.
    """
    try:
        return marker.read_text(encoding="utf-8") == made_from
    except (OSError, UnicodeDecodeError):
        return False


def mark_unfinished(folder: Path, made_from: str) -> None:
    """Mark a folder as one in which a killed run can go on.

    Args:
        folder: made if it is missing.
        made_from: fingerprint of the inputs.
    """
    with replacing(folder / UNFINISHED) as path:
        path.write_text(made_from, encoding="utf-8")


def mark_finished(folder: Path) -> None:
    """Mark a folder as complete; the next run fills it anew."""
    (folder / UNFINISHED).unlink()


def save_files(files: Mapping[str, bytes], folder: Path) -> tuple[Path, ...]:
    """Write files, each complete or not at all, the first one last: it names the others.

    Args:
        files: contents by file name.
        folder: where they go.
    """
    paths = tuple(folder / name for name in files)
    for path, data in reversed(list(zip(paths, files.values(), strict=True))):
        with replacing(path) as beside:
            beside.write_bytes(data)
    return paths
