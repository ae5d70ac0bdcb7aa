"""Import of Open3D, which is slow, logs much, and needs libraries that minimal Linux systems lack."""

import functools
import importlib
import re
from typing import Any

from sfm_app.errors import SfmError
from sfm_app.operating_system import load_libusb

PACKAGES = {
    "libEGL.so.1": "libegl1",
    "libGL.so.1": "libgl1",
    "libX11.so.6": "libx11-6",
    "libgomp.so.1": "libgomp1",
    "libidn2.so.0": "libidn2-0",
    "libudev.so.1": "libudev1",
    "libusb-1.0.so.0": "libusb-1.0-0",
}
"""Packages of Debian and Ubuntu that have the libraries to which Open3D's wheels for Linux link."""


@functools.cache
def load_open3d() -> Any:
    """Import Open3D, with little logging.

    Call it inside the functions that need Open3D: the import takes more than a second.

    Raises:
        SfmError: the system lacks a library.
    """
    load_libusb()
    try:
        open3d = importlib.import_module("open3d")
    except (ImportError, OSError) as err:
        raise SfmError(f"Open3D cannot be loaded: {err}", hint=_hint(str(err))) from err
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d


def _hint(message: str) -> str:
    missing = re.search(r"(lib\S+\.so[.\d]*): cannot open", message)
    packages = [PACKAGES[missing[1]]] if missing and missing[1] in PACKAGES else sorted(PACKAGES.values())
    return f"on Debian and Ubuntu: apt-get install {' '.join(packages)}"
