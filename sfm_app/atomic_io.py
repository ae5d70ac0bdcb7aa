"""Atomic writes of files, and markers of folders that the run after a killed one can go on filling."""

import contextlib
import secrets
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path

from sfm_app.operating_system import replace_file

UNFINISHED = "unfinished.txt"
"""Marker in a folder that a stage is filling: the fingerprint of the inputs, by which a killed run can resume."""


@contextlib.contextmanager
def replace_atomically(target: Path) -> Iterator[Path]:
    """Provide a path beside `target`, which replaces it when the block ends without an error."""
    target.parent.mkdir(parents=True, exist_ok=True)
    beside = target.with_name(f".{target.stem}.{secrets.token_hex(4)}{target.suffix}")  # machines share process ids
    try:
        yield beside
        replace_file(beside, target)
    finally:
        beside.unlink(missing_ok=True)


def resume_or_clear(folder: Path, made_from: str) -> bool:
    """Return whether a killed run was filling this folder from the same inputs; remove the folder if not.

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
    """Mark a folder as unfinished, so that a killed run can resume there.

    Args:
        folder: created if it is missing.
        made_from: fingerprint of the inputs.
    """
    with replace_atomically(folder / UNFINISHED) as path:
        path.write_text(made_from, encoding="utf-8", newline="\n")


def mark_finished(folder: Path) -> None:
    """Mark a folder as complete; the next run that fills it starts afresh."""
    (folder / UNFINISHED).unlink()


def save_files(files: Mapping[str, bytes], folder: Path) -> tuple[Path, ...]:
    """Write files, each atomically, the first one last because it refers to the others.

    Args:
        files: contents by file name.
        folder: where they go.
    """
    paths = tuple(folder / name for name in files)
    for path, data in reversed(list(zip(paths, files.values(), strict=True))):
        with replace_atomically(path) as beside:
            beside.write_bytes(data)
    return paths
