"""Separate processes for COLMAP calls that cannot be stopped, or that may crash.

COLMAP aborts if it cannot write its database, and a decoder may crash on a photo. In a separate process, both are
ordinary errors. The process ends with its parent, however that ends, so that nothing goes on writing.
"""

import contextlib
import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from typing import IO, Any, Literal, TypeAlias, TypedDict, TypeVar

from sfm_app.colmap.backend import log_level, show_log
from sfm_app.errors import BackendError
from sfm_app.numerical import Json
from sfm_app.operating_system import crash_name, end_at_exit, has_run_out, ignore_interrupts, watch_parent
from sfm_app.progress import Progress, SilentProgress

TASKS = "sfm_app.colmap.tasks"
REPORT_FD = 3
"""File descriptor for messages of a worker process to its parent."""

SiftOption: TypeAlias = bool | int | float
"""Value of an option of COLMAP's SIFT."""
Task = TypeVar("Task", bound=Mapping[str, object])
"""One of the tasks below; its values are valid JSON."""


class FeatureTask(TypedDict):
    """Arguments of `features.find_and_match`."""

    do: Literal["find_and_match"]
    database: str
    photos: str
    masks: str | None
    names: list[str]
    options: dict[str, Any]
    """Dump of `MatchSettings`."""
    workers: int
    sift: dict[str, SiftOption]
    pairs: list[list[int]] | None


class MatchTask(TypedDict):
    """Arguments of `features.match_chunk`."""

    do: Literal["match_chunk"]
    snapshot: str
    features: str
    photos: str
    options: dict[str, Any]
    sift: dict[str, SiftOption]
    folder: str
    pairs: list[list[int]]


class MappingTask(TypedDict):
    """Arguments of a mapper."""

    scratch: str
    photos: str
    seed: int


class GlobalMappingTask(MappingTask):
    """Arguments of `mapping.map_globally`."""

    do: Literal["map_globally"]
    names: list[str]


class DefaultMappingTask(MappingTask):
    """Arguments of `mapping.map_with_colmap_defaults`."""

    do: Literal["map_with_defaults"]


class UndistortTask(TypedDict):
    """Arguments of `dense.undistort`."""

    do: Literal["undistort"]
    dense: str
    model: str
    photos: str
    max_side_px: int
    workers: int
    output: Literal["COLMAP", "PMVS"]
    """COLMAP's name of the layout of the workspace."""


class FuseTask(TypedDict):
    """Arguments of `surface.fuse`."""

    do: Literal["fuse"]
    dense: str
    target: str
    min_views: int
    box: list[list[float]]
    cache_gb: float


class PoissonTask(TypedDict):
    """Arguments of `surface.poisson_surface`."""

    do: Literal["poisson"]
    points: str
    target: str
    depth: int


class SimplifyTask(TypedDict):
    """Arguments of `surface.simplify`."""

    do: Literal["simplify"]
    mesh: str
    target: str
    most: int
    max_error: float
    threads: int


