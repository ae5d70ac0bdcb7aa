"""What libtiff finds wrong with a file: it would print it and leave the picture as it is, and Pillow does not ask."""

import ctypes
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import PIL

PLACES = (Path(PIL.__file__).parents[1] / "pillow.libs", Path(PIL.__file__).parent / ".dylibs")
"""Where Pillow's wheels have their own libtiff, on Linux and on macOS."""
HANDLER = ctypes.CFUNCTYPE(None, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_void_p)
"""Module, format and arguments of a message."""

_heard = threading.local()


@contextmanager
def complaints() -> Iterator[list[str]]:
    """Provide a list that takes what libtiff calls an error while this thread decodes.

    Nothing where Pillow has no own copy.
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
