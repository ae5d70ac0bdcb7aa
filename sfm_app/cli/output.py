"""Text on stdout and stderr in 80 columns, without colors and control characters; pages in the browser."""

import os
import re
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from textwrap import wrap
from threading import Thread
from types import MappingProxyType
from typing import Any, TextIO

from sfm_app.numerical import json_text

MEGABYTE, KILOBYTE = 1e6, 1e3
WIDTH, WIDEST, NARROWEST = 80, 100, 40
"""Columns of text without a terminal; most and fewest columns on a terminal: long lines are hard to read."""
WIDEST_LABEL = 24
"""Columns; text behind a wider label is wrapped below the label. Chosen by hand."""
LABEL = re.compile(r"(?=.{1,24}(?<=\s\s)\S)\s*\S.*?\s{2,}|\s+|(hint|error):\s")
"""Start of a line: spaces, a label with two spaces behind it, or the kind of a message."""
FILE_LINE = re.compile(r"\s{2}(\d+ files, )?[\d.]+ (bytes|kB|MB)$")
"""End of a line of `file_lines`, which is not wrapped: users copy the path."""
SCREEN_VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
"""Environment variables of a screen, or of an editor that opens pages on the user's own machine."""
BROWSER_WAIT_S = 2.0
"""Longest wait for the browser. Chosen by hand."""
STAGE_TITLES: Mapping[str, str] = MappingProxyType({
    "photos": "reading photos",
    "match_graph": "finding and matching features",
    "view_graph": "fundamental matrices",
    "intrinsics": "camera matrix",
    "scene": "camera poses and points",
    "scale": "real size",
    "depth_maps": "depth maps",
    "mesh": "surface",
    "texture": "texture",
    "files": "files",
})  # fmt: skip
"""By the name of the stage, in order; the same names as `pipeline.NAMES`, which takes a second to import."""


def print_json(value: Any) -> None:
    """Print one JSON document on stdout."""
    _write(json_text(value))


def print_lines(lines: Iterable[str]) -> None:
    """Print lines on stdout without folding; escape unprintable characters."""
    _write("".join(f"{to_printable(line)}\n" for line in lines))


def _write(text: str) -> None:
    """Write to stdout, or to nowhere from the moment that no program reads it any more, as after `| head`."""
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)


def print_text(lines: Iterable[str]) -> None:
    """Print lines on stdout, folded to the width of the terminal."""
    print_lines(fold_lines(map(to_printable, lines), terminal_width(sys.stdout) or WIDTH))


def terminal_width(stream: TextIO) -> int | None:
    """Return the columns to use of the stream's terminal; None if it is no terminal."""
    if not stream.isatty():
        return None
    return max(NARROWEST, min(WIDEST, shutil.get_terminal_size((WIDTH, 24)).columns))


def fold_lines(lines: Iterable[str], width: int = WIDTH) -> list[str]:
    """Return lines of at most `width` columns, continued below the text behind the label; words stay whole."""
    folded: list[str] = []
    for line in lines:
        label = LABEL.match(line)
        depth = len(label[0]) if label is not None and len(label[0]) <= WIDEST_LABEL else 0
        if len(line) <= width or FILE_LINE.search(line):
            folded.append(line)
            continue
        parts = wrap(line[depth:], width - depth, break_long_words=False, break_on_hyphens=False)
        folded += [f"{' ' * depth if number else line[:depth]}{part}" for number, part in enumerate(parts)]
    return folded


def to_printable(text: str) -> str:
    """Return a text with escaped unprintable characters: in a name, they could move the cursor or break the line."""
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
    """Return a number of bytes with its unit."""
    if size < KILOBYTE:
        return f"{size} bytes"
    return f"{size / MEGABYTE:.1f} MB" if size >= MEGABYTE else f"{size / KILOBYTE:.0f} kB"


def table(rows: Mapping[str, str]) -> list[str]:
    """Return lines with names and texts in two aligned columns."""
    width = max(map(len, rows), default=0)
    return [f"{name:{width}}  {text}" for name, text in rows.items()]


def open_browser(address: str) -> None:
    """Open an address in the user's browser, if there is one.

    Without a screen, Python would start a text browser in this terminal. Some browsers block until their window
    closes: a thread calls them.
    """
    if sys.platform.startswith("linux") and not any(map(os.environ.get, SCREEN_VARIABLES)):
        return
    import webbrowser

    def call() -> None:
        with suppress(webbrowser.Error, OSError):
            webbrowser.open(address)

    thread = Thread(target=call, daemon=True)
    thread.start()
    thread.join(BROWSER_WAIT_S)
