"""Damage to the bytes of a file, by a seed: the same seed, the same damage."""

import re
from collections.abc import Callable

import numpy as np

Damage = Callable[[bytearray, np.random.Generator], bytes]

EXTREMES = tuple(
    value.to_bytes(size, order)
    for size in (2, 4, 8)
    for order in ("little", "big")
    for value in (0, 1, 2 ** (8 * size - 1) - 1, 2 ** (8 * size - 1), 2 ** (8 * size) - 1)
)


def flip_bits(data: bytearray, rng: np.random.Generator) -> bytes:
    for at in rng.integers(0, len(data), rng.integers(1, 20)):
        data[at] ^= 1 << int(rng.integers(8))
    return bytes(data)


def flip_bits_of_the_head(data: bytearray, rng: np.random.Generator) -> bytes:
    for at in rng.integers(0, min(len(data), 200), rng.integers(1, 6)):
        data[at] ^= 1 << int(rng.integers(8))
    return bytes(data)


def replace_run(data: bytearray, rng: np.random.Generator) -> bytes:
    start, stop = _span(data, rng)
    filling = rng.choice(["noise", "zeros", "ones"])
    new = rng.bytes(stop - start) if filling == "noise" else (b"\0" if filling == "zeros" else b"\xff") * (stop - start)
    return bytes(data[:start]) + new + bytes(data[stop:])


def cut(data: bytearray, rng: np.random.Generator) -> bytes:
    return bytes(data[: rng.integers(0, len(data))])


def remove_run(data: bytearray, rng: np.random.Generator) -> bytes:
    start, stop = _span(data, rng)
    return bytes(data[:start] + data[stop:])


def insert(data: bytearray, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(0, len(data)))
    return bytes(data[:at]) + rng.bytes(int(rng.integers(1, 300))) + bytes(data[at:])


def swap_halves(data: bytearray, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(1, len(data)))
    return bytes(data[at:] + data[:at])


def repeat_run(data: bytearray, rng: np.random.Generator) -> bytes:
    start, stop = _span(data, rng)
    return bytes(data[:stop] + data[start:])


def extreme_number(data: bytearray, rng: np.random.Generator) -> bytes:
    """Where sizes, counts and offsets stand most often: near the start."""
    value = EXTREMES[int(rng.integers(len(EXTREMES)))]
    at = int(rng.integers(0, min(len(data), 400)))
    data[at : at + len(value)] = value
    return bytes(data)


ANYTHING: tuple[Damage, ...] = (
    flip_bits, flip_bits_of_the_head, replace_run, cut, remove_run, insert, swap_halves, repeat_run, extreme_number,
)  # fmt: skip


def jpeg_segments(data: bytearray, rng: np.random.Generator) -> bytes:
    """A segment of a JPEG file twice, gone, elsewhere, or with another length."""
    starts = [found.start() for found in re.finditer(rb"\xff[\xc0-\xfe]", bytes(data))]
    first, second = sorted(rng.choice(starts, 2))
    segment = data[first:second]
    kind = int(rng.integers(4))
    if kind == 0:
        return bytes(data[:second] + segment + data[second:])
    if kind == 1:
        return bytes(data[:first] + data[second:])
    if kind == 2:
        at = int(rng.choice(starts))
        return bytes(data[:at] + segment + data[at:])
    data[first + 2 : first + 4] = rng.bytes(2)
    return bytes(data)


def exif_block(data: bytearray, rng: np.random.Generator) -> bytes:
    """Bytes of the EXIF block, wherever the format has it."""
    found = re.search(rb"II\x2a\0|MM\0\x2a", bytes(data))
    start = found.start() if found else 0
    for at in start + rng.integers(0, min(300, len(data) - start), rng.integers(1, 12)):
        data[at] = int(rng.integers(256))
    return bytes(data)


def text_values(data: bytearray, rng: np.random.Generator) -> bytes:
    """Another value, of another type or out of all bounds, for one in a JSON or TOML text."""
    values = list(re.finditer(rb'"[^"\n]*"|-?\d[\d.e+-]*|true|false|null', bytes(data)))
    if not values:
        return bytes(data)
    span = values[int(rng.integers(len(values)))].span()
    return bytes(data[: span[0]]) + ODD_VALUES[int(rng.integers(len(ODD_VALUES)))] + bytes(data[span[1] :])


ODD_VALUES = (
    b"null", b"true", b"-1", b"0", b"1e999", b"-1e308", b"NaN", b"Infinity", b"1" * 5000, b'"' + b"x" * 70_000 + b'"',
    b"[]", b"{}", b'""', b'"../../x"', b'"/etc/passwd"', b'"\\u0000"', b'"\\ud800"', b"[" * 3000 + b"]" * 3000,
    b'{"a": ' * 3000 + b"1" + b"}" * 3000, b"2024-02-30", b"0.5", b'"a\\nb"', b"9223372036854775808",
)  # fmt: skip


def damaged(data: bytes, seed: int, kinds: tuple[Damage, ...] = ANYTHING) -> tuple[bytes, str]:
    """The bytes after one to three kinds of damage, and how to get them again."""
    rng = np.random.default_rng(seed)
    chosen = [kinds[int(k)] for k in rng.integers(0, len(kinds), rng.integers(1, 4))]
    for damage in chosen:
        data = damage(bytearray(data), rng) if len(data) > 4 else data
    return data, f"seed {seed}: {', '.join(damage.__name__ for damage in chosen)}"


def _span(data: bytearray, rng: np.random.Generator) -> tuple[int, int]:
    start = int(rng.integers(0, len(data)))
    return start, min(len(data), start + int(rng.integers(1, 400)))
