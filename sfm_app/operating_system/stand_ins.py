"""Stand-ins for libraries of screens and cameras that Open3D links to, where a Linux machine lacks them.

A server or a container has neither OpenGL nor X11, and Open3D, of which we only cast rays, cannot be imported without
them. A stand-in has their name and their functions, none of which is ever called; each would return 0.
"""

import ctypes
import itertools
import os
import struct
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

PREFIXES = {
    "libEGL.so.1": "egl",
    "libGL.so.1": "gl",
    "libX11.so.6": "X",
    "libidn2.so.0": "idn2_",
    "libudev.so.1": "udev_",
    "libusb-1.0.so.0": "libusb_",
}
"""How the functions of each library begin."""
VERSIONS = {"libidn2.so.0": "IDN2_0.0.0", "libudev.so.1": "LIBUDEV_183"}
"""The version that functions carry, in libraries that give them one."""
RETURN_0 = {62: bytes.fromhex("31c0c3"), 183: bytes.fromhex("000080d2c0035fd6")}
"""Machine code of a function that returns 0, by ELF's number of the processor: x86-64, ARM64."""
PAGE = 0x10000
"""The largest page of memory that these processors have."""
SECTION_DYNAMIC, SECTION_SYMBOLS = 6, 11
NEEDED, HASH, STRINGS, SYMBOLS, STRINGS_SIZE, SYMBOL_SIZE, OWN_NAME = 1, 4, 5, 6, 10, 11, 14
VERSION_OF_SYMBOLS, VERSION_NAMES, VERSION_COUNT = 0x6FFFFFF0, 0x6FFFFFFC, 0x6FFFFFFD
"""Entries of a dynamic section."""
VERSION, VERSION_NAME = struct.Struct("<HHHHIII"), struct.Struct("<II")
ENTRY, SYMBOL = struct.Struct("<QQ"), struct.Struct("<IBBHQQ")
HEADER, SEGMENT, SECTION = struct.Struct("<16sHHIQQQIHHHHHH"), struct.Struct("<IIQQQQQQ"), struct.Struct("<IIQQQQIIQQ")
FUNCTION = 0x12
"""A global symbol that is a function."""


def add_stand_ins(library: Path) -> list[str]:
    """Add a stand-in for every library that another one needs and this machine lacks; return their names.

    Other systems than Linux get none: wheels for them bring along what they need.

    Args:
        library: in ELF's format.
    """
    if sys.platform != "linux":
        return []
    processor, needed, undefined = read_needs(library)
    if processor not in RETURN_0:
        return []
    absent = [name for name in needed if name in PREFIXES and not _is_there(name)]
    for name in absent:
        functions = [symbol for symbol in undefined if symbol.startswith(PREFIXES[name])]
        _open(name, make_stand_in(name, functions, processor))
    return absent


def read_needs(library: Path) -> tuple[int, list[str], list[str]]:
    """Return the processor, the libraries and the functions that a library needs.

    Args:
        library: in ELF's format.
    """
    with library.open("rb") as file:

        def read(offset: int, size: int) -> bytes:
            file.seek(offset)
            return file.read(size)

        head = HEADER.unpack(read(0, HEADER.size))
        sections = list(SECTION.iter_unpack(read(head[6], head[12] * SECTION.size)))

        def tables(kind: int) -> tuple[bytes, bytes]:
            found = next(section for section in sections if section[1] == kind)
            strings = sections[found[6]]
            return read(found[4], found[5]), read(strings[4], strings[5])

        entries, names = tables(SECTION_DYNAMIC)
        symbols, symbol_names = tables(SECTION_SYMBOLS)
    needed = [_text(names, value) for tag, value in ENTRY.iter_unpack(entries) if tag == NEEDED]
    undefined = [_text(symbol_names, at) for at, _, _, section, *_ in SYMBOL.iter_unpack(symbols) if at and not section]
    return head[2], needed, undefined


