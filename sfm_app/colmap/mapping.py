"""COLMAP's two mappers on our relative poses: photo after photo from a seed that we built, or all photos at once.

Both run on one thread each: COLMAP's sums over several threads come out differently every time, and on sets with
repeated structure that decided whether a model was right.
"""

import contextlib
import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.database import SQUARE_PIXELS

GLOBAL_REFINEMENT = 1.3
"""All of a model is adjusted again when it has grown by this factor; with K known, more often gains nothing."""


def map_incrementally(
    database: Path, photo_dir: Path, start: Any, scratch: Path, seed: int, tick: Callable[[], None], token: Any
) -> Any | None:
    """Register photo after photo, beginning with the ones in `start`; None when COLMAP gives nothing back.

    Args:
        database: photos, keypoints, two-view geometries, K.
        photo_dir: for the colours of the points.
        start: a reconstruction with at least two posed photos.
        scratch: a folder of ours that is emptied first and gone afterwards.
        seed: of COLMAP's own sampling.
        tick: called before every further photo.
        token: stops the mapping.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    for name in ("start", "found"):
        (scratch / name).mkdir(parents=True)
    start.write(scratch / "start")
    options = incremental_options(seed)
    options.ba_refine_extra_params = all(_lens_to_be_found(camera) for camera in start.cameras.values())
    models = pycolmap.incremental_mapping(
        database, photo_dir, scratch / "found", options,
        input_path=scratch / "start", next_image_callback=tick, cancellation_token=token,
    )  # fmt: skip
    shutil.rmtree(scratch, ignore_errors=True)
    return largest(models)


def map_globally(
    database: Path, photo_dir: Path, names: Sequence[str], scratch: Path, seed: int, token: Any
) -> Any | None:
    """Find the poses of all these photos at once (GLOMAP: rotations, positions, adjustment); None where that fails.

    COLMAP gives no way to stop this, so it runs in a process of its own, on a copy of the database: two mappers that
    open one file lock each other out.

    Args:
        database: photos, keypoints, two-view geometries with relative poses, K.
        photo_dir: for the colours of the points.
        names: photos to place.
        scratch: a folder of ours that is emptied first and gone afterwards.
        seed: of COLMAP's own sampling.
        token: stops the mapping.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    try:
        shutil.copyfile(database, scratch / "database.db")
        (scratch / "names.json").write_text(json.dumps(list(names)), encoding="utf-8")
        command = [sys.executable, "-m", "sfm_app.colmap.global_mapping", str(scratch), str(photo_dir), str(seed)]
        # what it says goes to a file: nobody empties a pipe while it runs, and a full one would make it wait for ever
        said = scratch / "errors.txt"
        with (
            said.open("wb") as errors,
            subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=errors) as process,  # noqa: S603 - our module
        ):
            while process.poll() is None:
                if token.is_cancelled:
                    process.kill()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(0.1)
        if process.returncode:
            lines = said.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            raise RuntimeError(lines[-1] if lines else "the global mapper was stopped")
        found = scratch / "model"
        return pycolmap.Reconstruction(found) if found.exists() else None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def incremental_options(seed: int) -> Any:
    """COLMAP's defaults, except that small photo sets count and only the model at hand is grown."""
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 2
    options.multiple_models = False
    options.ba_global_frames_ratio = options.ba_global_points_ratio = GLOBAL_REFINEMENT
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    return options


def _lens_to_be_found(camera: Any) -> bool:
    """Whether mapping is to seek the lens: a known one stays until the last adjustment, which frees it.

    On the first few photos even one distortion term moves more than the noise does, and four run wild.
    """
    return bool(camera.model.name == SQUARE_PIXELS and camera.params[camera.extra_params_idxs()[0]] == 0.0)


def largest(models: dict[int, Any]) -> Any | None:
    """The model with most photos; None of none."""
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)
