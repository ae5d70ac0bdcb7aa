"""COLMAP's incremental mapping, continued from a model that we built."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sfm_app.colmap.backend import interruptible, pycolmap
from sfm_app.colmap.database import SQUARE_PIXELS
from sfm_app.progress import Progress


def continue_mapping(
    database: Path, photo_dir: Path, start: Any, scratch: Path, seed: int, tick: Callable[[], None]
) -> Any | None:
    """Register photo after photo, beginning with the ones in `start`; None when COLMAP gives nothing back.

    Args:
        database: photos, keypoints, two-view geometries, K.
        photo_dir: for the colours of the points.
        start: a reconstruction with at least two posed photos.
        scratch: a folder of ours that is emptied first.
        seed: of COLMAP's own sampling.
        tick: called before every further photo.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    for name in ("start", "found"):
        (scratch / name).mkdir(parents=True)
    start.write(scratch / "start")
    options = mapping_options(seed)
    options.ba_refine_extra_params = all(_lens_to_be_found(camera) for camera in start.cameras.values())
    models: dict[int, Any] = {}

    def call(token: Any) -> None:
        models.update(
            pycolmap.incremental_mapping(
                database,
                photo_dir,
                scratch / "found",
                options,
                input_path=scratch / "start",
                next_image_callback=tick,
                cancellation_token=token,
            )
        )

    interruptible(call, lambda: None)
    shutil.rmtree(scratch, ignore_errors=True)
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _lens_to_be_found(camera: Any) -> bool:
    """Whether mapping is to seek the lens: a known one stays until the last adjustment, which frees it.

    On the first few photos even one distortion term moves more than the noise does, and four run wild.
    """
    return bool(camera.model.name == SQUARE_PIXELS and camera.params[camera.extra_params_idxs()[0]] == 0.0)


def mapping_options(seed: int) -> Any:
    """COLMAP's defaults, except that small photo sets count and only the model at hand is grown."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 2
    options.multiple_models = False
    options.random_seed = seed
    options.mapper.random_seed = seed
    options.triangulation.random_seed = seed
    return options


class PhotoCounter:
    """Counts COLMAP's callbacks, one per further photo, on a progress display."""

    def __init__(self, progress: Progress, photos: int) -> None:
        self.progress = progress
        progress.start("mapping", max(photos - 2, 1))
        self.begun = False

    def __call__(self) -> None:
        if self.begun:
            self.progress.advance()
        self.begun = True
