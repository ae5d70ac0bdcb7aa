"""Collect libtiff's errors, which it would print while returning a damaged picture; Pillow does not check them."""

import ctypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import PIL

PLACES = (Path(PIL.__file__).parents[1] / "pillow.libs", Path(PIL.__file__).parent / ".dylibs")
"""Where Pillow's wheels keep their own libtiff on Linux and macOS."""
HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p)
"""Type of libtiff's error callback: module, format and arguments of a message."""

_heard = threading.local()


@contextmanager
def complaints() -> Iterator[list[str]]:
    """Provide a list that collects libtiff's errors while this thread decodes.

    It stays empty if Pillow has no libtiff of its own.
    """
    _listen()
    _heard.errors = []
    try:
        yield _heard.errors
    finally:
        del _heard.errors


def _note(_module: Any, text: bytes | None, _arguments: Any) -> None:
    getattr(_heard, "errors", []).append((text or b"").decode(errors="replace"))


NOTE = HANDLER(_note)
"""Kept here, because libtiff keeps only its address."""


@cache
def _listen() -> None:
    for library in (file for place in PLACES for file in place.glob("libtiff*")):
        set_handler = ctypes.CDLL(str(library)).TIFFSetErrorHandler
        set_handler.argtypes, set_handler.restype = [HANDLER], ctypes.c_void_p
        set_handler(NOTE)
