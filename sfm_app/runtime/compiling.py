"""Kernels compiled by processes of their own while COLMAP looks for features, on the first run on a machine.

`kernels.json` lists the kernels of a run with the types of their arguments. A run that needs one of them before it is
there waits for it instead of compiling it a second time; kernels or types that are not listed are compiled as needed.
"""

import contextlib
import gc
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from hashlib import blake2b
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, TypeAlias

import numba
from filelock import FileLock
from llvmlite.binding import get_host_cpu_name
from numba import types

from sfm_app.jit import ASKED_FOR, wait_where
from sfm_app.operating_system import watch_parent, yield_to_others
from sfm_app.progress import Progress

PACKAGE = Path(__file__).parents[1]
LIST = Path(__file__).with_name("kernels.json")
PARTS = ("pairs", "cameras", "surface")
"""Of the list, each for one process: two of about the same length for the stages up to the scene, and one for those
after it."""
ROOMS = {
    "pairs": ("ransac.degeneracy.", "ransac.inner_loop.", "ransac.scoring.", "ransac.solvers.", "ransac.verification."),
    "surface": ("stereo.", "meshing.", "texture.", "geometry.triangles."),
}
"""Packages and modules whose kernels belong to a part; those of all others belong to the cameras."""
LATER = 10
"""Added to the niceness of the process for the surface: its kernels are needed last. Chosen by hand."""
ARRAY = re.compile(r"(\w+)\[(\d+)([CFA])(!?)\]")
Kind: TypeAlias = "str | Sequence[Kind] | Mapping[str, Sequence[Kind]]"
"""A type of numba: `float64`, `float64[2C]` for an array (`!`: it cannot be written), a sequence for a tuple, and its
class by name for a named one."""


@contextlib.contextmanager
def compiling_ahead(parts: Sequence[str], progress: Progress) -> Iterator[threading.Event]:
    """Compile kernels in the background for the duration of the block, unless the machine has them already.

    The block gets an event. Once it is set, whoever needs a kernel that is not there has an InterruptedError instead.

    Args:
        parts: of `PARTS`.
        progress: is told about it.
    """
    has_ended = threading.Event()
    missing = [part for part in parts if (stamp := stamp_file(part)) and not stamp.exists()]
    if not missing:
        yield has_ended
        return
    progress.say("first run on this machine: parts of the program are compiled, half a minute more, once")
    running = {part: _start(part) for part in missing}
    wanted = {part: listed_signatures(part) for part in missing}

    def is_awaited(name: str, signature: Any) -> bool:
        if has_ended.is_set():
            raise InterruptedError("the run has ended")
        asked = name, json.dumps([describe(kind) for kind in signature])
        return any(asked in wanted[part] and process.poll() is None for part, process in running.items())

    wait_where(is_awaited)
    try:
        yield has_ended
    finally:
        wait_where(None)
        for process in running.values():
            process.kill()
            process.communicate()


def _start(part: str) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-P", "-m", "sfm_app.runtime.compiling", part, str(os.getpid())]
    quiet = subprocess.DEVNULL
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet)  # noqa: S603 - our module


def compile_part(part: str) -> list[str]:
    """Compile the kernels of a part of the list, and note it for later runs.

    Args:
        part: of `PARTS`.

    Returns:
        Why kernels could not be compiled; empty where all are there.
    """
    stamp, failed = stamp_file(part), list[str]()
    if stamp is None:
        return ["no folder for compiled kernels is writable"]
    with FileLock(stamp.with_name(f"compiling-{part}.lock")):  # another run may be at it
        for name, signatures in read_list()[part].items():
            for kinds in signatures:
                try:
                    resolve_name(name).compile(tuple(make_type(kind) for kind in kinds))
                except Exception as err:  # the run compiles it, or says what is wrong
                    failed.append(f"{name}: {err}")
        for old in stamp.parent.glob(f"compiled-{part}-*"):
            old.unlink(missing_ok=True)
        stamp.touch()
    return failed


@cache
def read_list() -> dict[str, dict[str, list[list[Kind]]]]:
    """Return the types of arguments by the full names of kernels, by part."""
    found: dict[str, dict[str, list[list[Kind]]]] = json.loads(LIST.read_text(encoding="utf-8"))
    return found


def listed_signatures(part: str) -> set[tuple[str, str]]:
    """Return the names of kernels with the types of their arguments as JSON.

    Args:
        part: of `PARTS`.
    """
    return {(name, json.dumps(kinds)) for name, every in read_list()[part].items() for kinds in every}


def stamp_file(part: str) -> Path | None:
    """Return the file that says that these kernels are compiled; None where nothing can be cached.

    Its name holds everything on which the compiled kernels depend: the versions, the processor and the sources.

    Args:
        part: of `PARTS`.
    """
    names = list(read_list()[part])
    place = getattr(getattr(resolve_name(names[0]), "_cache", None), "cache_path", None)
    if place is None:
        return None
    whole = blake2b(digest_size=8)
    files = sorted({PACKAGE.joinpath(*name.split(".")[1:-1]).with_suffix(".py") for name in names})
    states = [(file.name, file.stat().st_mtime_ns, file.stat().st_size) for file in files if file.exists()]
    versions = (numba.__version__, sys.version, numba.config.CPU_NAME or get_host_cpu_name())
    whole.update(repr((versions, LIST.read_bytes(), states)).encode())
    return Path(place) / f"compiled-{part}-{whole.hexdigest()}"


def used_kernels() -> dict[str, dict[str, list[list[Kind]]]]:
    """Return what this process has called so far, in order, as the list has it.

    In a process that found all kernels in the cache, these are the ones that were called from Python.
    """
    found: dict[str, dict[str, list[list[Kind]]]] = {part: {} for part in PARTS}
    for name, signature in ASKED_FOR:
        room = name.removeprefix("sfm_app.")
        part = next((part for part, rooms in ROOMS.items() if room.startswith(rooms)), "cameras")
        found[part].setdefault(name, []).append([describe(kind) for kind in signature])
    return found


def describe(kind: Any) -> Kind:
    """Return a type of numba as JSON.

    Args:
        kind: scalar, array or tuple.
    """
    if isinstance(kind, types.Array):
        return f"{kind.dtype.name}[{kind.ndim}{kind.layout}{'' if kind.mutable else '!'}]"
    if isinstance(kind, types.BaseNamedTuple):
        of = kind.instance_class
        return {f"{of.__module__}.{of.__qualname__}": [describe(part) for part in kind.types]}
    if isinstance(kind, types.BaseTuple):
        return [describe(part) for part in kind.types]
    return str(kind.name)


def make_type(kind: Kind) -> Any:
    """Return the type of numba that `describe` has described.

    Args:
        kind: as JSON.
    """
    if isinstance(kind, Mapping):
        ((name, parts),) = kind.items()
        return types.BaseTuple.from_types([make_type(part) for part in parts], resolve_name(name))
    if not isinstance(kind, str):
        return types.BaseTuple.from_types([make_type(part) for part in kind])
    if found := ARRAY.fullmatch(kind):
        dtype, dimensions, layout, fixed = found.groups()
        return types.Array(make_type(dtype), int(dimensions), layout, readonly=bool(fixed))
    return types.boolean if kind == "bool" else getattr(types, kind)


if __name__ == "__main__":
    watch_parent(int(sys.argv[2]), lambda: os._exit(1))
    if sys.argv[1] == "surface":
        yield_to_others(LATER)
    gc.disable()  # a sixth of the time; it ends before what it holds matters
    sys.exit(1 if compile_part(sys.argv[1]) else 0)
