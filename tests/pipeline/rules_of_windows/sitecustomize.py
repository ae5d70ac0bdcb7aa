"""Note what Windows would refuse, in every Python that is started with this folder on its path (Linux only).

There, nothing is removed, replaced or moved that a process has open or mapped, nor a folder around it, and nothing is
moved to where something is. OUT and the file for the notes are named by the environment.
"""

import os
import traceback
from pathlib import Path

OUT, NOTES = os.environ.get("RULES_OUT", ""), os.environ.get("RULES_NOTES", "")


def holders(place):
    """What processes that know OUT hold of a file, or of what is in a folder: "PROCESS PATH"."""
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if f"RULES_OUT={OUT}".encode() not in (process / "environ").read_bytes():
                continue
            held = [str(link.readlink()) for link in (process / "fd").iterdir() if link.exists()]
            held += [line.split(maxsplit=5)[5] for line in (process / "maps").read_text().splitlines() if OUT in line]
        except OSError:  # it has ended meanwhile
            continue
        for path in held:
            if (path == place or path.startswith(f"{place}/")) and not os.path.isdir(path):  # noqa: PTH112
                yield f"{process.name} {path}"


def full(path, folder):
    """A path without links on the way to it, from the folder that a descriptor stands for."""
    start = str(Path(f"/proc/self/fd/{folder}").readlink()) if folder is not None else ""
    head, name = os.path.split(os.path.join(start, os.fsdecode(path)))  # noqa: PTH118
    return os.path.join(os.path.realpath(head), name)  # noqa: PTH118


def watch(act):
    """A function of `os` that notes what it should not have been asked for."""

    def watched(path, *others, dir_fd=None, **options):
        places = [full(path, dir_fd), *(full(other, None) for other in others)]
        refused = [holder for place in places if place.startswith(OUT) for holder in holders(place)]
        if act.__name__ == "rename" and os.path.lexists(places[1]):
            refused.append(f"{places[1]} is there")
        if refused:
            with Path(NOTES).open("a", encoding="utf-8") as file:
                file.write(f"{act.__name__} {places}: {refused}\n{''.join(traceback.format_stack(limit=8))}\n")
        given = options if dir_fd is None else {**options, "dir_fd": dir_fd}
        return act(path, *others, **given)

    return watched


if OUT:
    for name in ("unlink", "remove", "rename", "replace"):
        setattr(os, name, watch(getattr(os, name)))