def make_stand_in(name: str, functions: Sequence[str], processor: int) -> bytes:
    """Return a library in ELF's format whose functions return 0.

    Args:
        name: that it says it has, such as "libGL.so.1".
        functions: their names.
        processor: ELF's number for it.
    """
    version, code, count = VERSIONS.get(name, ""), RETURN_0[processor], len(functions) + 1
    names = (name, version, *functions)
    starts = list(itertools.accumulate((len(text.encode()) + 1 for text in names), initial=1))
    chain = [0, *range(2, count), 0][:count]  # one bucket: every symbol leads to the next
    at_code = HEADER.size + 4 * SEGMENT.size
    functions_at = (SYMBOL.pack(start, FUNCTION, 0, 1, at_code, len(code)) for start in starts[2:-1])
    parts = {
        0: code,
        SYMBOLS: SYMBOL.pack(0, 0, 0, 0, 0, 0) + b"".join(functions_at),
        HASH: struct.pack(f"<{count + 3}I", 1, count, min(1, len(functions)), *chain),
        STRINGS: b"\0" + b"\0".join(text.encode() for text in names) + b"\0",
    }
    values = {OWN_NAME: 1, STRINGS_SIZE: len(parts[STRINGS]), SYMBOL_SIZE: SYMBOL.size}
    if version:
        parts[VERSION_OF_SYMBOLS] = struct.pack(f"<{count}H", 0, *[2] * len(functions))
        parts[VERSION_NAMES] = _version(1, 1, name, starts[0], VERSION.size + VERSION_NAME.size)
        parts[VERSION_NAMES] += _version(0, 2, version, starts[1], 0)
        values[VERSION_COUNT] = 2
    body, places = _lay_out(parts, at_code)
    entries = {**values, **places} | {0: 0}  # 0 is the end
    dynamic = b"".join(ENTRY.pack(*entry) for entry in sorted(entries.items(), reverse=True))
    end = at_code + len(body)
    at_dynamic = end + -end % PAGE
    return (_head(processor, end, at_dynamic, len(dynamic)) + body).ljust(at_dynamic, b"\0") + dynamic


def _version(flags: int, number: int, name: str, at_name: int, step: int) -> bytes:
    """Return the entry of a version; the first one is the library's own name."""
    found = 0
    for letter in name.encode():  # ELF's hash
        found = (found << 4) + letter
        found = (found ^ ((found & 0xF0000000) >> 24)) & 0x0FFFFFFF
    return VERSION.pack(1, flags, number, 1, found, VERSION.size, step) + VERSION_NAME.pack(at_name, 0)


def _lay_out(parts: Mapping[int, bytes], start: int) -> tuple[bytes, dict[int, int]]:
    """Return parts one behind the other, and where each begins in the file."""
    body, places = b"", {}
    for key, part in parts.items():
        places[key] = start + len(body)
        body += part + b"\0" * (-len(part) % 16)
    return body, places


def _head(processor: int, end: int, at_dynamic: int, size: int) -> bytes:
    """Return the header and the segments: what is read and run, what is written to, and a stack that is not run."""
    load, dynamic, stack = 1, 2, 0x6474E551
    execute, write, read = 1, 2, 4
    kind = b"\x7fELF" + bytes((2, 1, 1)).ljust(12, b"\0")  # 64 bits, little endian
    header = HEADER.pack(kind, 3, processor, 1, 0, HEADER.size, 0, 0, HEADER.size, SEGMENT.size, 4, SECTION.size, 0, 0)
    segments = (
        (load, read | execute, 0, 0, 0, end, end, PAGE),
        (load, read | write, at_dynamic, at_dynamic, at_dynamic, size, size, PAGE),
        (dynamic, read | write, at_dynamic, at_dynamic, at_dynamic, size, size, 8),
        (stack, read | write, 0, 0, 0, 0, 0, 16),
    )
    return header + b"".join(SEGMENT.pack(*segment) for segment in segments)


def _text(names: bytes, at: int) -> str:
    return names[at : names.index(b"\0", at)].decode()


def _is_there(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def _open(name: str, library: bytes) -> None:
    """Let a library be found by those that need one of this name; it lies in memory, and nothing is written.

    Its file stays open: the system's loader knows libraries by their paths, and would take the next one for this one.
    """
    number = os.memfd_create(name)
    with os.fdopen(number, "wb", closefd=False) as file:
        file.write(library)
    ctypes.CDLL(f"/proc/self/fd/{number}")
