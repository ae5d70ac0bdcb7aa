"""Depth maps on CPU: pure functions on arrays, and the interface of every depth-map method."""

from sfm_app.stereo.depth import confirm_depths, match_depths
from sfm_app.stereo.method import make_depth_maps_on_cpu
from sfm_app.stereo.view import DepthEstimate, DepthMap, DepthStore, DepthTask, Kind, View, rank_neighbors, region

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
