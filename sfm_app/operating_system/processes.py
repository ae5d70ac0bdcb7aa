"""Processes that end with those that started them, and why a process has ended."""

import contextlib
import ctypes
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import psutil

from sfm_app.operating_system.abilities import Ability, lacks

LOOK_S = 0.2
"""Seconds between two looks at whether a process still runs. Chosen by hand."""
STANDARD_INPUT = 0
FIRST_FAULT = 0xC0000000
"""From here on, exit codes of Windows say that a program was stopped by a fault."""
FAULTS: Mapping[int, str] = {
    0xC0000005: "access violation",
    0xC0000017: "no memory",
    0xC000001D: "illegal instruction",
    0xC0000094: "division by zero",
    0xC00000FD: "stack overflow",
    0xC000012D: "no memory",
    0xC0000135: "a library is missing",
    0xC0000374: "damaged heap",
    0xC0000409: "aborted",
}
"""What Windows means by its exit codes."""
KILLED = -9
"""Exit code of a process that was killed, as Linux does where the memory is full."""


def group_options() -> dict[str, Any]:
    """Return the arguments of `subprocess.Popen` for a process that Ctrl-C does not reach, nor what it starts."""
    if lacks(Ability.GROUPS):
        return {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
    return {"start_new_session": True}


def end_group(process: "subprocess.Popen[Any]", wait_s: float) -> None:
    """End a process that was started with `group_options`, and all that it has started.

    Args:
        process: its first process.
        wait_s: seconds that it may take.
    """
    if lacks(Ability.GROUPS):
        with contextlib.suppress(psutil.Error):
            _kill_tree(psutil.Process(process.pid))
    else:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS says the latter of what has ended
            os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(wait_s)
    process.kill()


def end_own_group() -> None:
    """End this process, which was started with `group_options`, and all that it has started."""
    if lacks(Ability.GROUPS):
        with contextlib.suppress(psutil.Error):
            _kill_tree(psutil.Process())
    else:
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def _kill_tree(root: psutil.Process) -> None:
    """Kill what a process has started, so that nothing is started again, and the process itself last."""
    for process in (*root.children(recursive=True), root):
        with contextlib.suppress(psutil.Error):
            process.kill()


def watch_parent(parent: int, then: Callable[[], object]) -> None:
    """Call a function, in a thread, once the process that has started this one has ended, however that was.

    Args:
        parent: its number. It is not asked for here: on Windows, a virtual environment puts a process between.
        then: ends this process.
    """

    def watch() -> None:
        if lacks(Ability.CLOSED_INPUT):
            _wait_for_end(parent)
        else:
            while os.read(STANDARD_INPUT, 1):
                pass
        then()

    threading.Thread(target=watch, name="parent", daemon=True).start()


def _wait_for_end(number: int) -> None:
    with contextlib.suppress(psutil.Error):
        process = psutil.Process(number)
        while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
            time.sleep(LOOK_S)


def end_at_exit() -> None:
    """Let this process end at once where a library calls `exit`, without what is registered for its end up to now.

    A library that does so in a thread (libjpeg, where the disk is full) has the data of all others taken away while
    their threads work on; then they may wait for each other for ever.
    """
    if lacks(Ability.EXIT_HANDLERS):
        return
    library = ctypes.CDLL(None)
    if hasattr(library, "on_exit"):  # of glibc, and not of musl
        library.on_exit(library._exit, None)


def ignore_interrupts() -> None:
    """Leave Ctrl-C to the process that has started this one."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def heed_requests_to_end() -> Iterator[None]:
    """Let a request to end, as `kill` and `docker stop` send it, do what Ctrl-C does; in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def keep_handler() -> None:
    """Take requests to end back from a library: COLMAP prints where each thread is."""
    with contextlib.suppress(ValueError):  # only the main thread can
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def has_run_out(code: int) -> bool:
    """Return whether an exit code says that the system has ended a process, as it does where the memory is full."""
    return code == KILLED or FAULTS.get(code) == "no memory"


def crash_name(code: int) -> str:
    """Return what made a process crash, by its exit code; empty where it ended by itself."""
    if code < 0:
        try:
            return signal.Signals(-code).name
        except ValueError:  # signals without a name
            return f"signal {-code}"
    if code < FIRST_FAULT:
        return ""
    return FAULTS.get(code, f"fault {code:#x}")
