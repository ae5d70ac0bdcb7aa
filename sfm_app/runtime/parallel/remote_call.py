"""What a worker of the cluster does: checks that it fits, applies a task to some items, and reports."""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sfm_app.errors import BackendError
from sfm_app.operating_system import cpu_seconds
from sfm_app.runtime.parallel.parcels import Packer, Parcel, survives_travel, unpack
from sfm_app.runtime.parallel.worker_versions import differences, worker_versions

OF_THE_MACHINE = (OSError, MemoryError, BackendError)
"""Errors that a machine may be to blame for: a full disk, little memory, a folder that is not mounted."""
_FITS: set["Probe"] = set()
"""Probes that this process has passed."""


@dataclass(frozen=True, slots=True)
class Probe:
    """What a worker has to have: the same versions, and the same folder."""

    versions: tuple[tuple[str, str], ...]
    folder: str
    """Folder of parcels, in the output folder."""
    name: str
    """File in it that the coordinator has written."""


@dataclass(frozen=True, slots=True)
class Call:
    """A task and some of its items, on the way to a worker."""

    probe: Probe
    function: Parcel
    items: Parcel


@dataclass(frozen=True, slots=True)
class Reply:
    """What a worker has to say of a call."""

    results: Parcel | None = None
    """List of the results of the first items, up to one that failed."""
    error: Exception | None = None
    """Of the first item that failed."""
    is_of_machine: bool = False
    """Whether the error may be the machine's."""
    unfit: str = ""
    """Why the worker cannot be used; it has not begun."""
    worker: str = ""
    """Its address, where it cannot be used."""
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """Of the worker, and of processes that it has waited for."""


def answer(call: Call) -> Reply:
    """Apply a task to its items; errors of the task are part of the reply."""
    if reason := find_misfit(call.probe):
        from distributed import get_worker

        return Reply(unfit=reason, worker=str(get_worker().address))
    start, spent = time.perf_counter(), cpu_seconds()
    _use_one_thread()
    results: list[Any] = []
    error: Exception | None = None
    is_of_machine = False
    try:
        function = unpack(call.function)
        for item in unpack(call.items):
            results.append(function(item))  # noqa: PERF401 - what was done before an error is kept
    except Exception as err:  # of whatever kind: the coordinator raises it
        error = picklable(err)
        is_of_machine = isinstance(err, OF_THE_MACHINE)
    packed = Packer(Path(call.probe.folder)).pack(results)
    took, used = time.perf_counter() - start, cpu_seconds() - spent
    return Reply(packed, error, is_of_machine=is_of_machine, seconds=took, cpu_seconds=used)


def find_misfit(probe: Probe) -> str:
    """Return why this process cannot be a worker of a run; empty where it can."""
    if probe in _FITS:
        return ""
    if wrong := differences(dict(probe.versions), worker_versions()):
        return "it has " + ", ".join(wrong)
    place = Path(probe.folder)
    try:
        if (place / probe.name).read_text(encoding="utf-8") != probe.name:
            return f"it has another {place.parent}"
        mark = place / f".{os.getpid()}-{time.monotonic_ns()}"
        mark.touch()
        mark.unlink()
    except OSError as err:
        return f"{place.parent} cannot be used there: {err.strerror or err}"
    _FITS.add(probe)
    return ""


def picklable(err: Exception) -> Exception:
    """Return an error as it can travel: itself, or its text where it cannot be pickled."""
    return err if survives_travel(err) else RuntimeError(f"{type(err).__name__}: {err}")


def _use_one_thread() -> None:
    """Let OpenCV use one thread, since a machine has a worker for each core."""
    import cv2

    if cv2.getNumThreads() != 1:
        cv2.setNumThreads(1)
