"""Depth maps on CPU: pure functions on arrays, and the interface of every depth-map method."""

from sfm_app.stereo.depth import DepthEstimate, DepthMap, confirm_depths, match_depths
from sfm_app.stereo.method import DepthStore, DepthTask, Kind, make_depth_maps_on_cpu
from sfm_app.stereo.view import View, rank_neighbors, region

__all__ = [
    "DepthEstimate",
    "DepthMap",
    "DepthStore",
    "DepthTask",
    "Kind",
    "View",
    "confirm_depths",
    "make_depth_maps_on_cpu",
    "match_depths",
    "rank_neighbors",
    "region",
]
