"""Collect libtiff's errors, which it would print while returning a damaged picture; Pillow does not check them."""

import ctypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import PIL

from sfm_app.operating_system import find_in_wheel

HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p)
"""Type of libtiff's error callback: module, format and arguments of a message."""

_thread_errors = threading.local()


@contextmanager
def libtiff_errors() -> Iterator[list[str]]:
    """Provide a list that collects libtiff's errors while this thread decodes.

    It stays empty if Pillow's libtiff is no library of its own, as on Windows: what Pillow itself notices is still an
    error, but damage after which libtiff goes on decoding is not noticed.
    """
    _install_handler()
    _thread_errors.errors = []
    try:
        yield _thread_errors.errors
    finally:
        del _thread_errors.errors


def _record_error(_module: Any, text: bytes | None, _arguments: Any) -> None:
    getattr(_thread_errors, "errors", []).append((text or b"").decode(errors="replace"))


ERROR_CALLBACK = HANDLER(_record_error)
"""Kept here, because libtiff keeps only its address."""


@cache
def _install_handler() -> None:
    for library in find_in_wheel(Path(PIL.__file__).parent, "pillow", "libtiff"):
        set_handler = library.TIFFSetErrorHandler
        set_handler.argtypes, set_handler.restype = [HANDLER], ctypes.c_void_p
        set_handler(ERROR_CALLBACK)
