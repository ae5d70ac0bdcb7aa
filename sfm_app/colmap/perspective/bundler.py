"""Bundler's file, which COLMAP writes along with undistorted photos for PMVS."""

import shutil
from pathlib import Path

from sfm_app.colmap.processes.worker_process import UndistortTask, run_worker
from sfm_app.operating_system import replace_file
from sfm_app.progress import Progress

BUNDLE = "pmvs/bundle.rd.out"
ANY_SIZE = -1
"""COLMAP's number for photos of any size."""


def write_bundle(model_dir: Path, photo_dir: Path, file: Path, workers: int, progress: Progress) -> None:
    """Write the cameras, poses and points of a model for Bundler.

    Args:
        model_dir: COLMAP's model, of one focal per camera and with optical centers in the middle.
        photo_dir: its photos; COLMAP writes them again, and they are thrown away.
        file: file to write.
        workers: threads.
        progress: shows a bar.

    Raises:
        BackendError: COLMAP cannot read the model or the photos, or cannot write.
    """
    scratch = file.with_name(".pmvs")
    try:
        scratch.mkdir()
        task: UndistortTask = {
            "dense": str(scratch),
            "model": str(model_dir),
            "photos": str(photo_dir),
            "max_side_px": ANY_SIZE,
            "workers": workers,
            "output": "PMVS",
        }
        run_worker("sfm_app.colmap.processes.undistort_process", task, "writing Bundler's file", progress)
        replace_file(scratch / BUNDLE, file)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
