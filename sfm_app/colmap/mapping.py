"""COLMAP's two mappers on our relative poses: photo by photo from our seed, or all photos at once.

Each runs on one thread: COLMAP's sums over several threads differ from run to run, and on sets with repeated structure
that decided whether a model was right.
"""

import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

from sfm_app.colmap.backend import check_written, pycolmap
from sfm_app.colmap.database import SQUARE_PIXELS
from sfm_app.colmap.types import Cancellation, all_cameras
from sfm_app.colmap.worker_process import GlobalMappingTask, MappingTask, start_worker

LOCAL_GAIN, GLOBAL_GAIN, GLOBAL_REFINEMENT = 1e-3, 1e-4, 1.3
"""An adjustment ends at a step that lowers its cost by less than this share: local and global adjustments. Third, the
factor by which the model grows between global adjustments."""
KNOWN_LOCAL_GAIN, KNOWN_GLOBAL_GAIN, KNOWN_GLOBAL_REFINEMENT = 1e-2, 1e-3, 2.0
"""The same three where K is known: poses and points alone converge in a few steps, and the last adjustment is ours."""
POLL_S = 0.1


def map_incrementally(
    database: Path, photo_dir: Path, start: pycolmap.Reconstruction, scratch: Path, seed: int,
    tick: Callable[[], None], token: pycolmap.CancellationToken, *, known: bool, kept: Collection[int] = (),
) -> pycolmap.Reconstruction | None:  # fmt: skip
    """Register photo by photo, beginning with those in `start`; return None when COLMAP gives no model.

    Args:
        database: photos, keypoints, two-view geometries, K.
        start: a reconstruction with at least two posed photos.
        scratch: a folder that is emptied first and removed afterwards.
        tick: called before every further photo.
        known: whether the cameras are known too well for mapping to improve them.
        kept: ids of cameras that the user gave and wants unchanged.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    for name in ("start", "found"):
        (scratch / name).mkdir(parents=True)
    start.write(scratch / "start")
    check_written(*(scratch / "start").iterdir())
    options = incremental_options(seed, known=known)
    options.constant_cameras = set(kept)
    seek_lens = not known and all(_has_unknown_lens(camera) for camera in all_cameras(start))
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = seek_lens
    models = pycolmap.incremental_mapping(
        database, photo_dir, scratch / "found", options,
        input_path=scratch / "start", next_image_callback=tick, cancellation_token=token,
    )  # fmt: skip
    shutil.rmtree(scratch, ignore_errors=True)
    return largest_model(models)


def copy_database(database: Path, scratch: Path) -> None:
    """Copy the database for a mapper in a separate process: two mappers that open one file lock each other out.

    Args:
        database: photos, keypoints, matches, two-view geometries, K; must not be open anywhere.
        scratch: a folder that is emptied first.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    shutil.copyfile(database, scratch / "database.db")


def map_globally(
    photo_dir: Path, names: Sequence[str], scratch: Path, seed: int, token: Cancellation
) -> pycolmap.Reconstruction | None:
    """Find the poses of all these photos at once (GLOMAP: rotations, positions, adjustment).

    COLMAP has no way to stop this, so it runs in a separate process.

    Args:
        scratch: a folder from `copy_database`; removed afterwards.

    Returns:
        The model; None where the mapper was stopped or found none.

    Raises:
        BackendError: COLMAP failed.
    """
    task: GlobalMappingTask = {
        "scratch": str(scratch),
        "photos": str(photo_dir),
        "seed": seed,
        "names": list(names),
    }
    return _map_in_process("sfm_app.colmap.global_mapping", task, "mapping all photos at once", token)


def map_with_colmap_defaults(
    photo_dir: Path, scratch: Path, seed: int, token: Cancellation
) -> pycolmap.Reconstruction | None:
    """Verify the raw matches and map the photos by COLMAP's defaults, with the cameras of the database as first guess.

    Only the raw matches and the guess are ours. The result and the errors are those of `map_globally`.
    """
    task: MappingTask = {"scratch": str(scratch), "photos": str(photo_dir), "seed": seed}
    return _map_in_process("sfm_app.colmap.baseline_mapping", task, "mapping photos by its defaults", token)


def _map_in_process(module: str, task: MappingTask, doing: str, token: Cancellation) -> pycolmap.Reconstruction | None:
    scratch = Path(task["scratch"])
    try:
        with start_worker(module, task) as process:
            while not process.has_ended(POLL_S):
                if token.is_cancelled:
                    return None
            process.check(doing)
        found = scratch / "model"
        return pycolmap.Reconstruction(found) if found.exists() else None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def incremental_options(seed: int, *, known: bool = False) -> pycolmap.IncrementalPipelineOptions:
    """Return COLMAP's defaults, except that two photos make a model and only the given model is extended.

    Adjustments stop when they gain little, and `known` cameras are held fixed: the last adjustment is ours.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 2
    options.multiple_models = False
    usual = (LOCAL_GAIN, GLOBAL_GAIN, GLOBAL_REFINEMENT)
    local_gain, global_gain, growth = (KNOWN_LOCAL_GAIN, KNOWN_GLOBAL_GAIN, KNOWN_GLOBAL_REFINEMENT) if known else usual
    options.ba_local_function_tolerance, options.ba_global_function_tolerance = local_gain, global_gain
    options.ba_global_frames_ratio = options.ba_global_points_ratio = growth
    options.ba_local_max_refinements, options.ba_global_max_refinements = 1, 1 if known else 2
    options.extract_colors = False
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not known
    options.num_threads = options.mapper.num_threads = 1
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed
    return options


def _has_unknown_lens(camera: pycolmap.Camera) -> bool:
    """Return whether mapping has to estimate the lens: a known one is held fixed until the last adjustment.

    On the first few photos even one distortion term varies more than the noise explains, and four diverge.
    """
    return bool(camera.model.name == SQUARE_PIXELS and camera.params[camera.extra_params_idxs()[0]] == 0.0)


def largest_model(models: Mapping[int, pycolmap.Reconstruction]) -> pycolmap.Reconstruction | None:
    """Return the model with most photos; None if there is no model."""
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)
