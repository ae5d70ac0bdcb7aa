"""State of this machine and of the installed libraries."""

import platform
import shutil
from collections.abc import Callable
from pathlib import Path

from sfm_app.colmap.backend import has_cuda
from sfm_app.engine.stage import versions
from sfm_app.errors import SfmError
from sfm_app.meshing.ray_casting import load_open3d
from sfm_app.operating_system import free_memory_mb, missing_abilities
from sfm_app.plugins import load_plugins
from sfm_app.runtime.parallel import worker_count

GIGABYTE, MB_PER_GB = 2**30, 2**30 / 1e6
ENOUGH_DISK = 2 * GIGABYTE


def examine() -> dict[str, str]:
    """Return the state of the machine and of the installed libraries, one line each."""
    disk = shutil.disk_usage(Path.cwd()).free
    return {
        "python": f"{platform.python_version()} on {platform.system()} {platform.machine()}",
        "cores": str(worker_count(0)),
        "memory": f"{free_memory_mb() / MB_PER_GB:.0f} GB free",
        "free disk here": f"{disk / GIGABYTE:.0f} GB"
        + ("" if disk > ENOUGH_DISK else "; low: dense stereo needs about 2 GB"),
        "missing in this system": ", ".join(missing_abilities()) or "nothing",
        **versions(),
        "COLMAP with CUDA": "yes" if has_cuda() else "no",
        "depth maps": _try(_depth_method),
        "ray casting (Open3D)": _try(lambda: f"works, {load_open3d().__version__}"),
        "plug-ins": _try(_count_methods),
    }


def _try(examine_part: Callable[[], str]) -> str:
    try:
        return examine_part()
    except SfmError as err:
        return f"broken: {err}; {err.hint}"


def _depth_method() -> str:
    method, reason = load_plugins().depth_method("auto")
    return f"{method.name} ({reason})"


def _count_methods() -> str:
    methods = load_plugins()
    parts = {
        "feature methods": methods.features,
        "estimators": methods.estimators,
        "calibrators": methods.calibrators,
        "formats": {**methods.exporters, **methods.scene_exporters},
        "depth methods": methods.depth_methods,
    }
    return ", ".join(f"{len(part)} {name}" for name, part in parts.items())
