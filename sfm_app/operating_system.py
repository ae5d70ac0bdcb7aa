"""Differences between operating systems; no other module asks which system this is.

Each function uses Linux's way and has a fallback for macOS, Windows, and drives and containers that lack something.
"""

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

# Which abilities this system has. Tests take some away, to run the fallbacks on a system that has them all.

VARIABLE = "SFM_APP_WITHOUT"
"""Environment variable that takes abilities away, by names with commas; processes that a run starts have it, too."""


class Ability(StrEnum):
    """What a system may have or lack; the value is its name for people."""

    LINKS = "links"
    """A file may point to another. Windows asks for a right that few users have."""
    HARD_LINKS = "hard links"
    """Two files may share their bytes. Not between drives, and not on sticks and some network drives."""
    OPEN_FILES = "replacing open files"
    """A file may be replaced while another program, such as a virus scanner, looks at it."""
    GROUPS = "process groups"
    """One signal ends a process with all that it has started."""
    CLOSED_INPUT = "waiting for input"
    """A thread may wait for the end of the standard input. On Windows, it holds up the loading of libraries."""
    CHILD_TIMES = "times of children"
    """The system adds up the CPU seconds of processes that have ended."""
    CORES = "chosen cores"
    """The system says which cores this process may use."""
    CONTAINERS = "container limits"
    """The system says how much memory a container may use."""
    REUSED_PORTS = "reusing ports"
    """The port of a program that has just ended can be asked for. On Windows, that lets two programs share one."""
    WHEEL_LIBRARIES = "libraries in wheels"
    """The libraries of a package are files of their own, whose functions can be called."""
    EXIT_HANDLERS = "exit handlers"
    """The C library can be told what to do first at the end of a process, and passes the exit code on."""


LINUX = frozenset(Ability)
MACOS = LINUX - {Ability.CORES, Ability.CONTAINERS, Ability.EXIT_HANDLERS}
WINDOWS = frozenset({Ability.LINKS, Ability.HARD_LINKS})
"""Links are tried, and copied where they are refused."""


def find_abilities(platform: str, environment: Mapping[str, str]) -> frozenset[Ability]:
    """Return what a system has, less what the environment takes away.

    Args:
        platform: as `sys.platform` has it.
        environment: variables of the process.

    Raises:
        ValueError: the variable names something that is no ability.
    """
    usual = WINDOWS if platform == "win32" else LINUX if platform.startswith("linux") else MACOS
    named = [name.strip() for name in environment.get(VARIABLE, "").split(",") if name.strip()]
    return usual - {Ability(name) for name in named}


HERE = find_abilities(sys.platform, os.environ)


def lacks(ability: Ability) -> bool:
    """Return whether this system lacks an ability, so that the fallback is used."""
    return ability not in HERE


def missing_abilities() -> list[str]:
    """Return the names of what this system lacks, for people."""
    return [ability.value for ability in Ability if lacks(ability)]


# Links, and files that take the place of others.

WAITS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Seconds between attempts at a file that another program looks at. Chosen by hand: virus scanners take less."""
PIECE_BYTES = 1_000_000
"""Bytes that are copied at once. Chosen by hand."""


def link_or_copy(place: Path, target: Path | str, source: Path) -> None:
    """Make a link to a file, or a copy of it where links cannot be made.

    A copy is no hard link: a program that writes into it must not change the file of the user.

    Args:
        place: where nothing is yet.
        target: what the link says.
        source: the file.

    Raises:
        OSError: neither can be written, or something is there.
    """
    if not lacks(Ability.LINKS):
        try:
            place.symlink_to(target)
        except FileExistsError:  # a copy would go through a link that is there, into what it leads to
            raise
        except OSError:  # Windows without the right to link, some network drives
            pass
        else:
            return
    with source.open("rb") as read, place.open("xb") as written:
        shutil.copyfileobj(read, written, PIECE_BYTES)


def share_bytes(source: Path, target: Path) -> None:
    """Make a file with the bytes of another, which they share where the system can. Neither is written to later.

    Args:
        source: the other file.
        target: in a folder that is there.

    Raises:
        OSError: it cannot be written.
    """
    if not lacks(Ability.HARD_LINKS):
        with contextlib.suppress(OSError):
            os.link(source, target)
            return
    shutil.copyfile(source, target)


def is_link(path: Path) -> bool:
    """Return whether a path leads elsewhere: a symbolic link, or a junction of Windows."""
    with contextlib.suppress(OSError, ValueError):
        found = path.lstat()
        junction = getattr(found, "st_reparse_tag", 0) == getattr(stat, "IO_REPARSE_TAG_MOUNT_POINT", -1)
        return stat.S_ISLNK(found.st_mode) or junction
    return False


def replace_file(source: Path, target: Path) -> None:
    """Put a file in the place of another, at once and as a whole.

    Args:
        source: on the same drive.
        target: replaced if it is there.

    Raises:
        OSError: the system refuses.
    """
    _insist(source.replace, target)


def move(source: Path, target: Path) -> None:
    """Give a file or a folder another place.

    Args:
        source: on the same drive.
        target: where nothing is.

    Raises:
        OSError: the system refuses.
    """
    _insist(source.rename, target)


def _insist(act: Callable[[Path], object], target: Path) -> None:
    """Do something to a file; where open files cannot be replaced, wait until whoever has it open is done."""
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
    """Yield the libraries of that name which the wheel of a package keeps; none where they are part of its modules.

    Args:
        package: folder of the package, as installed.
        project: its name in the registry.
        name: beginning of the file names.
    """
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


# Processes that end with those that started them, and why a process has ended.

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
