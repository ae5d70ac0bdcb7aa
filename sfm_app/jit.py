"""Compilation of numeric kernels to machine code.

Kernels release the GIL, so pairs run in parallel threads. Their machine code is cached beside the source, so only the
first run on a machine compiles.
"""

import os
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from llvmlite.binding import get_host_cpu_name

Function = TypeVar("Function", bound=Callable[..., Any])

HERE, HOME = Path(__file__).parent, Path(os.path.expanduser("~/.cache/sfm-app"))  # noqa: PTH111 - there may be no home
CACHE = Path(
    numba.config.CACHE_DIR or (HERE / "__pycache__" if os.access(HERE, os.W_OK) else HOME),
    f"kernels-{version('sfm-app')}",
)
"""Folder of the compiled kernels of this version. Numba checks the file of a kernel, but not of kernels that it calls,
and fails on references to removed classes: an upgrade would fail, or run old code."""
WARM = CACHE / f"warm-{numba.__version__}-{numba.config.CPU_NAME or get_host_cpu_name()}"
"""Exists after the kernels of a run are compiled for this processor, see `engine.warm_up`."""


def kernel(function: Function) -> Function:
    """Compile a function with numba: nogil, cached on disk, IEEE arithmetic (same seed, same bytes)."""
    return _compile(function, fastmath=False)


def summing_kernel(function: Function) -> Function:
    """Compile a kernel with vectorized sums: several times faster, the same bytes on one kind of processor.

    Infinities, NaN and division stay exact.
    """
    return _compile(function, fastmath={"reassoc", "nsz"})


def _compile(function: Function, *, fastmath: bool | set[str]) -> Function:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": fastmath, "no_cfunc_wrapper": True}
    before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(CACHE)
    try:
        return cast(Function, numba.njit(cache=True, **options)(function))
    except RuntimeError:  # no folder for the cache is writable: compile in every process
        return cast(Function, numba.njit(**options)(function))
    finally:
        numba.config.CACHE_DIR = before
