"""Safe import of pycolmap, its types, and translation of its errors into ours."""

import contextlib
import tempfile
import threading
import traceback
import zlib  # before pycolmap, whose own deflate symbols otherwise break every later use of zlib in this process
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TypeVar

import numpy as np
import pycolmap as pycolmap

from sfm_app.errors import BackendError, NumericalError, SfmError
from sfm_app.numerical import FAILURES, error_reason
from sfm_app.operating_system import keep_handler
from sfm_app.progress import Progress

Result = TypeVar("Result")

THREAD_NAME = "colmap-alone"
"""Name of the threads that nothing waits for."""

Reconstruction = pycolmap.Reconstruction
Camera = pycolmap.Camera
CancellationToken = pycolmap.CancellationToken

zlib.crc32(b"")  # zlib is imported for its side effect
keep_handler()
_Level = pycolmap.logging.Level
pycolmap.logging.minloglevel = _Level.FATAL.value

LEVELS = tuple(level.value for level in (_Level.FATAL, _Level.WARNING, _Level.INFO))


# The stubs of pycolmap 4.2 do not type the elements of COLMAP's maps.


def all_cameras(model: Reconstruction) -> Iterable[pycolmap.Camera]:
    """Return all cameras of a model."""
    cameras: Iterable[pycolmap.Camera] = model.cameras.values()
    return cameras


def all_points(model: Reconstruction) -> Iterable[tuple[int, pycolmap.Point3D]]:
    """Return all points of a model with their ids."""
    points: Iterable[tuple[int, pycolmap.Point3D]] = model.points3D.items()
    return points


def largest_model(models: Mapping[int, Reconstruction]) -> Reconstruction | None:
    """Return the model with most photos; None if there is no model."""
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def show_log(level: int) -> None:
    """Set what COLMAP logs to stderr: 0 nothing, 1 warnings, 2 everything."""
    pycolmap.logging.minloglevel = LEVELS[min(level, 2)]
    pycolmap.logging.alsologtostderr = level > 0


def log_level() -> int:
    """Return the level that `show_log` last set."""
    return LEVELS.index(pycolmap.logging.minloglevel)


def has_cuda() -> bool:
    """Return whether this pycolmap can use a GPU."""
    return bool(pycolmap.has_cuda)


def versions() -> dict[str, str]:
    """Return the versions of pycolmap and COLMAP, for the manifest."""
    return {"pycolmap": pycolmap.__version__, "colmap": pycolmap.COLMAP_version.split(" ")[-1]}


@contextlib.contextmanager
def translate_errors(doing: str) -> Iterator[None]:
    """Turn exceptions of COLMAP into a BackendError that names the operation, of NumPy into a NumericalError."""
    try:
        yield
    except (SfmError, OSError):
        raise
    except Exception as err:
        if not _is_ours(err):
            hint = "run again with -v to see what COLMAP says"
            raise BackendError(f"COLMAP failed while {doing}: {error_reason(err)}", hint) from err
        if isinstance(err, FAILURES):
            hint = "this is a bug; please report it with OUT/log.txt"
            raise NumericalError(f"the computation failed while {doing}: {error_reason(err)}", hint) from err
        raise


def _is_ours(err: Exception) -> bool:
    """Return whether an error was raised by Python code other than our calls of COLMAP."""
    if isinstance(err, np.linalg.LinAlgError | ArithmeticError):
        return True
    frames = [frame for frame, _ in traceback.walk_tb(err.__traceback__)]
    module = str(frames[-1].f_globals.get("__name__", ""))
    if module.startswith(("sfm_app.colmap.", "pycolmap")):
        return False
    called = len(frames) > 2  # the first frame is that of `translate_errors`, the second that of the `with` block
    return called and module.startswith(("sfm_app.", "numpy.", "scipy.", "cv2"))


def check_written(*files: Path) -> None:
    """Raise an OSError unless a megabyte is free after COLMAP has written files: it does not report a full disk."""
    longest = max((file.stat().st_size for file in files), default=0)
    with tempfile.TemporaryFile(dir=files[0].parent) as probe:
        probe.seek(longest)
        probe.write(bytes(1_000_000))


def run_in_daemon_thread(call: Callable[[], Result]) -> Result:
    """Run a COLMAP call that cannot be stopped, so that Ctrl-C takes effect at once."""
    future: Future[Result] = Future()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as err:
            future.set_exception(err)

    threading.Thread(target=run, name=THREAD_NAME, daemon=True).start()
    while wait([future], timeout=0.2).not_done:
        pass
    return future.result()


def has_running_call() -> bool:
    """Return whether an abandoned COLMAP call is still running; the program must then exit without waiting for it."""
    return any(thread.name == THREAD_NAME for thread in threading.enumerate())


def run_interruptible(call: Callable[[CancellationToken], Result], poll: Callable[[], None] = lambda: None) -> Result:
    """Run a long COLMAP call in a thread, so that Ctrl-C cancels its token; `poll` is called twice a second."""
    token = CancellationToken()
    with ThreadPoolExecutor(1, thread_name_prefix="colmap") as thread:
        future = thread.submit(call, token)
        try:
            while wait([future], timeout=0.5).not_done:
                poll()
        except KeyboardInterrupt:
            token.cancel()
            raise
        return future.result()


def run_with_progress(
    call: Callable[[CancellationToken], None], done: Callable[[], int], label: str, total: int, progress: Progress
) -> None:
    """Run a long COLMAP call as `run_interruptible` does, with a progress bar; `done` counts the finished steps."""
    steps = 0

    def poll() -> None:
        nonlocal steps
        before, steps = steps, done()
        progress.advance(steps - before)

    progress.start(label, total)
    try:
        run_interruptible(call, poll)
        poll()
    finally:
        progress.finish()
