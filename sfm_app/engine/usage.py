"""Seconds, CPU seconds and memory of a stage, with the processes that it starts."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import psutil

from sfm_app.operating_system import ChildTimes, cpu_seconds

EVERY_S = 0.5
"""Time between two looks at the memory, in seconds. Chosen by hand: a look takes some milliseconds."""
MEGA = 1e6


@dataclass(slots=True)
class Usage:
    """What a piece of work has used; complete once it has ended."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """Of this process, of those that it has waited for, and of the workers of a cluster."""
    peak_mb: int = 0
    """Most resident memory at any look; pages that processes share count for each of them."""


@contextmanager
def measure_usage(elsewhere: Callable[[], float] = float) -> Iterator[Usage]:
    """Measure the work within the block.

    Args:
        elsewhere: returns the CPU seconds so far of processes that work for this one without being waited for.
    """
    used, ended, children = Usage(), threading.Event(), ChildTimes()
    start, cpu_start = time.perf_counter(), cpu_seconds() + elsewhere()
    watcher = threading.Thread(target=_watch_memory, args=(used, children, ended), name="memory", daemon=True)
    watcher.start()
    try:
        yield used
    finally:
        ended.set()
        watcher.join()
        used.peak_mb = max(used.peak_mb, _resident_mb(children))
        used.seconds = time.perf_counter() - start
        used.cpu_seconds = cpu_seconds() + children.seconds() + elsewhere() - cpu_start


def _watch_memory(used: Usage, children: ChildTimes, ended: threading.Event) -> None:
    while True:
        used.peak_mb = max(used.peak_mb, _resident_mb(children))
        if ended.wait(EVERY_S):
            return


def _resident_mb(times: ChildTimes) -> int:
    """Return the memory of this process and of its children in MB, and note the time of the latter."""
    me = psutil.Process()
    command, total, children = me.cmdline(), int(me.memory_info().rss), me.children(recursive=True)
    times.look(children)
    for process in children:
        try:
            # until a child runs a program of its own, its memory is ours
            if process.cmdline() not in ([], command):
                total += process.memory_info().rss
        except psutil.Error:  # it has ended meanwhile
            continue
    return round(total / MEGA)
