"""Reconstruct a 3D model from a folder of uncalibrated photos.

run = sfm_app.reconstruct("photos/", "out/")
cal = sfm_app.calibrate_photos("photos/")
sfm_app.export_model("out/", "obj")
fit = sfm_app.estimate_fundamental(x1, x2)
cal = sfm_app.calibrate_fundamentals(Fs, (width, height))
lens = sfm_app.estimate_lens(matches, (width, height))
"""

from importlib.metadata import version

from sfm_app.api import (
    Run,
    calibrate_fundamentals,
    calibrate_photos,
    estimate_fundamental,
    estimate_lens,
    export_model,
    reconstruct,
)
from sfm_app.errors import BackendError, ConfigError, InputError, PluginError, ReconstructionError, SfmError
from sfm_app.settings import Settings
from sfm_app.types import Calibration, EpipolarFit, Intrinsics, Rejected

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
    "Settings",
    "SfmError",
    "__version__",
    "calibrate_fundamentals",
    "calibrate_photos",
    "estimate_fundamental",
    "estimate_lens",
    "export_model",
    "reconstruct",
]
