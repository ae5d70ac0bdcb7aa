"""Inliers that a lens hid: through a barrel or pincushion lens, right matches lie off straight epipolar lines.

Ours. A fundamental matrix of pixels keeps the matches that a lens bends least, and cameras adjusted to these alone have
too long or too short a focal. With the lens that they give, each pair chooses its inliers among all its matches again.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace

from sfm_app.numerical import FAILURES
from sfm_app.posegraph.pair_pose import Pair, estimate_pose
from sfm_app.runtime.context import RunContext
from sfm_app.selfcal import CalibratedCamera
from sfm_app.types import Calibration, EpipolarFit, MatchGraph, PairId, ViewGraph

logger = logging.getLogger("sfm_app")

LEAST_RADIAL = 0.02
"""|k1| from which on matches are chosen again. Chosen on synthetic matches with k1 from -0.35 to 0.2
(`python -m benchmarks.lenses.distortion`): at 0.1 the focal is off by 0.4 % without."""
LEAST_KEPT = 0.7
"""Share of its inliers that a pair must keep for its new ones to be taken. Chosen by hand; not measured on its own."""


def choose_inliers_again(
    matches: MatchGraph, views: ViewGraph, cameras: Sequence[CalibratedCamera], run: RunContext
) -> ViewGraph:
    """Return the view graph with the inliers of its pairs chosen through their lenses; the same one where none bends.

    Args:
        matches: keypoints and raw matches.
        views: fundamental matrices.
        cameras: those of all photos, in pixels of whole photos.
        run: the run.
    """
    known = {photo: camera.found for camera in cameras for photo in camera.photos if camera.found.is_estimated}
    pairs = [pair for pair, fit in views.fits.items() if not fit.degeneracy and _is_bent(pair, known, views, matches)]
    if not pairs:
        return views

    def choose(pair: PairId) -> EpipolarFit:
        fit = views.fits[pair]
        try:
            lens = Pair(matches.points(pair), [known[photo] for photo in pair], run.settings.epipolar.max_error_px)
            pose = estimate_pose(lens, fit)
        except FAILURES as err:
            logger.info("the matches of pair %s could not be chosen again", pair, exc_info=err)
            return fit
        kept = pose is not None and pose.inlier_count >= LEAST_KEPT * fit.inlier_count
        return replace(fit, inliers=pose.inliers) if pose is not None and kept else fit

    found = dict(zip(pairs, run.map(choose, pairs, "matches through the lens"), strict=True))
    return replace(views, fits={pair: found.get(pair, fit) for pair, fit in views.fits.items()})


def _is_bent(pair: PairId, known: Mapping[int, Calibration], views: ViewGraph, matches: MatchGraph) -> bool:
    if not known.keys() >= set(pair) or any(matches.images[photo].group in views.lenses for photo in pair):
        return False
    return max(abs(known[photo].radial) for photo in pair) >= LEAST_RADIAL
