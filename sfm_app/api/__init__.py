"""The public functions: whole runs, what is done with finished ones, and the estimators alone."""

from sfm_app.api.estimators import calibrate_fundamentals, estimate_fundamental, estimate_lens
from sfm_app.api.finished_runs import export_model, export_scene, measure_distance, view_run, write_report
from sfm_app.api.run import PathLike, Run, RunScene, open_run
from sfm_app.api.runs import calibrate_photos, read_run, reconstruct

__all__ = [
    "PathLike",
    "Run",
    "RunScene",
    "calibrate_fundamentals",
    "calibrate_photos",
    "estimate_fundamental",
    "estimate_lens",
    "export_model",
    "export_scene",
    "measure_distance",
    "open_run",
    "read_run",
    "reconstruct",
    "view_run",
    "write_report",
]
