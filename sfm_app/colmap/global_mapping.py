"""COLMAP's global mapper as a process of its own: SCRATCH PHOTOS SEED; see `mapping.map_globally`."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.mapping import largest

ADJUSTMENTS, GAIN = 2, 1e-3
"""Rounds of adjustment, and the share of its cost that a step must gain."""


def main(scratch: Path, photo_dir: Path, seed: int) -> None:
    """Write the largest model into SCRATCH/model; nothing where there is none."""
    names = json.loads((scratch / "names.json").read_text(encoding="utf-8"))
    (scratch / "all").mkdir()
    models = pycolmap.global_mapping(scratch / "database.db", photo_dir, scratch / "all", global_options(seed, names))
    model = largest(models)
    if model is not None:
        (scratch / "model").mkdir()
        model.write(scratch / "model")


def global_options(seed: int, names: Sequence[str]) -> Any:
    """COLMAP's defaults, on our relative poses as they are; adjusted roughly, because the last adjustment is ours."""
    options = pycolmap.GlobalPipelineOptions()
    options.image_names = list(names)
    options.min_model_size = 2
    options.decompose_relative_pose = False
    options.num_threads = options.mapper.num_threads = 1
    mapper = options.mapper
    mapper.ba_num_iterations = ADJUSTMENTS
    mapper.bundle_adjustment.ceres.solver_options.function_tolerance = GAIN
    parts = (options, mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation)
    for part in parts:
        part.random_seed = seed
    return options


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
