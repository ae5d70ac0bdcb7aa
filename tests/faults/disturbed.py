"""Run the program and disturb it at a chosen moment: disturbed.py WHAT MOMENT ARGUMENTS.

WHAT is "kill" (as by `kill -9`), "interrupt" (as by Ctrl-C), "out-gone", "out-closed" (nothing can be written there),
"photo-gone" or "photo-changed". MOMENT is "before:N" or "after:N" for the Nth file that appears (every file of a run
appears by a rename), "features:MS", "matching:MS" or "undistorting:MS" for so many milliseconds after COLMAP has begun
with that in a process of its own, "full:KB" for a disk that takes no file of more than so many kilobytes, or "never",
which says how many files appeared.
"""

import itertools
import os
import resource
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sfm_app.cli.program import main
from sfm_app.colmap import worker_process

APPEARED = itertools.count(1)


def close(out: Path) -> None:
    """Let nobody write to a folder."""
    for path in (out, *(below for below in out.rglob("*") if not below.is_symlink())):
        path.chmod(0o500 if path.is_dir() else 0o400)


def at_rename(when: str, number: int, disturb: Callable[[], None]) -> None:
    """Disturb at the Nth rename."""
    rename = Path.replace

    def replace(self: Path, target: Path) -> Path:
        here = next(APPEARED) == number
        if here and when == "before":
            disturb()
        result = rename(self, target)
        if here and when == "after":
            disturb()
        return result

    Path.replace = replace  # type: ignore[method-assign]


def in_process(label: str, milliseconds: float, disturb: Callable[[], None]) -> None:
    """Disturb so long after a process of COLMAP's has begun with a part of its work."""
    messages = worker_process.WorkerProcess.messages

    def heard(process: worker_process.WorkerProcess) -> Iterator[dict[str, Any]]:
        for message in messages(process):
            if message.get("start") == label:
                threading.Timer(milliseconds / 1000, disturb).start()
            yield message

    worker_process.WorkerProcess.messages = heard  # type: ignore[method-assign]


def prepare(what: str, moment: str, arguments: list[str]) -> None:
    """Have it happen."""
    photo, out = sorted(Path(arguments[1]).iterdir())[2], Path(arguments[arguments.index("-o") + 1])
    disturb = {
        "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
        "interrupt": lambda: os.kill(os.getpid(), signal.SIGINT),
        "out-gone": lambda: shutil.rmtree(out, ignore_errors=True),
        "out-closed": lambda: close(out),
        "photo-gone": photo.unlink,
        "photo-changed": lambda: os.truncate(photo, photo.stat().st_size // 2),
    }[what]
    when, _, amount = moment.partition(":")
    if when == "full":
        resource.setrlimit(resource.RLIMIT_FSIZE, (int(amount) * 1000, int(amount) * 1000))
    elif when in ("features", "matching", "undistorting"):
        in_process(when, float(amount), disturb)
    else:
        at_rename(when, int(amount or 0), disturb)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells let what they start with & ignore it
    prepare(sys.argv[1], sys.argv[2], sys.argv[3:])
    try:
        main(sys.argv[3:], standalone_mode=False)
    finally:
        sys.stdout.write(f"{next(APPEARED) - 1}\n")
