"""What one folder asks of the two methods: matches in, relative poses and cameras out, beside the truth."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.metrics import LOST_DEG, area_under_recall, focal_error_percent, pose_error_deg, relative_pose
from sfm_app.api import open_run
from sfm_app.errors import ReconstructionError
from sfm_app.posegraph import PoseGraphOptions, build_pose_graph
from sfm_app.settings import Settings
from sfm_app.stages import intrinsics as intrinsics_stage
from sfm_app.stages import view_graph as view_graph_stage
from sfm_app.types import Evidence, Intrinsics, MatchGraph, PoseGraph

FloatArray = NDArray[np.float64]
WORST_PERCENT = 50.0
"""A focal that is further off counts as this much."""
LIMIT_DEG = 5.0


@dataclass(frozen=True, slots=True)
class Problem:
    """Matches of a folder, and its truth by photo name without suffix."""

    matches: MatchGraph
    Ks: dict[str, FloatArray]
    """(3, 3) each."""
    poses: dict[str, FloatArray]
    """(3, 4) cam_from_world each."""


def figures(problem: Problem, seed: int) -> dict[str, float]:
    """Return the area under the recall of relative poses up to 5 degrees, and the mean error of the focals in percent.

    Args:
        problem: matches and truth.
        seed: of the run.
    """
    settings, matches = Settings(seed=seed, workers=1), problem.matches
    with tempfile.TemporaryDirectory() as folder, open_run(Path(folder), settings, None) as run:
        try:
            views = view_graph_stage.make(matches, run.with_fingerprint("F"))
        except ReconstructionError:
            return {"AUC@5": 0.0, "focal %": WORST_PERCENT}
        intrinsics = intrinsics_stage.make(matches, views, run.with_fingerprint("K"))
        options = PoseGraphOptions(settings.epipolar.max_error_px, settings.epipolar.min_inliers, seed)
        graph = build_pose_graph(Evidence(matches, views, intrinsics), options, run.map)
    return {
        "AUC@5": area_under_recall(pair_errors_deg(problem, graph), LIMIT_DEG),
        "focal %": float(np.mean(focal_errors_percent(problem, intrinsics))),
    }


def pair_errors_deg(problem: Problem, graph: PoseGraph) -> FloatArray:
    """Return the larger of the errors of rotation and direction, of every pair with matches; 180 without a pose."""
    errors = []
    for pair in problem.matches.matches:
        names = [Path(problem.matches.images[photo].name).stem for photo in pair]
        if not all(name in problem.poses for name in names):
            continue
        true, found = relative_pose(*(problem.poses[name] for name in names)), graph.poses.get(pair)
        errors.append(LOST_DEG if found is None else pose_error_deg((found.R, found.t), true))
    return np.array(errors)


def focal_errors_percent(problem: Problem, intrinsics: Intrinsics) -> list[float]:
    """Return the error of every photo with a true camera, at most `WORST_PERCENT`."""
    images = [image for image in problem.matches.images.values() if Path(image.name).stem in problem.Ks]
    return [
        min(focal_error_percent(intrinsics.camera(image).K, problem.Ks[Path(image.name).stem]), WORST_PERCENT)
        for image in images
    ]
