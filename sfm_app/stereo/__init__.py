"""Depth maps on CPU: pure functions on arrays."""

from sfm_app.stereo.depth import DepthMap, confirm_depths, match_depths
from sfm_app.stereo.neighbours import rank_neighbours
from sfm_app.stereo.view import View, region

__all__ = ["DepthMap", "View", "confirm_depths", "match_depths", "rank_neighbours", "region"]
