"""view_graph: MatchGraph -> ViewGraph."""

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import backend
from sfm_app.colmap.database import write_epipolar_fits
from sfm_app.context import RunContext
from sfm_app.diagnosis import why_no_scene
from sfm_app.ransac.stationary import covers, find_stationary, fit_moving
from sfm_app.settings import Settings
from sfm_app.types import EpipolarFit, MatchGraph, PairId, Rejected, ViewGraph

BoolArray = NDArray[np.bool_]


def build_view_graph(matches: MatchGraph, run: RunContext) -> ViewGraph:
    """Fit every pair on its own, seeded by the run's seed and its ids, and count why pairs fell.

    Raises:
        ReconstructionError: no pair has a usable epipolar geometry.
    """
    options = run.settings.epipolar
    estimator = run.plugins.estimator(options.estimator)

    def fit_pair(pair: PairId) -> tuple[EpipolarFit | Rejected, int]:
        seed = int(np.random.SeedSequence([run.seed, *pair]).generate_state(1)[0])
        points, still = matches.points(pair), stationary_matches(matches, pair, run.settings)
        if not still.any():
            return estimator.fit(*points, options, seed), 0
        image = matches.images[pair[0]]
        wide = covers(points[0][still], matches.keypoints[image.id], (image.width, image.height))
        return fit_moving(estimator.fit, points, still, wide, options, seed), int(np.count_nonzero(still))

    pairs = list(matches.matches)
    found = dict(zip(pairs, run.map(fit_pair, pairs, "epipolar geometry"), strict=True))
    graph = ViewGraph(
        fits={pair: fit for pair, (fit, _) in found.items() if isinstance(fit, EpipolarFit)},
        rejected={pair: fit for pair, (fit, _) in found.items() if isinstance(fit, Rejected)},
    )
    run.record(
        kept=len(graph.fits),
        rejected=graph.reasons,
        degenerate=sum(bool(fit.degeneracy) for fit in graph.fits.values()),
        inliers=sum(fit.inlier_count for fit in graph.fits.values()),
        stationary=sum(count for _, count in found.values()),
    )
    if not graph.fits:
        raise why_no_scene(matches, graph, run.settings.matching).error()
    with run.workspace.replacing(run.workspace.view_graph) as path:
        np.savez_compressed(path, allow_pickle=False, **graph.to_arrays())
    with backend("writing epipolar geometries"):
        write_epipolar_fits(run.workspace.database, matches, graph.fits)
    return graph


def stationary_matches(matches: MatchGraph, pair: PairId, settings: Settings) -> BoolArray:
    """Which matches of a pair stay in one place; none where the photos differ in size."""
    first, second = (matches.images[key] for key in pair)
    if (first.width, first.height) != (second.width, second.height):
        return np.zeros(len(matches.matches[pair]), bool)
    shrunk = max(first.width, first.height) / settings.matching.max_image_size_px
    return find_stationary(*matches.points(pair), unit_px=max(1.0, shrunk))


def load_view_graph(run: RunContext) -> ViewGraph:
    """Read view_graph.npz back."""
    with np.load(run.workspace.view_graph, allow_pickle=False) as arrays:
        return ViewGraph.from_arrays(dict(arrays))
