"""Compile numeric kernels to machine code, in each process or ahead in a process beside the first run.

Kernels release the GIL, so pairs run in parallel threads. Their machine code is cached beside the source, so that only
the first run on a machine compiles.
"""

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from llvmlite.binding import get_host_cpu_name

from sfm_app.operating_system import end_group, group_options

Function = TypeVar("Function", bound=Callable[..., Any])

HERE, HOME = Path(__file__).parent, Path(os.path.expanduser("~/.cache/sfm-app"))  # noqa: PTH111 - there may be no home
CACHE = Path(
    numba.config.CACHE_DIR or (HERE / "__pycache__" if os.access(HERE, os.W_OK) else HOME),
    f"kernels-{version('sfm-app')}",
)
"""Folder of the compiled kernels of this version. Numba does not check the files of kernels that a kernel calls, and
cannot read references to removed classes: without a folder per version, an upgrade would fail, or run old code."""
WARM = CACHE / f"warm-{numba.__version__}-{numba.config.CPU_NAME or get_host_cpu_name()}"
"""Exists when all kernels of a run are compiled for this processor."""
PARENT = "SFM_APP_WARM_UP_OF"
"""Environment variable of the compiling process: the number of the process of the run."""


def kernel(function: Function) -> Function:
    """Compile a function with numba: nogil, cached on disk, IEEE arithmetic (same seed, same bytes)."""
    return _compile(function, fastmath=False)


def inlined_kernel(function: Function) -> Function:
    """Compile a kernel into each kernel that calls it, where constant arguments remove branches."""
    return _compile(function, fastmath=False, forceinline=True)


def summing_kernel(function: Function) -> Function:
    """Compile a kernel whose sums may be vectorized: several times faster, the same bytes on one kind of processor.

    Nothing else is relaxed: there are no assumptions about infinities or NaN, and no approximate division. It is
    inlined into kernels that call it: otherwise the process that compiles it would add in another order.
    """
    return _compile(function, fastmath={"reassoc", "nsz"}, forceinline=True)


def _compile(function: Function, **options: Any) -> Function:
    options |= {"nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(CACHE)
    try:
        return cast(Function, numba.njit(cache=True, **options)(function))
    except RuntimeError:  # no folder for the cache is writable: compile in every process
        return cast(Function, numba.njit(**options)(function))
    finally:
        numba.config.CACHE_DIR = before


@contextlib.contextmanager
def warming_up(say: Callable[[str], None], warm: Path = WARM) -> Iterator[None]:
    """Compile all kernels in another process during the block, which does not wait, unless `warm` exists."""
    if warm.exists() or PARENT in os.environ:
        yield
        return
    say("first run on this machine: compiling parts of the program takes half a minute more, once")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        command = [sys.executable, "-P", "-m", "sfm_app.warm_up", folder]
        environment, quiet = os.environ | {PARENT: str(os.getpid())}, subprocess.DEVNULL
        process = subprocess.Popen(  # noqa: S603 - our module
            command, env=environment, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, **group_options()
        )
        try:
            yield
        finally:
            end_group(process, 10.0)
            process.communicate()
