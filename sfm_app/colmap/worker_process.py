"""Separate processes for COLMAP calls that cannot be stopped, or that may crash.

COLMAP aborts if it cannot write its database, and a decoder may crash on a photo. In a separate process, both are
ordinary errors. The process ends with its parent, however that ends, so that nothing goes on writing.
"""

import contextlib
import json
import logging
import os
import pickle
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from typing import IO, TypeAlias, TypeVar, cast

from sfm_app.colmap.backend import log_level, show_log
from sfm_app.errors import BackendError
from sfm_app.numerical import Json
from sfm_app.operating_system import crash_name, end_at_exit, has_run_out, ignore_interrupts, watch_parent
from sfm_app.progress import Progress

REPORT_FD = 3
"""File descriptor for messages of a worker process to its parent: lines of JSON."""
RESULT = "result"
"""Message with the pickled result of the call, in hexadecimal digits."""

SiftOption: TypeAlias = bool | int | float
"""Value of an option of COLMAP's SIFT."""
Result = TypeVar("Result")


class WorkerProcess:
    """A running worker process."""

    def __init__(self, process: "subprocess.Popen[bytes]", output: IO[bytes]) -> None:
        self.process, self._output = process, output

    def messages(self) -> Iterator[dict[str, Json]]:
        """Yield the messages of the process, until it ends."""
        for line in self.process.stdout or ():
            if line.endswith(b"\n"):  # else the process was killed while writing it
                yield json.loads(line)

    def has_ended(self, wait_s: float) -> bool:
        """Return whether the process ends within `wait_s` seconds."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(wait_s)
        return self.process.poll() is not None

    def check(self, doing: str) -> None:
        """Wait for the process to end, and raise a BackendError if it failed or was killed."""
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
def start_worker(call: Callable[[], object]) -> Iterator[WorkerProcess]:
    """Start a process that makes a call, which is pickled and so of a module's function; kill it with the block."""
    level = log_level()
    # -P: nothing is imported from the current folder
    command = [sys.executable, "-P", "-m", "sfm_app.colmap.worker_process", str(level), str(os.getpid())]
    # the output goes to a file: nothing reads a pipe while the process runs, and a full pipe would block it forever
    with (
        tempfile.TemporaryFile() as output,
        subprocess.Popen(  # noqa: S603 - our module
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=None if level else output
        ) as process,
    ):
        try:
            with contextlib.suppress(OSError):  # the process has failed already; `check` reports why
                pipe = cast(IO[bytes], process.stdin)
                pickle.dump(call, pipe)
                pipe.flush()
            yield WorkerProcess(process, output)
        finally:
            if process.poll() is None:
                process.kill()


class ProcessGroup:
    """Worker processes of several threads, which end together."""

    def __init__(self) -> None:
        self._running, self._lock, self._has_ended = set[WorkerProcess](), threading.Lock(), False

    def run(self, call: Callable[[], Result], doing: str, progress: Progress) -> Result:
        """Make a call in a process that ends with the group; return its result; errors name what it was `doing`."""
        with start_worker(call) as process:
            with self._lock:
                self._running.add(process)
                if self._has_ended:
                    process.process.kill()
            try:
                messages = relay(process, progress)
                process.check(doing)
            finally:
                with self._lock:
                    self._running.discard(process)
        return pickle.loads(bytes.fromhex(str(messages[RESULT])))  # type: ignore[no-any-return]  # noqa: S301 - ours

    def stop(self) -> None:
        """Stop all processes, and those that start later."""
        with self._lock:
            self._has_ended = True
            for process in self._running:
                process.process.kill()


def run_worker(call: Callable[[], Result], doing: str, progress: Progress | None = None) -> Result:
    """Make a call in a process of its own, and return its result, as `ProcessGroup.run` does."""
    return ProcessGroup().run(call, doing, progress or Progress())


def serve(level: int, parent: int) -> None:
    """Make the call in the worker process, report its result, and end when the parent does."""
    ignore_interrupts()
    end_at_exit()
    os.dup2(sys.stdout.fileno(), REPORT_FD)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # output of libraries must not mix with the reports
    logging.captureWarnings(capture=True)  # -v shows what this process prints
    show_log(level)
    try:
        call: Callable[[], object] = pickle.load(sys.stdin.buffer)  # noqa: S301 - from our parent
    except EOFError:
        return
    watch_parent(parent, lambda: os._exit(1))
    report(**{RESULT: pickle.dumps(call()).hex()})


def report(**message: Json) -> None:
    """Send a message from the worker process to its parent."""
    os.write(REPORT_FD, f"{json.dumps(message)}\n".encode())


class ProgressReporter(Progress):
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


if __name__ == "__main__":
    serve(int(sys.argv[1]), int(sys.argv[2]))
