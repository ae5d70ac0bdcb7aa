"""Names of files that every program can read."""

import re
from collections.abc import Sequence

UNSAFE = re.compile(r"[^A-Za-z0-9-]+")
"""What trainers stumble over: they cut names at the first dot or blank, drop folders, or read bytes one by one."""


def plain_names(names: Sequence[str]) -> list[str]:
    """Return one name for each, of letters, digits, - and _, all different even where case does not count.

    Args:
        names: of photos with their folders, but without suffix, or of cameras.
    """
    used, found = set[str](), []
    for name in names:
        plain = stem = UNSAFE.sub("_", name).strip("_") or "_"
        number = 1
        while plain.lower() in used:
            number += 1
            plain = f"{stem}_{number}"
        used.add(plain.lower())
        found.append(plain)
    return found
