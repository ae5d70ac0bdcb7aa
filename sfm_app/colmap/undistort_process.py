"""COLMAP's undistortion; see `dense.undistort`. Its JPEG writer ends the process when the disk is full."""

from pathlib import Path

from sfm_app.colmap.backend import check_written, pycolmap, run_with_progress
from sfm_app.colmap.worker_process import ProgressReporter, UndistortTask, serve

JPEG_QUALITY = 98
FOLDERS = {"COLMAP": "images", "PMVS": "pmvs/visualize"}
"""Where the undistorted photos lie, by layout."""


def work(task: UndistortTask) -> None:
    """Write undistorted photos and their model into a dense workspace."""
    dense_dir, model_dir = Path(task["dense"]), Path(task["model"])
    options = pycolmap.UndistortCameraOptions()
    options.max_image_size = task["max_side_px"]
    photos = dense_dir / FOLDERS[task["output"]]

    def call(token: pycolmap.CancellationToken) -> None:
        pycolmap.undistort_images(
            dense_dir, model_dir, Path(task["photos"]), undistort_options=options, jpeg_quality=JPEG_QUALITY,
            num_threads=task["workers"], cancellation_token=token, output_type=task["output"],
        )  # fmt: skip

    def count_finished() -> int:
        return sum(path.is_file() for path in photos.rglob("*"))

    run_with_progress(
        call, count_finished, "undistorting", pycolmap.Reconstruction(model_dir).num_reg_images(), ProgressReporter()
    )
    check_written(*(path for path in dense_dir.rglob("*") if path.is_file()))


if __name__ == "__main__":
    serve(work)
