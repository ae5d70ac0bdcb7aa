"""pycolmap, imported once and safely, and the one edge at which its errors become ours."""

import contextlib
import tempfile
import threading
import traceback
import zlib  # before pycolmap, whose own deflate symbols otherwise break every later use of zlib in this process
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as NotYet
from pathlib import Path
from typing import TypeVar

import numpy as np
import pycolmap

from sfm_app.errors import BackendError, NumericalError, SfmError
from sfm_app.numerical import FAILURES, Json, reason_of
from sfm_app.progress import Progress

__all__ = [
    "backend", "check_written", "counted", "has_cuda", "interruptible", "left_running", "log_level", "patiently",
    "plain", "pycolmap", "show_log", "versions",
]  # fmt: skip

Result = TypeVar("Result")

LEFT, POLL_S = "colmap-alone", 0.2
"""Name of threads that nobody waits for, and how often one looks whether they are done."""
ROOM = 1_000_000
"""Bytes that have to be left: more than any program keeps back before it writes."""

zlib.crc32(b"")  # the import above is there for its side effect
_Level = pycolmap.logging.Level
pycolmap.logging.minloglevel = _Level.FATAL.value

LEVELS = tuple(level.value for level in (_Level.FATAL, _Level.WARNING, _Level.INFO))


def show_log(level: int) -> None:
    """Let COLMAP speak on stderr: 0 not at all, 1 warnings, 2 everything."""
    pycolmap.logging.minloglevel = LEVELS[min(level, 2)]
    pycolmap.logging.alsologtostderr = level > 0


def log_level() -> int:
    """Return what `show_log` has set last."""
    return LEVELS.index(pycolmap.logging.minloglevel)


def has_cuda() -> bool:
    """Return whether this pycolmap can use a GPU."""
    return bool(pycolmap.has_cuda)


def versions() -> dict[str, str]:
    """Return what the manifest notes about COLMAP."""
    return {"pycolmap": pycolmap.__version__, "colmap": pycolmap.COLMAP_version.split(" ")[-1]}


@contextlib.contextmanager
def backend(doing: str) -> Iterator[None]:
    """Turn whatever COLMAP raises into a BackendError that says what was being done; an error of ours is not COLMAP's.

    Raises:
        BackendError: COLMAP failed.
        NumericalError: NumPy failed, or our own computation did.
    """
    try:
        yield
    except (SfmError, OSError):
        raise
    except Exception as err:
        if not _is_ours(err):
            hint = "run again with -v to see what COLMAP says"
            raise BackendError(f"COLMAP failed while {doing}: {reason_of(err)}", hint) from err
        if isinstance(err, FAILURES):
            hint = "this is a bug; please report it with OUT/log.txt"
            raise NumericalError(f"the computation failed while {doing}: {reason_of(err)}", hint) from err
        raise


def _is_ours(err: Exception) -> bool:
    """Return whether Python code other than that which calls COLMAP has raised an error.

    Pycolmap itself has no frames.
    """
    if isinstance(err, np.linalg.LinAlgError | ArithmeticError):
        return True
    frames = [frame for frame, _ in traceback.walk_tb(err.__traceback__)]
    where = str(frames[-1].f_globals.get("__name__", ""))
    if where.startswith(("sfm_app.colmap.", "pycolmap")):
        return False
    called = len(frames) > 2  # the first is that of `backend`, the second holds the block
    return called and where.startswith(("sfm_app.", "numpy.", "scipy.", "cv2"))


def check_written(*files: Path) -> None:
    """Check that files which COLMAP has written could have been longer: it does not say when the disk is full.

    Raises:
        OSError: nothing more can be written, and why.
    """
    longest = max((file.stat().st_size for file in files), default=0)
    with tempfile.TemporaryFile(dir=files[0].parent) as probe:
        probe.seek(longest)
        probe.write(bytes(ROOM))


def patiently(call: Callable[[], Result]) -> Result:
    """Run a COLMAP call that nobody can stop, so that Ctrl-C is heard at once; then the call is left behind.

    See `left_running`.
    """
    found: Future[Result] = Future()

    def run() -> None:
        try:
            found.set_result(call())
        except BaseException as err:
            found.set_exception(err)

    threading.Thread(target=run, name=LEFT, daemon=True).start()
    while True:
        with contextlib.suppress(NotYet):
            return found.result(timeout=POLL_S)
        if found.done():
            return found.result()


def left_running() -> bool:
    """Return whether a call of COLMAP is still at work: then a program must end without waiting for it."""
    return any(thread.name == LEFT for thread in threading.enumerate())


def interruptible(call: Callable[[pycolmap.CancellationToken], None], poll: Callable[[], None]) -> None:
    """Run a long COLMAP call in a thread, so that Ctrl-C stops it.

    Args:
        call: ends early once its token is cancelled.
        poll: called twice a second, to show how far it is.
    """
    token = pycolmap.CancellationToken()
    with ThreadPoolExecutor(1, thread_name_prefix="colmap") as thread:
        future = thread.submit(call, token)
        try:
            while True:
                try:
                    return future.result(timeout=0.5)
                except NotYet:
                    if future.done():
                        raise
                    poll()
        except KeyboardInterrupt:
            token.cancel()
            raise


def counted(
    call: Callable[[pycolmap.CancellationToken], None],
    done: Callable[[], int],
    label: str,
    total: int,
    progress: Progress,
) -> None:
    """Run as `interruptible` does, with a bar.

    Args:
        call: ends early once its token is cancelled.
        done: says how many steps are finished.
        label: what is done, for people.
        total: number of steps.
        progress: shows the bar.
    """
    seen = 0

    def poll() -> None:
        nonlocal seen
        before, seen = seen, done()
        progress.advance(seen - before)

    progress.start(label, total)
    try:
        interruptible(call, poll)
    finally:
        progress.finish()


def plain(options: Mapping[object, object]) -> dict[str, Json]:
    """Return COLMAP's options as JSON can hold them: the manifest records all that are in force."""
    return {str(key): _plain(value) for key, value in options.items()}


def _plain(value: object) -> Json:
    if isinstance(value, dict):
        return plain(value)
    return value if isinstance(value, bool | int | float | str) else str(value)
