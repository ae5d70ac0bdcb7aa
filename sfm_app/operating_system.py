"""Differences between operating systems; no other module asks which system this is.

Each function has a fallback for macOS, Windows, and drives and containers with fewer abilities than Linux;
OSError where the system refuses.
"""

import _thread
import contextlib
import ctypes
import math
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Any

import psutil

# Abilities of this system. Tests take some away, to run the fallbacks on Linux.

VARIABLE = "SFM_APP_WITHOUT"
"""Environment variable with the names of abilities to take away; child processes inherit it."""


class Ability(StrEnum):
    """An ability that a system may lack; the value is its name for people."""

    LINKS = "links"
    """Symbolic links. Windows needs a right that few users have."""
    HARD_LINKS = "hard links"
    """Not between drives, and not on sticks and some network drives."""
    OPEN_FILES = "replacing open files"
    """A file may be replaced while another program, such as a virus scanner, has it open."""
    GROUPS = "process groups"
    """One signal ends a process with its children."""
    CLOSED_INPUT = "waiting for input"
    """A thread may wait for the end of the standard input. On Windows, it blocks the loading of libraries."""
    CHILD_TIMES = "times of children"
    """The system adds up the CPU seconds of finished children."""
    CORES = "chosen cores"
    """The system tells which cores this process may use."""
    CONTAINERS = "container limits"
    """The system tells the memory limit of a container."""
    REUSED_PORTS = "reusing ports"
    """The port of a program that has just ended is free. On Windows, two programs could share it."""
    WHEEL_LIBRARIES = "libraries in wheels"
    """The libraries of a package are files, whose functions can be called."""
    EXIT_HANDLERS = "exit handlers"
    """The C library has `on_exit`, which passes the exit code on."""


LINUX = frozenset(Ability)
MACOS = LINUX - {Ability.CORES, Ability.CONTAINERS, Ability.EXIT_HANDLERS}
WINDOWS = frozenset({Ability.LINKS, Ability.HARD_LINKS})
"""Copies replace links that Windows refuses."""


def find_abilities(platform: str, environment: Mapping[str, str]) -> frozenset[Ability]:
    """Return the abilities of `sys.platform`, less those that the environment names; ValueError for an unknown name."""
    usual = WINDOWS if platform == "win32" else LINUX if platform.startswith("linux") else MACOS
    named = [name.strip() for name in environment.get(VARIABLE, "").split(",") if name.strip()]
    return usual - {Ability(name) for name in named}


HERE = find_abilities(sys.platform, os.environ)


def lacks(ability: Ability) -> bool:
    """Return whether this system lacks an ability, so that the fallback is used."""
    return ability not in HERE


def missing_abilities() -> list[str]:
    """Return the names of missing abilities, for people."""
    return [ability.value for ability in Ability if lacks(ability)]


# Links, and atomic replacement of files.

