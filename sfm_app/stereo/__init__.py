"""Depth maps on CPU: pure functions on arrays, and the interface that every way to make depth maps has."""

from sfm_app.stereo.depth import DepthMap, Estimate, confirm_depths, match_depths
from sfm_app.stereo.method import DepthStore, DepthTask, Kind, MakeDepthMaps, make_on_cpu
from sfm_app.stereo.neighbours import rank_neighbours
from sfm_app.stereo.view import View, region

CPU = "cpu"
DEPTH_METHODS: dict[str, tuple[MakeDepthMaps, str]] = {
    CPU: (make_on_cpu, "semi-global matching and PatchMatch, on every machine"),
}

__all__ = [
    "CPU",
    "DEPTH_METHODS",
    "DepthMap",
    "DepthStore",
    "DepthTask",
    "Estimate",
    "Kind",
    "MakeDepthMaps",
    "View",
    "confirm_depths",
    "match_depths",
    "rank_neighbours",
    "region",
]
