"""Recognize videos by their first bytes, not by their names; playlists are not videos."""

from pathlib import Path

ENDINGS = (".mp4", ".m4v", ".mov", ".mkv", ".webm", ".avi", ".mpg", ".mpeg", ".ts", ".mts", ".m2ts", ".3gp")
"""Extensions of videos; used only to word error messages."""
HEAD_BYTES = 400
"""Enough for three packets of an MPEG transport stream."""
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1")
AVIF_BRANDS = (b"avif", b"avis")
OTHER_BRANDS = (*HEIC_BRANDS, *AVIF_BRANDS, b"crx ", b"M4A ", b"M4B ", b"M4P ")
"""Photos and sound in the container of MP4."""
ATOMS = (b"moov", b"mdat", b"wide", b"free", b"skip")
"""First atoms of QuickTime files without a brand."""


def read_head(path: Path) -> bytes:
    """Return the first bytes of a regular file; empty if it cannot be read."""
    try:
        if not path.is_file():  # reading a pipe would never end
            return b""
        with path.open("rb") as file:
            return file.read(HEAD_BYTES)
    except OSError:
        return b""


def is_video(head: bytes) -> bool:
    """Return whether a file begins like MP4, QuickTime, Matroska, WebM, AVI or MPEG."""
    if head[4:8] == b"ftyp":
        return head[8:12] not in OTHER_BRANDS
    return (
        head[4:8] in ATOMS
        or head[:4] == b"\x1a\x45\xdf\xa3"
        or (head[:4] == b"RIFF" and head[8:12] == b"AVI ")
        or head[:4] == b"\0\0\x01\xba"
        or _has_packets(head, first=0, length=188)
        or _has_packets(head, first=4, length=192)
    )


def _has_packets(head: bytes, first: int, length: int) -> bool:
    """Return whether the sync bytes of an MPEG transport stream are in place."""
    return len(head) == HEAD_BYTES and all(head[k] == 0x47 for k in range(first, HEAD_BYTES, length))
