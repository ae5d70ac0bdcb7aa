"""Cores, memory and time of this machine."""

import contextlib
import math
import os
import re
from collections.abc import Iterable
from pathlib import Path

import psutil

from sfm_app.operating_system.abilities import Ability, lacks

MEGA = 1e6
CONTAINER_LIMIT = Path("/sys/fs/cgroup/memory.max")
"""Bytes that the container may use, or a word where it has no limit."""


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if lacks(Ability.CORES):
        return os.cpu_count() or 1
    return len(os.sched_getaffinity(0))


def machine_memory_mb() -> float:
    """Return the memory of this machine or container in MB."""
    return min(float(psutil.virtual_memory().total) / MEGA, _container_limit_mb())


def free_memory_mb() -> float:
    """Return the memory in MB that programs may still ask for."""
    return min(float(psutil.virtual_memory().available) / MEGA, _container_limit_mb())


def _container_limit_mb() -> float:
    """Return the memory in MB that a container may use; infinite where nothing says so."""
    if not lacks(Ability.CONTAINERS):
        with contextlib.suppress(OSError):
            said = re.match(r"\d+", CONTAINER_LIMIT.read_text(encoding="ascii"))
            return int(said[0]) / MEGA if said else math.inf
    return math.inf


class ChildTimes:
    """CPU seconds of the processes that this one has started, where the system does not add them up.

    What a process uses after the last look is not counted.
    """

    def __init__(self) -> None:
        self._seconds = dict[tuple[int, float], float]()

    def look(self, processes: Iterable[psutil.Process]) -> None:
        """Note what these processes have used so far; nothing where the system adds it up.

        Args:
            processes: children of this one, and theirs.
        """
        for process in processes if lacks(Ability.CHILD_TIMES) else ():
            with contextlib.suppress(psutil.Error):  # it has ended meanwhile
                times = process.cpu_times()
                self._seconds[process.pid, process.create_time()] = times.user + times.system

    def seconds(self) -> float:
        """Return what they have used."""
        return sum(self._seconds.values())


def cpu_seconds() -> float:
    """Return the CPU seconds of this process so far, and where the system says so of those that it has waited for."""
    return sum(os.times()[: 2 if lacks(Ability.CHILD_TIMES) else 4])


def yield_to_others(niceness: int) -> None:
    """Leave the cores to other processes while these need them.

    Args:
        niceness: how much is added to that of this process; Windows knows only one lower priority.
    """
    if hasattr(os, "nice"):
        os.nice(niceness)
    else:
        psutil.Process().nice(psutil.BELOW_NORMAL_PRIORITY_CLASS)
