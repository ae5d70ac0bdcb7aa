"""What has to be the same on all machines, so that the same seed gives the same bytes."""

import hashlib
import platform
from collections.abc import Mapping
from functools import cache
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path

LIBRARIES = (
    "sfm-app", "numpy", "scipy", "numba", "opencv-contrib-python-headless", "open3d", "open3d-cpu", "pillow",
    "pycolmap", "dask", "distributed",
)  # fmt: skip
"""Packages that compute results, or that the machines talk through."""
PROCESSOR = "processor"
"""Name of the one entry that may differ: results then agree as numbers, but not byte by byte."""


@cache
def worker_versions() -> dict[str, str]:
    """Return the versions of Python, of the program and its plug-ins, of libraries, and the kind of processor."""
    plugins = {point.dist.name: point.dist.version for point in entry_points(group="sfm_app") if point.dist}
    return {
        "python": ".".join(platform.python_version_tuple()[:2]),
        **{name: _version(name) for name in LIBRARIES},
        **{name: found for name, found in sorted(plugins.items()) if name != "sfm-app"},
        "the program's files": _digest_program(),
        PROCESSOR: _processor(),
    }


def differences(ours: Mapping[str, str], theirs: Mapping[str, str]) -> list[str]:
    """Return what differs between two machines, as texts such as "numpy 2.1 instead of 2.0"; the processor may.

    Args:
        ours: versions of this machine.
        theirs: versions of a worker.
    """
    names = [name for name in {**ours, **theirs} if name != PROCESSOR and ours.get(name) != theirs.get(name)]
    return [f"{name} {theirs.get(name, 'missing')} instead of {ours.get(name, 'none')}" for name in names]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


def _digest_program() -> str:
    """Return a hash of the program's source, which two checkouts of the same version may differ in."""
    found, root = hashlib.blake2b(digest_size=6), Path(__file__).parents[2]
    for path in sorted(root.rglob("*.py")):
        found.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return found.hexdigest()


def _processor() -> str:
    import llvmlite.binding  # numba's: the kind for which kernels are compiled

    return str(llvmlite.binding.get_host_cpu_name())
