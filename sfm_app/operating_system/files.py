"""Links, and files that take the place of others."""

import contextlib
import os
import shutil
import stat
import time
from collections.abc import Callable
from pathlib import Path

from sfm_app.operating_system.abilities import Ability, lacks

WAITS_S = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Seconds between attempts at a file that another program looks at. Chosen by hand: virus scanners take less."""
PIECE_BYTES = 1_000_000
"""Bytes that are copied at once. Chosen by hand."""


def link_or_copy(place: Path, target: Path | str, source: Path) -> None:
    """Make a link to a file, or a copy of it where links cannot be made.

    A copy is no hard link: a program that writes into it must not change the file of the user.

    Args:
        place: where nothing is yet.
        target: what the link says.
        source: the file.

    Raises:
        OSError: neither can be written, or something is there.
    """
    if not lacks(Ability.LINKS):
        try:
            place.symlink_to(target)
        except FileExistsError:  # a copy would go through a link that is there, into what it leads to
            raise
        except OSError:  # Windows without the right to link, some network drives
            pass
        else:
            return
    with source.open("rb") as read, place.open("xb") as written:
        shutil.copyfileobj(read, written, PIECE_BYTES)


def share_bytes(source: Path, target: Path) -> None:
    """Make a file with the bytes of another, which they share where the system can. Neither is written to later.

    Args:
        source: the other file.
        target: in a folder that is there.

    Raises:
        OSError: it cannot be written.
    """
    if not lacks(Ability.HARD_LINKS):
        with contextlib.suppress(OSError):
            os.link(source, target)
            return
    shutil.copyfile(source, target)


def is_link(path: Path) -> bool:
    """Return whether a path leads elsewhere: a symbolic link, or a junction of Windows."""
    with contextlib.suppress(OSError, ValueError):
        found = path.lstat()
        junction = getattr(found, "st_reparse_tag", 0) == getattr(stat, "IO_REPARSE_TAG_MOUNT_POINT", -1)
        return stat.S_ISLNK(found.st_mode) or junction
    return False


def replace_file(source: Path, target: Path) -> None:
    """Put a file in the place of another, at once and as a whole.

    Args:
        source: on the same drive.
        target: replaced if it is there.

    Raises:
        OSError: the system refuses.
    """
    _insist(source.replace, target)


def move(source: Path, target: Path) -> None:
    """Give a file or a folder another place.

    Args:
        source: on the same drive.
        target: where nothing is.

    Raises:
        OSError: the system refuses.
    """
    _insist(source.rename, target)


def _insist(act: Callable[[Path], object], target: Path) -> None:
    """Do something to a file; where open files cannot be replaced, wait until whoever has it open is done."""
    for wait_s in WAITS_S if lacks(Ability.OPEN_FILES) else ():
        try:
            act(target)
        except PermissionError:
            time.sleep(wait_s)
        else:
            return
    act(target)
