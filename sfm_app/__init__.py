"""Reconstruct a 3D model from a folder of uncalibrated photos.

run = sfm_app.reconstruct("photos/", "out/", progress=print)
run = sfm_app.read_run("out/")
points, poses = run.scene.arrays.points, run.scene.arrays.cam_from_world
cal = sfm_app.calibrate_photos("photos/")
sfm_app.export_model("out/", "obj")
sfm_app.export_scene("out/", "colmap")
sfm_app.write_report("out/")
sfm_app.measure_distance("out/", (0, 0, 0), (1, 0, 0))
sfm_app.measure_volume("out/", [(0, 0, 0), (1, 0, 0), (1, 0, 1)])
sfm_app.view_run("out/")
fit = sfm_app.estimate_fundamental(x1, x2)
cal = sfm_app.calibrate_fundamentals(Fs, (width, height))
lens = sfm_app.estimate_lens(matches, (width, height))
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from sfm_app.errors import BackendError, ConfigError, InputError, PluginError, ReconstructionError, SfmError
from sfm_app.progress import Step
from sfm_app.types import Calibration, EpipolarFit, Intrinsics, Rejected, SceneArrays

if TYPE_CHECKING:
    from sfm_app.api import (
        Run,
        calibrate_fundamentals,
        calibrate_photos,
        estimate_fundamental,
        estimate_lens,
        export_model,
        export_scene,
        measure_distance,
        measure_volume,
        read_run,
        reconstruct,
        view_run,
        write_report,
    )
    from sfm_app.settings import Settings

__version__ = version("sfm-app")

__all__ = [
    "BackendError",
    "Calibration",
    "ConfigError",
    "EpipolarFit",
    "InputError",
    "Intrinsics",
    "PluginError",
    "ReconstructionError",
    "Rejected",
    "Run",
    "SceneArrays",
    "Settings",
    "SfmError",
    "Step",
    "__version__",
    "calibrate_fundamentals",
    "calibrate_photos",
    "estimate_fundamental",
    "estimate_lens",
    "export_model",
    "export_scene",
    "measure_distance",
    "measure_volume",
    "read_run",
    "reconstruct",
    "view_run",
    "write_report",
]


def __getattr__(name: str) -> Any:
    """Return a public function, loaded when it is first asked for: COLMAP's processes save the second that it takes."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module("sfm_app.settings" if name == "Settings" else "sfm_app.api")
    return getattr(module, name)


def __dir__() -> list[str]:
    """List the public names, loaded or not."""
    return __all__
