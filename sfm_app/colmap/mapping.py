"""COLMAP's two mappers on our relative poses: photo by photo from our seed, or all photos at once.

Each runs on one thread: COLMAP's sums over several threads differ from run to run, and on sets with repeated structure
that decided whether a model was right.
"""

import shutil
from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path

from sfm_app.colmap import backend, tasks
from sfm_app.colmap.database import SQUARE_PIXELS
from sfm_app.colmap.worker_process import start_worker


def map_incrementally(
    database: Path,
    photo_dir: Path,
    start: backend.Reconstruction,
    scratch: Path,
    options: backend.pycolmap.IncrementalPipelineOptions,
    tick: Callable[[], None],
    token: backend.CancellationToken,
) -> backend.Reconstruction | None:
    """Register photo by photo, beginning with two or more in `start`; return None when COLMAP gives no model.

    The scratch folder is emptied first and removed afterwards; `tick` is called before every further photo.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    for name in ("start", "grown"):
        (scratch / name).mkdir(parents=True)
    start.write(scratch / "start")
    backend.check_written(*(scratch / "start").iterdir())
    seek_lens = options.ba_refine_focal_length and all(
        bool(camera.model.name == SQUARE_PIXELS and camera.params[camera.extra_params_idxs()[0]] == 0.0)
        for camera in backend.all_cameras(start)
    )
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = seek_lens
    models = backend.pycolmap.incremental_mapping(
        database, photo_dir, scratch / "grown", options,
        input_path=scratch / "start", next_image_callback=tick, cancellation_token=token,
    )  # fmt: skip
    shutil.rmtree(scratch, ignore_errors=True)
    return backend.largest_model(models)


def copy_database(database: Path, scratch: Path) -> None:
    """Copy a closed database into an emptied folder for another process: mappers of one file lock each other out."""
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    shutil.copyfile(database, scratch / "database.db")


def map_globally(
    photo_dir: Path, names: Sequence[str], scratch: Path, seed: int, token: backend.CancellationToken
) -> backend.Reconstruction | None:
    """Find the poses of all these photos at once (GLOMAP: rotations, positions, adjustment); None if it gave no model.

    COLMAP has no way to stop this, so it runs in a separate process. The folder, from `copy_database`, is removed.
    """
    call = partial(tasks.map_globally, scratch, photo_dir, seed, names)
    return _map_in_process(call, scratch, "mapping all photos at once", token)


def map_with_colmap_defaults(
    photo_dir: Path, scratch: Path, seed: int, token: backend.CancellationToken
) -> backend.Reconstruction | None:
    """Verify the raw matches and map the photos by COLMAP's defaults, with the database's cameras as first guess."""
    call = partial(tasks.map_with_defaults, scratch, photo_dir, seed)
    return _map_in_process(call, scratch, "mapping photos by its defaults", token)


def _map_in_process(
    call: Callable[[], None], scratch: Path, doing: str, token: backend.CancellationToken
) -> backend.Reconstruction | None:
    try:
        with start_worker(call) as process:
            while not process.has_ended(0.1):
                if token.is_cancelled:
                    return None
            process.check(doing)
        model_dir = scratch / "model"
        return backend.Reconstruction(model_dir) if model_dir.exists() else None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def incremental_options(
    seed: int, *, known: bool = False, kept: Collection[int] = ()
) -> backend.pycolmap.IncrementalPipelineOptions:
    """Return COLMAP's defaults, except that two photos make a model, which converges coarsely; `kept` cameras stay."""
    options = backend.pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 2
    options.multiple_models = False
    options.constant_cameras = set(kept)
    # an adjustment ends at a step that lowers its cost by less than this share
    options.ba_local_function_tolerance = 1e-2 if known else 1e-3
    options.ba_global_function_tolerance = 1e-3 if known else 1e-4
    # factor by which the model grows between global adjustments
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 2.0 if known else 1.3
    options.ba_local_max_refinements, options.ba_global_max_refinements = 1, 1 if known else 2
    options.extract_colors = False
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not known
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    return options
