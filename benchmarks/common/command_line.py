"""Options and helpers that the command lines of all benchmarks share."""

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.common.results import RESULTS
from sfm_app.cli.options import parse_assignment
from sfm_app.settings import merge_nested

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def import_rival(name: str) -> Any:
    """Return the module of a rival that the extra `bench` installs; end the program where it is missing."""
    try:
        return import_module(name)
    except ImportError:
        raise SystemExit(f"{name} is missing: pip install -e '.[bench]', where it has a wheel") from None


def new_parser(subject: str, text: str | None) -> argparse.ArgumentParser:
    """Begin the parser of `python -m benchmarks.SUBJECT`.

    Args:
        subject: name of the package, such as "cameras".
        text: its help, printed verbatim.
    """
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{subject}", description=text, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def add_rendered(parser: argparse.ArgumentParser, scenes: Sequence[str]) -> None:
    """Add the options of a benchmark that renders videos of scenes, and runs stock beside ours.

    Args:
        parser: where they are added.
        scenes: that can be rendered; all by default.
    """
    parser.add_argument("--cache", type=Path, required=True, help="keeps rendered videos and runs")
    parser.add_argument("--scenes", nargs="+", default=list(scenes), choices=list(scenes))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ours-only", action="store_true", help="leave out stock")
    parser.add_argument("--results", type=Path, default=RESULTS)


def add_seeds(parser: argparse.ArgumentParser, seeds: int, name: str) -> None:
    """Add the options of a benchmark that draws everything anew for each seed.

    Args:
        parser: where they are added.
        seeds: how many by default.
        name: of the result files by default.
    """
    parser.add_argument("--seeds", type=int, default=seeds)
    parser.add_argument("--first-seed", type=int, default=0)
    add_results(parser, name)


def add_results(parser: argparse.ArgumentParser, name: str) -> None:
    """Add the options that say where results go.

    Args:
        parser: where they are added.
        name: of the result files by default.
    """
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--name", default=name, help="name of the result files")


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add the option for settings of the program; `merge_assignments` reads what it gives."""
    parser.add_argument("--set", dest="assignments", nargs="*", default=[], metavar="TABLE.KEY=VALUE")


def merge_assignments(texts: Sequence[str]) -> dict[str, Any]:
    """Return the settings that texts like TABLE.KEY=VALUE name, nested."""
    settings: dict[str, Any] = {}
    for text in texts:
        settings = merge_nested(settings, parse_assignment(text))
    return settings


def add_pictures(parser: argparse.ArgumentParser, named_by: str) -> None:
    """Add the option that asks for pictures: none without it, all of them, or those that it names."""
    text = f"draw pictures: all, or those of these {named_by}"
    parser.add_argument("--pictures", nargs="*", metavar="NAME", help=text)


def is_wanted(pictures: Sequence[str] | None, name: str) -> bool:
    """Return whether `--pictures` asks for the picture of this name."""
    return pictures is not None and (not pictures or name in pictures)


def overrides(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Read the settings of `--also`, keyed by the text that was typed; a text may hold several, separated by spaces."""
    return {text: merge_assignments(text.split()) for text in texts}


def ensure_single_thread() -> None:
    """Restart the command with one thread in every library, unless it has one: libraries read the setting once."""
    if any(os.environ.get(name) != "1" for name in _THREADS):
        environment = {**os.environ, **dict.fromkeys(_THREADS, "1")}
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], environment)  # noqa: S606
