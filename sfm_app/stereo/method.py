"""The depth-map method for every machine."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.numerical import FAILURES, error_reason
from sfm_app.settings import AS_NEEDED, DepthSettings
from sfm_app.stereo.depth import OPTIONS as DEPTH_OPTIONS
from sfm_app.stereo.depth import confirm_depths, match_depths
from sfm_app.stereo.sky import PhotoAreas, blank_areas, compare_areas, near_pixels, possible_skies, to_cells
from sfm_app.stereo.view import DepthEstimate, DepthMap, DepthStore, DepthTask, GrayImage, View
from sfm_app.tasks import ParallelMap, Shared, Task
from sfm_app.types import Rejected
from sfm_app.types.arrays import BoolArray, DepthArray


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """The two steps of the method for one photo."""

    match: Callable[..., DepthEstimate | Rejected] = match_depths
    confirm: Callable[..., DepthMap | Rejected] = confirm_depths


STEPS = Steps()


@dataclass(frozen=True, slots=True, eq=False)
class _Inputs:
    levels: Sequence[Sequence[View]]
    """The views at full size, at half the size, and so on."""
    ranked: Sequence[Sequence[int]]
    options: DepthSettings
    store: DepthStore
    steps: Steps

    def closed_pixels(self, view: View) -> BoolArray:
        """Mark the pixels (H, W) of a photo that are not filled."""
        closed = self.store.read_depth(view, "closed") if self.store.has(view, "closed") else np.zeros((1, 1))
        return near_pixels(closed > 0, (view.height, view.width))

    def tolerance(self, level: int) -> float:
        """Return the relative difference of depths that agree; it doubles with each halving of the photos."""
        return self.options.consistency * 2.0**level


def make_depth_maps_on_cpu(task: DepthTask, steps: Steps = STEPS) -> list[Rejected | None]:
    """Match every photo with its neighbors, then keep depths that the maps of other photos confirm.

    Both happen at every level; coarser levels fill gaps of finer ones. If the settings do not fix the number of levels,
    a coarser level follows if many pixels need it. Return for every view the reason why it has no maps, or None.
    """
    everything, options, store = range(len(task.views)), task.options, task.store
    inputs = _Inputs(halve_views(task.views, max(options.levels, 1)), task.ranked, options, store, steps)
    shared = Shared(inputs)
    matched = task.map(Task(_match, shared, 0), everything, "matching depths")
    confirmed = task.map(Task(_confirm, shared), everything, "confirming depths")
    rejected = [other if one is None else one for one, other in zip(matched, confirmed, strict=True)]
    if options.levels != 1:
        inputs = close_skies(inputs, [index for index in everything if matched[index] is None], task.map)
        shared = Shared(inputs)
    if len(inputs.levels) > 1:
        for level in range(1, len(inputs.levels)):
            task.map(Task(_match, shared, level), everything, "matching depths in smaller photos")
        task.map(Task(_fill, shared), everything, "filling gaps in depth maps")
    has_map = [store.has(view, "geometric") for view in task.views]
    return [None if known else reason for known, reason in zip(has_map, rejected, strict=True)]


def close_skies(inputs: _Inputs, matched: Sequence[int], spread: ParallelMap) -> _Inputs:
    """Close the possible skies of matched photos, unless a killed run has; add a level if many pixels need it."""
    views, store = [inputs.levels[0][index] for index in matched], inputs.store
    gaps = spread(Task(_find_gaps, Shared(inputs)), matched, "measuring gaps in depth maps")
    if not all(store.has(view, "closed") for view in views):
        areas = [gap.areas for gap in gaps]
        for view, cells in zip(views, possible_skies(areas, compare_areas(areas, views, spread)), strict=True):
            store.write_depth(view, cells.astype(np.float32), "closed")
    shares = [gap.open_share(store.read_depth(view, "closed") > 0) for gap, view in zip(gaps, views, strict=True)]
    if inputs.options.levels == AS_NEEDED and shares and float(np.mean(shares)) >= OPTIONS.most_open:
        return replace(inputs, levels=halve_views(inputs.levels[0], 2))
    return inputs


def _find_gaps(inputs: Shared[_Inputs], index: int) -> "Gaps":
    view, store = inputs.value.levels[0][index], inputs.value.store
    estimate = store.read_estimate(view)
    has_map = store.has(view, "geometric")
    return find_gaps(store.photo(view), estimate, store.read_depth(view, "geometric") if has_map else estimate.depth)


def _match(inputs: Shared[_Inputs], level: int, index: int) -> Rejected | None:
    task = inputs.value
    views, options = task.levels[level], task.options
    view = views[index]
    if task.store.has(view, "photometric"):
        return None
    candidates = [views[other] for other in task.ranked[index]]
    try:
        estimate = task.steps.match(view, candidates, task.store.photo, options.neighbors)
    except FAILURES as err:
        return Rejected(f"the computation failed: {error_reason(err)}")
    if isinstance(estimate, Rejected):
        return estimate
    task.store.write_estimate(view, estimate)
    return None


def _confirm(inputs: Shared[_Inputs], index: int) -> Rejected | None:
    """Keep the confirmed depths of a photo."""
    task = inputs.value
    view = task.levels[0][index]
    if task.store.has(view, "geometric"):
        return None
    maps = _confirm_level(task, 0, index)
    if isinstance(maps, Rejected):
        return maps
    task.store.write_maps(view, maps)
    return None


def _fill(inputs: Shared[_Inputs], index: int) -> None:
    """Fill the gaps of a photo from coarser levels; a repetition changes nothing."""
    task = inputs.value
    view, store = task.levels[0][index], task.store
    maps = store.read_maps(view) if store.has(view, "geometric") else None
    for level in range(1, len(task.levels)):
        coarse = _confirm_level(task, level, index)
        if not isinstance(coarse, Rejected):
            # at half the size, a possible sky looks like a plain wall
            closed, fine = task.closed_pixels(view), maps or DepthMap.unknown(view)
            maps = fill_from_coarse(fine, view, coarse, task.levels[level][index], closed)
    if maps is not None:
        store.write_maps(view, maps)


def _confirm_level(task: _Inputs, level: int, index: int) -> DepthMap | Rejected:
    views, store = task.levels[level], task.store
    view = views[index]
    if not store.has(view, "photometric"):
        return Rejected("no depth map of this size")
    others = [
        (views[other], store.read_depth(views[other]))
        for other in task.ranked[index]
        if store.has(views[other], "photometric")
    ]
    estimate, photo = store.read_estimate(view), store.photo(view)
    try:
        return task.steps.confirm(view, photo, estimate, others, task.options.min_agreeing, task.tolerance(level))
    except FAILURES as err:
        return Rejected(f"the computation failed: {error_reason(err)}")


# Coarser depth maps fill gaps of finer ones.
# Noise hides the weak texture of plain surfaces at full size. In a photo of half the size, noise is half as strong and
# the windows cover twice as much (Xu and Tao: Multi-scale geometric consistency guided multi-view stereo. CVPR 2019).


@dataclass(frozen=True, slots=True)
class LevelOptions:
    """When a coarser level is needed, and how its depths are transferred."""

    most_open: float = 0.08
    """Mean share of pixels without a sure depth that calls for a coarser level; sets that gain have 0.11 to 0.39."""
    black: int = 25
    """Gray level below which a pixel belongs to an empty background. Chosen on temple16."""
    most_slant: float = 0.1
    """Largest relative change of depth within a pixel along a plane. Chosen by hand."""


OPTIONS = LevelOptions()


def halve_views(views: Sequence[View], levels: int) -> list[list[View]]:
    """Return the views at each of `levels` >= 1 sizes: full, half, and so on."""
    return [list(views), *([view.halve(level) for view in views] for level in range(1, levels))]


@dataclass(frozen=True, slots=True, eq=False)
class Gaps:
    """Where a photo has no sure depth."""

    areas: PhotoAreas
    open: NDArray[np.float32]
    """(h, w) share of the pixels of each cell that have no sure depth and are not black."""

    def open_share(self, closed: BoolArray) -> float:
        """Return the share of the photo that is open beyond and beside closed cells (h, w)."""
        return float(np.mean(np.where(near_pixels(closed, closed.shape), 0, self.open)))


def find_gaps(photo: GrayImage, estimate: DepthEstimate, confirmed: DepthArray) -> Gaps:
    """Find the blank areas of a photo (H, W) without confirmed depths (H, W), and everything without a sure depth."""
    unsure = estimate.confidence < DEPTH_OPTIONS.weak_correlation
    return Gaps(blank_areas(photo, confirmed), to_cells((unsure & (photo >= OPTIONS.black)).astype(np.float32)))


def fill_from_coarse(fine: DepthMap, view: View, coarse: DepthMap, small: View, closed: BoolArray) -> DepthMap:
    """Fill gaps of a depth map along the planes of a coarser one, of the halved view `small`, except where closed."""
    row, col = np.nonzero((fine.depth == 0) & ~closed)
    x = (col + view.sample_px) * (small.width / view.width)
    y = (row + view.sample_px) * (small.height / view.height)
    i, j = y.astype(np.int64).clip(0, small.height - 1), x.astype(np.int64).clip(0, small.width - 1)
    known = coarse.depth[i, j] > 0
    row, col, i, j, x, y = (values[known] for values in (row, col, i, j, x, y))
    depth, normals = coarse.depth[i, j].astype(np.float64), coarse.normals[i, j].astype(np.float64)
    coarse_ray = small.rays(np.stack([j, i], axis=1) + small.sample_px)
    fine_ray = small.rays(np.stack([x, y], axis=1))
    with np.errstate(divide="ignore", invalid="ignore"):
        slant = np.einsum("nk,nk->n", normals, coarse_ray) / np.einsum("nk,nk->n", normals, fine_ray)
    slant = np.where(np.abs(slant - 1.0) <= OPTIONS.most_slant, slant, 1.0)
    filled, filled_normals = fine.depth.copy(), fine.normals.copy()
    filled[row, col], filled_normals[row, col] = depth * slant, normals
    return DepthMap(filled, filled_normals)
