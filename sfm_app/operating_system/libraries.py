"""Shared libraries that come with Python packages."""

import ctypes
from collections.abc import Iterator
from pathlib import Path

from sfm_app.operating_system.abilities import Ability, lacks


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


def load_libusb() -> None:
    """Load the libusb of a wheel, to which Open3D links; only on Linux the wheel is a dependency."""
    try:
        import libusb_package
    except ImportError:
        return
    if (path := libusb_package.get_library_path()) is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
