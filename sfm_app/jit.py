"""How numeric kernels are compiled to machine code, in one place.

Kernels release the GIL, so pairs run in parallel threads, and their machine code is cached beside the source, so
only the first run on a machine compiles.
"""

import threading
import time
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., Any])

ASKED_FOR: dict[tuple[str, tuple[Any, ...]], None] = {}
"""Full names of the kernels that this process has looked for, with the types of their arguments, in order."""
POLL_S = 0.05
"""Seconds between two looks for a kernel that another process compiles. Chosen by hand."""

IsAwaited = Callable[[str, Any], bool]
"""Says of the name of a kernel and the types of its arguments whether another process is about to compile it."""


def kernel(function: Function) -> Function:
    """Compile a function with numba: nogil, cached on disk, IEEE arithmetic (same seed, same bytes)."""
    return _compile(function, fastmath=False)


def summing_kernel(function: Function) -> Function:
    """Compile a kernel whose sums may be vectorized: several times faster, the same bytes on one kind of processor.

    Nothing else is relaxed: there are no assumptions about infinities or NaN, and no approximate division.
    """
    return _compile(function, fastmath={"reassoc", "nsz"})


def wait_where(is_awaited: IsAwaited | None) -> None:
    """Let kernels be waited for where another process is about to compile them.

    Args:
        is_awaited: asked again and again while a kernel is not in the cache, and may raise; None for not waiting any
            more.
    """
    _Waiting.is_awaited = is_awaited


def is_waiting() -> bool:
    """Return whether a thread of this process waits for a kernel that another process compiles."""
    return bool(_Waiting.threads)


class _Waiting:
    is_awaited: IsAwaited | None = None
    threads: ClassVar[set[int]] = set()
    """Those that wait now."""


def _compile(function: Function, *, fastmath: bool | set[str]) -> Function:
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": fastmath, "no_cfunc_wrapper": True}
    try:
        compiled: Function = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # no folder for the cache is writable: compile in every process
        return cast(Function, numba.njit(**options)(function))
    name = f"{function.__module__}.{function.__qualname__}"
    _forget_unreadable_cache(compiled)
    _wait_for_others(name, compiled)
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


def _wait_for_others(name: str, compiled: Any) -> None:
    """Let a kernel be read from the cache as soon as another process has compiled it."""
    load = compiled._cache.load_overload

    def load_or_wait(signature: Any, target: Any) -> Any:
        ASKED_FOR[name, tuple(signature)] = None
        found, ask = load(signature, target), _Waiting.is_awaited
        if found is not None or ask is None:
            return found
        _Waiting.threads.add(threading.get_ident())
        try:
            while found is None and ask(name, signature):
                time.sleep(POLL_S)
                found = load(signature, target)
        finally:
            _Waiting.threads.discard(threading.get_ident())
        return found

    compiled._cache.load_overload = load_or_wait
