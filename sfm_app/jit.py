"""How numeric kernels are compiled to machine code, in one place.

Kernels release the GIL, so pairs run in parallel threads, and their machine code is cached beside the source, so
only the first run on a machine compiles.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a function with numba: nogil, cached on disk, IEEE arithmetic (same seed, same bytes)."""
    return _compile(function, fastmath=False)


def summing_kernel(function: Function) -> Function:
    """Compile a kernel whose sums may be vectorized: several times faster, the same bytes on one kind of processor.

    Nothing else is relaxed: there are no assumptions about infinities or NaN, and no approximate division.
    """
    return _compile(function, fastmath={"reassoc", "nsz"})


def _compile(function: Function, *, fastmath: bool | set[str]) -> Function:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": fastmath, "no_cfunc_wrapper": True}
    try:
        compiled: Function = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder for the cache is writable: compile in every process
        return cast(Function, numba.njit(**options)(function))
    _forget_unreadable_cache(compiled)
    return compiled


def _forget_unreadable_cache(compiled: Any) -> None:
    """Let a kernel be recompiled where its cache refers to classes that no longer exist, as after an upgrade."""
    cache_file = compiled._cache._cache_file
    load = cache_file._load_index

    def load_or_forget() -> dict[Any, Any]:
        try:
            return cast("dict[Any, Any]", load())
        except (AttributeError, ImportError):
            return {}

    cache_file._load_index = load_or_forget
