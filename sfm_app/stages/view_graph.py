"""view_graph: MatchGraph -> ViewGraph."""

import shutil

from sfm_app.estimation.diagnosis import diagnose_scene
from sfm_app.estimation.fitting import find_lenses, find_views, known_fits, known_lenses
from sfm_app.matching.pairs import find_same_matches
from sfm_app.products import read_view_graph, write_view_graph
from sfm_app.runtime.context import GIVEN_CAMERAS, RunContext
from sfm_app.types import MatchGraph, ViewGraph

LENS_SETTINGS = (
    "calibration.lens",
    "calibration.keep",
    "calibration.deviation",
    "scene.camera_model",
    "photos.cameras",
    GIVEN_CAMERAS,
)
"""Settings that decide which camera groups have a wide lens."""


def make(matches: MatchGraph, run: RunContext) -> ViewGraph:
    """Find wide lenses and fit every new pair; raise a ReconstructionError if no pair has an epipolar geometry."""
    if run.earlier is None:
        lenses, known = find_lenses(matches, run), {}
    else:
        earlier = read_view_graph(run.earlier.place)
        lenses = find_lenses(matches, run, known_lenses(matches, earlier, run.earlier))
        known = known_fits(matches, earlier, find_same_matches(matches, run.earlier).pairs, lenses)
        run.record(known_pairs=len(known))
    graph = find_views(matches, run, lenses, known)
    if not graph.fits:
        raise diagnose_scene(matches, graph, run.settings.matching).error()
    write_view_graph(graph, run.workspace)
    shutil.rmtree(run.workspace.view_graph_parts)
    return graph
