"""depth_maps: Scene -> COLMAP dense workspace with depth and normal maps."""

import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2

from sfm_app.colmap.dense import read_depth, read_grey, read_views, undistort, write_depth, write_maps
from sfm_app.context import RunContext
from sfm_app.errors import ReconstructionError
from sfm_app.settings import DepthSettings
from sfm_app.stereo import DepthMap, View, confirm_depths, match_depths, rank_neighbours
from sfm_app.types import Rejected, Scene

HINT = "take photos a step apart, sideways rather than forward, with two thirds of the view in common"

CONFIRMING = 2
"""A depth map is checked against this many times as many photos as it was made from."""


def make_depth_maps(scene: Scene, photo_dir: Path, dense_dir: Path, options: DepthSettings, run: RunContext) -> Path:
    """Give every photo that has neighbours a depth and a normal map.

    Returns:
        The dense workspace.

    Raises:
        ReconstructionError: no photo gets a depth map.
        BackendError: COLMAP failed.
    """
    shutil.rmtree(dense_dir, ignore_errors=True)
    undistort(scene.model_dir, photo_dir, dense_dir, options.max_image_size_px)
    views = read_views(dense_dir)
    ranked = rank_neighbours(views, CONFIRMING * options.neighbours)
    with single_threaded_opencv():
        match = partial(match_view, views=views, ranked=ranked, dense_dir=dense_dir, options=options)
        matched = run.map(match, range(len(views)), "matching depths")
    usable = [found is None for found in matched]
    confirm = partial(confirm_view, views=views, ranked=ranked, usable=usable, dense_dir=dense_dir, options=options)
    confirmed = run.map(confirm, [index for index in range(len(views)) if usable[index]], "confirming depths")
    coverage = {name: found for name, found in confirmed if isinstance(found, float)}
    rejected = [found.reason for found in matched if found] + [
        f.reason for _, f in confirmed if isinstance(f, Rejected)
    ]
    run.record(depth_maps=len(coverage), rejected=dict(Counter(rejected)), coverage=coverage)
    if not coverage:
        raise ReconstructionError(
            f"none of {len(views)} photos gets a depth map: {_most_common(rejected)}",
            hint=HINT,
        )
    return dense_dir


def match_view(
    index: int, views: list[View], ranked: list[list[int]], dense_dir: Path, options: DepthSettings
) -> Rejected | None:
    """Write the photometric depth map of one view, or say why there is none."""
    candidates = [views[other] for other in ranked[index]]
    load = partial(read_grey, dense_dir)
    depth = match_depths(views[index], candidates, load, options.neighbours, options.consistency)
    if isinstance(depth, Rejected):
        return depth
    write_depth(dense_dir, views[index], depth, "photometric")
    return None


def confirm_view(
    index: int, views: list[View], ranked: list[list[int]], usable: list[bool], dense_dir: Path, options: DepthSettings
) -> tuple[str, float | Rejected]:
    """Write the geometric depth and normal map of one view; gives its name and the share of its pixels with a depth."""
    view = views[index]
    others = [(views[o], read_depth(dense_dir, views[o], "photometric")) for o in ranked[index] if usable[o]]
    depth = read_depth(dense_dir, view, "photometric")
    maps = confirm_depths(view, depth, others, options.min_agreeing, options.consistency)
    if isinstance(maps, DepthMap):
        write_maps(dense_dir, view, maps)
        return view.name, round(maps.coverage, 3)
    return view.name, maps


@contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """One OpenCV thread per worker: the photos are what runs in parallel."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _most_common(reasons: list[str]) -> str:
    return Counter(reasons).most_common(1)[0][0] if reasons else "no photos"
