"""Import of Open3D, which is slow, logs much, and needs a library that minimal Linux systems lack."""

import functools
import importlib
from typing import Any

from sfm_app.operating_system import load_for_others


@functools.cache
def load_open3d() -> Any:
    """Import Open3D, with little logging and with the libusb that its wheel expects on the system.

    Call it inside the functions that need Open3D: the import takes more than a second.
    """
    load_for_others("libusb_package")  # Open3D links to libusb-1.0.so.0; one that is already loaded is used
    open3d = importlib.import_module("open3d")
    open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
    return open3d