class WorkerProcess:
    """A running worker process."""

    def __init__(self, process: "subprocess.Popen[str]", output: IO[bytes]) -> None:
        self.process, self._output = process, output

    def messages(self) -> Iterator[dict[str, Json]]:
        """Yield the messages of the process, until it ends."""
        for line in self.process.stdout or ():
            if line.endswith("\n"):  # else the process was killed while writing it
                yield json.loads(line)

    def has_ended(self, wait_s: float) -> bool:
        """Return whether the process ends within `wait_s` seconds."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(wait_s)
        return self.process.poll() is not None

    def check(self, doing: str) -> None:
        """Wait for the process to end, and check that it succeeded.

        Raises:
            BackendError: the process failed, or it was killed.
        """
        code = self.process.wait()
        if not code:
            return
        if has_run_out(code):
            raise BackendError(
                f"the system killed COLMAP while {doing}, perhaps because memory ran out",
                hint="run again with --workers 1, or with --quality draft",
            )
        self._output.seek(0)
        lines = self._output.read().decode(errors="replace").split("\n")
        last = next((line.strip() for line in reversed(lines) if line.strip()), f"it ended with {code}")
        crash = crash_name(code)  # after a crash, the last line of the output is a stack address
        reason = f"it crashed ({crash})" if crash else last
        raise BackendError(f"COLMAP failed while {doing}: {reason}", hint="run again with -v to see what COLMAP says")


@contextlib.contextmanager
def start_worker(module: str, task: Mapping[str, object]) -> Iterator[WorkerProcess]:
    """Start a process that runs a module, which calls `serve`, on a task; kill it at the end of the block."""
    command = [sys.executable, "-P", "-m", module]  # -P: nothing is imported from the current folder
    level = log_level()
    # the output goes to a file: nothing reads a pipe while the process runs, and a full pipe would block it forever
    with (
        tempfile.TemporaryFile() as output,
        subprocess.Popen(  # noqa: S603 - our module
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=None if level else output, encoding="utf-8"
        ) as process,
    ):
        try:
            with contextlib.suppress(OSError):  # the process has failed already; `check` reports why
                print(json.dumps({"log_level": level, "parent": os.getpid(), **task}), file=process.stdin, flush=True)
            yield WorkerProcess(process, output)
        finally:
            if process.poll() is None:
                process.kill()


class ProcessGroup:
    """Worker processes of several threads, which end together."""

    def __init__(self) -> None:
        self._running, self._lock, self._has_ended = set[WorkerProcess](), threading.Lock(), False

    def run(self, task: Mapping[str, object], doing: str, progress: Progress) -> dict[str, Json]:
        """Run a task to its end or that of the group, as `run_worker` does."""
        with start_worker(TASKS, task) as process:
            with self._lock:
                self._running.add(process)
                if self._has_ended:
                    process.process.kill()
            try:
                results = relay(process, progress)
                process.check(doing)
            finally:
                with self._lock:
                    self._running.discard(process)
        return results

    def stop(self) -> None:
        """Stop all processes, and those that start later."""
        with self._lock:
            self._has_ended = True
            for process in self._running:
                process.process.kill()


def run_worker(task: Mapping[str, object], doing: str, progress: Progress | None = None) -> dict[str, Json]:
    """Run one of COLMAP's tasks in a process, and return its results; error messages say what it was `doing`."""
    with start_worker(TASKS, task) as process:
        results = relay(process, progress or SilentProgress())
        process.check(doing)
    return results


def serve(work: Callable[[Task], None]) -> None:
    """Do the task in the worker process, and end when its parent does."""
    ignore_interrupts()
    end_at_exit()
    os.dup2(sys.stdout.fileno(), REPORT_FD)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # output of libraries must not mix with the reports
    logging.captureWarnings(capture=True)  # -v shows what this process prints
    line = sys.stdin.readline()
    if not line:
        return
    task = json.loads(line)
    show_log(task["log_level"])
    watch_parent(task["parent"], lambda: os._exit(1))
    work(task)


def report(**message: Json) -> None:
    """Send a message from the worker process to its parent."""
    os.write(REPORT_FD, f"{json.dumps(message)}\n".encode())


class ProgressReporter(SilentProgress):
    """Sends progress to the parent process; only the parent has stages."""

    def start(self, label: str, total: int) -> None:
        """Send the start of work to the parent."""
        report(start=label, total=total)

    def advance(self, steps: int = 1) -> None:
        """Send a number of finished steps to the parent."""
        report(advance=steps)

    def finish(self) -> None:
        """Send the end of the work to the parent."""
        report(finish=True)


def relay(process: WorkerProcess, progress: Progress) -> dict[str, Json]:
    """Show the progress of a process until it ends, and return its other messages as one dictionary."""
    results: dict[str, Json] = {}
    try:
        for message in process.messages():
            match message:
                case {"start": str(label), "total": int(total)}:
                    progress.start(label, total)
                case {"advance": int(steps)}:
                    progress.advance(steps)
                case {"finish": True}:
                    progress.finish()
                case _:
                    results |= message
    finally:
        progress.finish()
    return results