WAITS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Seconds between attempts at a file that another program has open. By hand: virus scanners take less."""


def link_or_copy(place: Path, target: Path | str, source: Path) -> None:
    """Make a link with the text `target` to the file `source`, or a copy, which programs may write to."""
    if not lacks(Ability.LINKS):
        try:
            place.symlink_to(target)
        except FileExistsError:  # a copy would follow an existing link
            raise
        except OSError:  # Windows without the right to link, some network drives
            pass
        else:
            return
    with source.open("rb") as read, place.open("xb") as written:
        shutil.copyfileobj(read, written, 1_000_000)


def share_bytes(source: Path, target: Path) -> None:
    """Make a file with the bytes of another, as a hard link if possible; neither is written to later."""
    if not lacks(Ability.HARD_LINKS):
        with contextlib.suppress(OSError):
            os.link(source, target)
            return
    shutil.copyfile(source, target)


def is_link(path: Path) -> bool:
    """Return whether a path is a symbolic link, or a junction of Windows."""
    with contextlib.suppress(OSError, ValueError):
        status = path.lstat()
        junction = getattr(status, "st_reparse_tag", 0) == getattr(stat, "IO_REPARSE_TAG_MOUNT_POINT", -1)
        return stat.S_ISLNK(status.st_mode) or junction
    return False


def replace_file(source: Path, target: Path) -> None:
    """Replace a file by another one on the same drive, atomically."""
    _insist(source.replace, target)


def move(source: Path, target: Path) -> None:
    """Move a file or a folder on the same drive to a path where nothing is."""
    _insist(source.rename, target)


def _insist(act: Callable[[Path], object], target: Path) -> None:
    """Call a function; if open files cannot be replaced, wait until no other program has the file open."""
    for wait_s in WAITS_S if lacks(Ability.OPEN_FILES) else ():
        try:
            act(target)
        except PermissionError:
            time.sleep(wait_s)
        else:
            return
    act(target)


# Shared libraries that come with Python packages.


def find_in_wheel(package: Path, project: str, name: str) -> Iterator[ctypes.CDLL]:
    """Yield the libraries whose names start with `name` in the wheel of a package; the registry has it as `project`."""
    if lacks(Ability.WHEEL_LIBRARIES):
        return
    for folder in (package.parent / f"{project}.libs", package / ".dylibs"):  # Linux, macOS
        for file in folder.glob(f"{name}*"):
            yield ctypes.CDLL(str(file))


def load_libusb() -> None:
    """Load the libusb of a wheel, to which Open3D links; only on Linux the wheel is a dependency."""
    try:
        import libusb_package
    except ImportError:
        return
    if (path := libusb_package.get_library_path()) is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)


# Cores, memory and time of this machine.

CONTAINER_LIMIT = Path("/sys/fs/cgroup/memory.max")
"""Limit of the container in bytes, or a word if it has none."""


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if lacks(Ability.CORES):
        return os.cpu_count() or 1
    return len(os.sched_getaffinity(0))


def machine_memory_mb() -> float:
    """Return the memory of this machine or container in MB."""
    return min(float(psutil.virtual_memory().total) / 1e6, _container_limit_mb())


def free_memory_mb() -> float:
    """Return the free memory of this machine or container in MB."""
    return min(float(psutil.virtual_memory().available) / 1e6, _container_limit_mb())


def _container_limit_mb() -> float:
    """Return the memory limit of the container in MB; infinite without one."""
    if not lacks(Ability.CONTAINERS):
        with contextlib.suppress(OSError):
            limit = re.match(r"\d+", CONTAINER_LIMIT.read_text(encoding="ascii"))
            return int(limit[0]) / 1e6 if limit else math.inf
    return math.inf


class ChildTimes:
    """CPU seconds of child processes, up to the last look, if the system does not add them up."""

    def __init__(self) -> None:
        self._seconds = dict[tuple[int, float], float]()

    def look(self, processes: Iterable[psutil.Process]) -> None:
        """Note the CPU seconds of these processes."""
        for process in processes if lacks(Ability.CHILD_TIMES) else ():
            with contextlib.suppress(psutil.Error):  # it has ended
                times = process.cpu_times()
                self._seconds[process.pid, process.create_time()] = times.user + times.system

    def seconds(self) -> float:
        """Return the recorded CPU seconds."""
        return sum(self._seconds.values())


def cpu_seconds() -> float:
    """Return the CPU seconds of this process, and of its finished children if the system says so."""
    return sum(os.times()[: 2 if lacks(Ability.CHILD_TIMES) else 4])


def yield_to_others(niceness: int) -> None:
    """Give this process a lower priority; Windows has only one."""
    if hasattr(os, "nice"):
        os.nice(niceness)
    else:
        psutil.Process().nice(psutil.BELOW_NORMAL_PRIORITY_CLASS)


# Processes that end with their parents, and causes of their end.

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


def group_options() -> dict[str, Any]:
    """Return arguments of `subprocess.Popen` for a process and children that Ctrl-C does not reach."""
    if lacks(Ability.GROUPS):
        return {"creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)}
    return {"start_new_session": True}


def end_group(process: "subprocess.Popen[Any]", wait_s: float) -> None:
    """End a process started with `group_options`, and its children, within so many seconds."""
    if lacks(Ability.GROUPS):
        with contextlib.suppress(psutil.Error):
            _kill_tree(psutil.Process(process.pid))
    else:
        with contextlib.suppress(ProcessLookupError, PermissionError):  # macOS raises the latter for ended processes
            os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(wait_s)
    process.kill()


def end_own_group() -> None:
    """End this process, started with `group_options`, and its children."""
    if lacks(Ability.GROUPS):
        with contextlib.suppress(psutil.Error):
            _kill_tree(psutil.Process())
    else:
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def _kill_tree(root: psutil.Process) -> None:
    """Kill the children of a process, then the process, so that it starts no more."""
    for process in (*root.children(recursive=True), root):
        with contextlib.suppress(psutil.Error):
            process.kill()


def watch_parent(parent: int, then: Callable[[], object]) -> None:
    """Call a function in a thread when the process that started this one has ended, for any reason.

    The caller knows the parent's number: on Windows, a virtual environment adds a process between.
    """

    def watch() -> None:
        if lacks(Ability.CLOSED_INPUT):
            with contextlib.suppress(psutil.Error):
                process = psutil.Process(parent)
                while process.is_running() and process.status() != psutil.STATUS_ZOMBIE:
                    time.sleep(0.2)
        else:
            while os.read(0, 1):
                pass
        then()

    threading.Thread(target=watch, name="parent", daemon=True).start()


def end_at_exit() -> None:
    """End this process at once when a library calls `exit`, skipping the handlers registered so far.

    If a library calls `exit` in a thread (libjpeg, on a full disk), its handlers destroy data while other threads use
    it; these threads may then wait for each other for ever.
    """
    if lacks(Ability.EXIT_HANDLERS):
        return
    library = ctypes.CDLL(None)
    if hasattr(library, "on_exit"):  # of glibc, and not of musl
        library.on_exit(library._exit, None)


def ignore_interrupts() -> None:
    """Leave Ctrl-C to the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def heed_requests_to_end() -> Iterator[None]:
    """Let SIGTERM (`kill`, `docker stop`) act like Ctrl-C; in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def interrupt_main_thread() -> None:
    """Do from another thread what Ctrl-C does: also a main thread that waits for a lock is woken."""
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main(signal.SIGINT)


def keep_handler() -> None:
    """Set our SIGTERM handler again after a library changed it: COLMAP's prints stack traces."""
    with contextlib.suppress(ValueError):  # only the main thread can
        signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


def has_run_out(code: int) -> bool:
    """Return whether an exit code says that the system ended a process, as on full memory."""
    return code == -9 or FAULTS.get(code) == "no memory"


def crash_name(code: int) -> str:
    """Return the cause of a crash by exit code; empty if the process ended by itself."""
    if code < 0:
        try:
            return signal.Signals(-code).name
        except ValueError:  # signals without a name
            return f"signal {-code}"
    if code < 0xC0000000:  # Windows: larger codes are faults
        return ""
    return FAULTS.get(code, f"fault {code:#x}")
