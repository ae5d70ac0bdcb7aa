"""COLMAP's global mapper, as a separate process; see `mapping.map_globally`."""

from collections.abc import Sequence
from pathlib import Path

from sfm_app.colmap.backend import check_written, pycolmap
from sfm_app.colmap.mapping import largest_model
from sfm_app.colmap.worker_process import GlobalMappingTask, serve

ADJUSTMENTS, GAIN = 2, 1e-3
"""Rounds of adjustment, and the share of the cost that a step must gain, else the adjustment ends."""


def work(task: GlobalMappingTask) -> None:
    """Write the largest model into `model` in the scratch folder, or nothing if there is none."""
    scratch, options = Path(task["scratch"]), global_options(task["seed"], task["names"])
    (scratch / "all").mkdir()
    models = pycolmap.global_mapping(scratch / "database.db", Path(task["photos"]), scratch / "all", options)
    model = largest_model(models)
    if model is not None:
        (scratch / "model").mkdir()
        model.write(scratch / "model")
        check_written(*(scratch / "model").iterdir())


def global_options(seed: int, names: Sequence[str]) -> pycolmap.GlobalPipelineOptions:
    """Return COLMAP's defaults, except that our relative poses are used unchanged.

    COLMAP's adjustment is coarse, because the last adjustment is ours.
    """
    options = pycolmap.GlobalPipelineOptions()
    options.image_names = list(names)
    options.min_model_size = 2
    options.decompose_relative_pose = False
    options.num_threads = options.mapper.num_threads = 1
    mapper = options.mapper
    mapper.ba_num_iterations = ADJUSTMENTS
    mapper.bundle_adjustment.ceres.solver_options.function_tolerance = GAIN
    # on any machine the same bytes; without CUDA, COLMAP warns of it from 50 photos on
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    options.random_seed = mapper.random_seed = mapper.rotation_averaging.random_seed = seed
    mapper.global_positioning.random_seed = mapper.retriangulation.random_seed = seed
    return options


if __name__ == "__main__":
    serve(work)
