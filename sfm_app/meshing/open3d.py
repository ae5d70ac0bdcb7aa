"""Import of Open3D, which is slow, logs much, and needs libraries that minimal Linux systems lack."""

import functools
import importlib
import importlib.util
from pathlib import Path
from typing import Any

from sfm_app.operating_system import add_stand_ins

LINKED = ("libOpen3D.so*", "cpu/pybind*.so")
"""The files of Open3D's wheel for Linux that link to the system's libraries: from 0.20 on, and before."""


@functools.cache
def load_open3d() -> Any:
    """Import Open3D, with little logging and without the screens and cameras that its wheel expects on the system.

    Call it inside the functions that need Open3D: the import takes more than a second.
    """
    for library in _linked_files():
        add_stand_ins(library)
    open3d = importlib.import_module("open3d")
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def _linked_files() -> list[Path]:
    spec = importlib.util.find_spec("open3d")
    folder = Path(spec.origin).parent if spec is not None and spec.origin else None
    return [] if folder is None else [path for pattern in LINKED for path in sorted(folder.glob(pattern))]
