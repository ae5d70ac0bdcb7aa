"""Run the program and kill it, as by `kill -9`, at a chosen moment: killed.py POINT ARGUMENTS.

POINT is "before:N" or "after:N" for the Nth file that appears (every file of a run appears by a rename), "COLMAP:MS"
for so many milliseconds after the call of that name, or "count", which ends well and says how many files appeared.
"""

import itertools
import os
import signal
import sys
import threading
from pathlib import Path

from sfm_app.cli import main
from sfm_app.colmap.backend import pycolmap

APPEARED = itertools.count(1)


def die() -> None:
    """Nobody is asked."""
    os.kill(os.getpid(), signal.SIGKILL)


def at_rename(when: str, number: int) -> None:
    """Die at the Nth rename."""
    rename = Path.replace

    def replace(self: Path, target: Path) -> Path:
        here = next(APPEARED) == number
        if here and when == "before":
            die()
        result = rename(self, target)
        if here:
            die()
        return result

    Path.replace = replace  # type: ignore[method-assign]


def in_colmap(name: str, milliseconds: float) -> None:
    """Die so long after a function of COLMAP was called."""
    function = getattr(pycolmap, name)

    def call(*arguments: object, **options: object) -> object:
        threading.Timer(milliseconds / 1000, die).start()
        return function(*arguments, **options)

    setattr(pycolmap, name, call)


if __name__ == "__main__":
    point, amount = (*sys.argv[1].split(":"), "0")[:2]
    if point in ("before", "after", "count"):
        at_rename(point, int(amount))
    else:
        in_colmap(point, float(amount))
    try:
        main(sys.argv[2:], standalone_mode=False)
    finally:
        sys.stdout.write(f"{next(APPEARED) - 1}\n")
