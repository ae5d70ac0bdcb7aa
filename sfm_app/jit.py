"""The one place that says how numeric kernels become machine code.

Kernels release the GIL, so pairs run in parallel threads, and their machine code is cached beside the source, so
only the first run on a machine compiles.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a function with numba: nogil, cached on disk, IEEE arithmetic (same seed, same bytes)."""
    try:
        compiled: Function = numba.njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # no folder to cache in can be written: compile anew in every process
        compiled = numba.njit(nogil=True, error_model="numpy")(function)
    return compiled
