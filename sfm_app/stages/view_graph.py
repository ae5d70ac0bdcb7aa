"""view_graph: MatchGraph -> ViewGraph."""

import numpy as np

from sfm_app.colmap.backend import backend
from sfm_app.colmap.database import write_epipolar_fits
from sfm_app.context import RunContext
from sfm_app.errors import ReconstructionError
from sfm_app.types import EpipolarFit, MatchGraph, PairId, Rejected, ViewGraph


def build_view_graph(matches: MatchGraph, run: RunContext) -> ViewGraph:
    """Fit every pair on its own, seeded by the run's seed and its ids, and count why pairs fell.

    Raises:
        ReconstructionError: no pair has a usable epipolar geometry.
    """
    options = run.settings.epipolar
    estimator = run.plugins.estimator(options.estimator)

    def fit_pair(pair: PairId) -> EpipolarFit | Rejected:
        seed = int(np.random.SeedSequence([run.seed, *pair]).generate_state(1)[0])
        return estimator.fit(*matches.points(pair), options, seed)

    pairs = list(matches.matches)
    fits = dict(zip(pairs, run.map(fit_pair, pairs, "epipolar geometry"), strict=True))
    graph = ViewGraph(
        fits={pair: fit for pair, fit in fits.items() if isinstance(fit, EpipolarFit)},
        rejected={pair: fit for pair, fit in fits.items() if isinstance(fit, Rejected)},
    )
    run.record(
        kept=len(graph.fits),
        rejected=graph.reasons,
        degenerate=sum(bool(fit.degeneracy) for fit in graph.fits.values()),
        inliers=sum(fit.inlier_count for fit in graph.fits.values()),
    )
    if not graph.fits:
        raise ReconstructionError(
            f"none of {len(pairs)} pairs of photos shows the same scene: " + reasons_text(graph),
            hint="take photos of one place that overlap by more than half",
        )
    with run.workspace.replacing(run.workspace.view_graph) as path:
        np.savez_compressed(path, allow_pickle=False, **graph.to_arrays())
    with backend("writing epipolar geometries"):
        write_epipolar_fits(run.workspace.database, matches, graph.fits)
    return graph


def load_view_graph(run: RunContext) -> ViewGraph:
    """Read view_graph.npz back."""
    with np.load(run.workspace.view_graph, allow_pickle=False) as arrays:
        return ViewGraph.from_arrays(dict(arrays))


def reasons_text(graph: ViewGraph) -> str:
    """Why pairs were rejected, for people."""
    return ", ".join(f"{count} {reason}" for reason, count in graph.reasons.items())
