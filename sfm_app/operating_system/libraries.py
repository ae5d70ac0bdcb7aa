"""Shared libraries that come with Python packages."""

import ctypes
import importlib
from collections.abc import Iterator
from pathlib import Path

from sfm_app.operating_system.abilities import Ability, lacks


def load_for_others(package: str) -> None:
    """Load the library that a package brings, for others that expect it on the system and would not find it there.

    Args:
        package: has `get_library_path`.
    """
    if lacks(Ability.GLOBAL_LIBRARIES):  # wheels for other systems bring along what they need
        return
    library = importlib.import_module(package).get_library_path()
    if library is not None:
        ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)


def find_in_wheel(package: Path, project: str, name: str) -> Iterator[ctypes.CDLL]:
    """Yield the libraries of that name which the wheel of a package keeps; none where they are part of its modules.

    Args:
        package: folder of the package, as installed.
        project: its name in the registry.
        name: beginning of the file names.
    """
    if lacks(Ability.WHEEL_LIBRARIES):
        return
    for folder in (package.parent / f"{project}.libs", package / ".dylibs"):  # Linux, macOS
        for file in folder.glob(f"{name}*"):
            yield ctypes.CDLL(str(file))
