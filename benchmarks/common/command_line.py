"""Options and helpers that the command lines of all benchmarks share."""

import argparse
import os
import sys
from collections.abc import Sequence
from typing import Any

from sfm_app.cli.options import parse_assignment
from sfm_app.settings import merge_nested

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def new_parser(subject: str, text: str | None) -> argparse.ArgumentParser:
    """Begin the parser of `python -m benchmarks.SUBJECT`.

    Args:
        subject: name of the package, such as "cameras".
        text: its help, printed verbatim.
    """
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{subject}",
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_pictures(parser: argparse.ArgumentParser, named_by: str) -> None:
    """Add the option that asks for pictures: none without it, all of them, or those that it names."""
    text = f"draw pictures: all, or those of these {named_by}"
    parser.add_argument("--pictures", nargs="*", metavar="NAME", help=text)


def is_wanted(pictures: Sequence[str] | None, name: str) -> bool:
    """Return whether `--pictures` asks for the picture of this name."""
    return pictures is not None and (not pictures or name in pictures)


def overrides(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Read the settings of `--also`, keyed by the text that was typed; a text may hold several, separated by spaces."""
    found = {}
    for text in texts:
        settings: dict[str, Any] = {}
        for assignment in text.split():
            settings = merge_nested(settings, parse_assignment(assignment))
        found[text] = settings
    return found


def ensure_single_thread() -> None:
    """Restart the command with one thread in every library, unless it has one: libraries read the setting once."""
    if any(os.environ.get(name) != "1" for name in _THREADS):
        environment = {**os.environ, **dict.fromkeys(_THREADS, "1")}
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)  # noqa: S606
