"""Text on stdout and stderr: in 80 columns, without colors, and nothing that could move the cursor."""

import re
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any, TextIO

from sfm_app.numerical import json_text

MEGABYTE, KILOBYTE = 1e6, 1e3
WIDTH, WIDEST, NARROWEST = 80, 100, 40
"""Columns of text where there is no terminal, and the most and the fewest that are used of one: long lines are hard to
read."""
DEEPEST = 24
"""Column up to which a label is one: what is wrapped goes on below the text beside it. Chosen by hand."""
LABEL = re.compile(r"(?=.{1,24}(?<=\s\s)\S)\s*\S.*?\s{2,}|\s+|(hint|error):\s")
"""What stands before a text: spaces, a label with two spaces behind it, or the kind of a message."""
FILE_LINE = re.compile(r"\s{2}(\d+ files, )?[\d.]+ (bytes|kB|MB)$")
"""The end of a line of `file_lines`: a path is copied, so it stays in one piece."""


def print_json(value: Any) -> None:
    """Print one JSON document on stdout."""
    sys.stdout.write(json_text(value))


def print_lines(lines: Iterable[str]) -> None:
    """Print lines on stdout as they are, but for characters that cannot be printed."""
    sys.stdout.write("".join(f"{to_printable(line)}\n" for line in lines))


def print_text(lines: Iterable[str]) -> None:
    """Print lines on stdout, those that are too long on several lines."""
    print_lines(fold_lines(map(to_printable, lines), columns(sys.stdout) or WIDTH))


def columns(stream: TextIO) -> int | None:
    """Return how many columns are used of the terminal that a stream ends in; None where it ends in no terminal."""
    if not stream.isatty():
        return None
    return max(NARROWEST, min(WIDEST, shutil.get_terminal_size((WIDTH, 24)).columns))


def fold_lines(lines: Iterable[str], width: int = WIDTH) -> list[str]:
    """Return lines of at most so many columns: long ones go on below their text, behind their label.

    Words longer than that, such as paths, stay in one piece, and so do lines of `file_lines`.

    Args:
        lines: of text, some with a label and two spaces or more behind it.
        width: most columns.
    """
    found: list[str] = []
    for line in lines:
        label = LABEL.match(line)
        depth = len(label[0]) if label is not None and len(label[0]) <= DEEPEST else 0
        if len(line) <= width or FILE_LINE.search(line):
            found.append(line)
            continue
        parts = wrap(line[depth:], width - depth, break_long_words=False, break_on_hyphens=False)
        found += [f"{'' if number else line[:depth]}{'' if not number else ' ' * depth}{part}"
                  for number, part in enumerate(parts)]  # fmt: skip
    return found


def to_printable(text: str) -> str:
    """Return a text with unprintable characters escaped: a file's name could move the cursor or break the line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def file_lines(paths: Sequence[Path]) -> list[str]:
    """Return one line per file or folder, with its size."""
    return [f"{path}  {_size_on_disk(path)}" for path in paths]


def _size_on_disk(path: Path) -> str:
    if not path.is_dir():
        return size_text(path.stat().st_size)
    sizes = [file.stat().st_size for file in path.rglob("*") if file.is_file()]
    return f"{len(sizes)} files, {size_text(sum(sizes))}"


def size_text(size: int) -> str:
    """Return a number of bytes with a suitable unit."""
    if size < KILOBYTE:
        return f"{size} bytes"
    return f"{size / MEGABYTE:.1f} MB" if size >= MEGABYTE else f"{size / KILOBYTE:.0f} kB"


def table(rows: Mapping[str, str]) -> list[str]:
    """Return lines with names and texts in two aligned columns."""
    width = max(map(len, rows), default=0)
    return [f"{name:{width}}  {text}" for name, text in rows.items()]
