"""The interface of depth-map methods, and the method that runs on every machine."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sfm_app.numerical import FAILURES, error_reason
from sfm_app.settings import AS_NEEDED, DepthSettings
from sfm_app.stereo.depth import WEAK_CORRELATION, DepthEstimate, DepthMap, confirm_depths, match_depths
from sfm_app.stereo.plane_proposals import add_depths, agreed_proposals, propose_planes
from sfm_app.stereo.sky import blank_areas, near_pixels
from sfm_app.stereo.view import DepthArray, GrayImage, View
from sfm_app.tasks import Shared, Task
from sfm_app.types import Rejected

# Coarser depth maps, which fill what finer ones leave open.
#
# Plain surfaces show too little at full size: noise hides what texture they have. In a photo of half the size,
# noise is half as strong and the windows cover twice as much (Xu and Tao: Multi-scale geometric consistency guided
# multi-view stereo. CVPR 2019).

MOST_OPEN = 0.08
"""Mean share of the photos that is left open without need for a coarser level. Chosen on castle-P19, kitchen1000,
books21, oats23, fox50 and reichstag10, which have 0.11 to 0.39 and gain, and on fountain-P11, temple16, lund-door12 and
five rendered scenes, which have 0.01 to 0.06."""
BLACK = 25
"""Gray level below which a photo is taken for an empty background. Chosen on temple16."""
MOST_SLANT = 0.1
"""Largest relative change of depth within a pixel that a plane is trusted with. Chosen by hand."""


def halve_views(views: Sequence[View], levels: int) -> list[list[View]]:
    """Return the views at each level: as they are, at half the size, and so on.

    Args:
        views: of the full size.
        levels: how many, >= 1.
    """
    return [list(views), *([view.halve(level) for view in views] for level in range(1, levels))]


def open_share(photo: GrayImage, estimate: DepthEstimate) -> float:
    """Return the share of a photo that has no sure depth, though it is neither black nor near what may be a sky.

    Args:
        photo: (H, W).
        estimate: its depths before the check against other photos.
    """
    sure = estimate.confidence >= WEAK_CORRELATION
    blank = blank_areas(photo, np.where(sure, estimate.depth, np.float32(0))).blank
    return float(np.mean(~sure & (photo >= BLACK) & ~near_pixels(blank, photo.shape)))


def fill_from_coarse(fine: DepthMap, view: View, coarse: DepthMap, small: View, closed: NDArray[np.bool_]) -> DepthMap:
    """Return a depth map with the depths of a coarser one, along its planes, where it has none.

    Args:
        fine: of the view.
        view: the photo.
        coarse: of the smaller photo.
        small: the smaller photo.
        closed: (H, W) where nothing is filled in.
    """
    row, col = np.nonzero((fine.depth == 0) & ~closed)
    x = (col + view.sample_px) * (small.width / view.width)
    y = (row + view.sample_px) * (small.height / view.height)
    i, j = y.astype(np.int64).clip(0, small.height - 1), x.astype(np.int64).clip(0, small.width - 1)
    known = coarse.depth[i, j] > 0
    row, col, i, j, x, y = (values[known] for values in (row, col, i, j, x, y))
    depth, normals = coarse.depth[i, j].astype(np.float64), coarse.normals[i, j].astype(np.float64)
    K_inv = np.linalg.inv(small.K)
    there = np.stack([j + small.sample_px, i + small.sample_px, np.ones(len(i))], axis=1) @ K_inv.T
    here = np.stack([x, y, np.ones(len(x))], axis=1) @ K_inv.T
    with np.errstate(divide="ignore", invalid="ignore"):
        slant = np.einsum("nk,nk->n", normals, there) / np.einsum("nk,nk->n", normals, here)
    slant = np.where(np.abs(slant - 1.0) <= MOST_SLANT, slant, 1.0)
    filled, found = fine.depth.copy(), fine.normals.copy()
    filled[row, col], found[row, col] = depth * slant, normals
    return DepthMap(filled, found)


Result = TypeVar("Result")
Kind = Literal["photometric", "geometric", "proposed"]
"""COLMAP's names for a depth map before and after the check against the other photos; and planes in plain areas."""


class DepthStore(Protocol):
    """Reads photos and keeps maps; a map appears complete or not at all."""

    def photo(self, view: View, /) -> GrayImage:
        """Return the photo without distortion, (H, W), at the size of the view."""

    def has(self, view: View, kind: Kind, /) -> bool:
        """Return whether a map is there.

        Args:
            view: the photo.
            kind: before or after the check against other photos.
        """

    def read_estimate(self, view: View, /) -> DepthEstimate:
        """Return the photometric map."""

    def read_depth(self, view: View, kind: Kind = "photometric", /) -> DepthArray:
        """Return the depths of a map.

        Args:
            view: the photo.
            kind: which map.
        """

    def read_maps(self, view: View, /) -> DepthMap:
        """Return the geometric maps."""

    def write_proposal(self, view: View, depth: DepthArray, /) -> None:
        """Keep what is proposed for plain areas.

        Args:
            view: the photo.
            depth: (H, W), 0 where nothing is.
        """

    def write_estimate(self, view: View, estimate: DepthEstimate, /) -> None:
        """Keep the photometric map.

        Args:
            view: the photo.
            estimate: its map.
        """

    def write_maps(self, view: View, maps: DepthMap, /) -> None:
        """Keep the geometric maps.

        Args:
            view: the photo.
            maps: depth and normals.
        """


class ParallelMap(Protocol):
    """Applies a function to items in parallel and returns the results in order; a label names the progress."""

    def __call__(self, function: Callable[[int], Result], items: Sequence[int], label: str, /) -> list[Result]: ...


@dataclass(frozen=True, slots=True, eq=False)
class DepthTask:
    """The input of a depth-map method. Existing maps come from the same inputs and settings and are reused."""

    folder: Path
    """COLMAP's dense workspace with the undistorted photos and their model."""
    views: Sequence[View]
    ranked: Sequence[Sequence[int]]
    """For each view, the indices of its neighbors, best first."""
    options: DepthSettings
    store: DepthStore
    map: ParallelMap


@dataclass(frozen=True, slots=True, eq=False)
class _Inputs:
    """What a worker needs of a `DepthTask`."""

    levels: Sequence[Sequence[View]]
    """The views at full size, at half the size, and so on."""
    ranked: Sequence[Sequence[int]]
    options: DepthSettings
    store: DepthStore

    def tolerance(self, level: int) -> float:
        """Return the relative difference of depths that agree, which is as coarse as the photos."""
        return self.options.consistency * 2.0**level


def make_depth_maps_on_cpu(task: DepthTask) -> list[Rejected | None]:
    """Match every photo with its neighbors, then keep what the depth maps of other photos confirm.

    Both are done at every level; where the finer ones have no depth, the coarser ones fill it in. Where the settings
    leave it open, there is a coarser level if much of the photos needs it.

    Returns:
        For every view the reason why it has no maps, or None.
    """
    everything, options = range(len(task.views)), task.options
    inputs = _Inputs(halve_views(task.views, max(options.levels, 1)), task.ranked, options, task.store)
    matched = task.map(Task(_match, Shared(inputs), 0), everything, "matching depths")
    if options.levels == AS_NEEDED and _needs_coarser(task, inputs):
        inputs = replace(inputs, levels=halve_views(task.views, 2))
    shared = Shared(inputs)
    for level in range(1, len(inputs.levels)):
        again = task.map(Task(_match, shared, level), everything, "matching depths in smaller photos")
        matched = [one and other for one, other in zip(matched, again, strict=True)]
    usable = np.array([found is None for found in matched])
    confirm = Task(_confirm, shared, usable)
    confirmed = iter(task.map(confirm, [index for index in everything if usable[index]], "confirming depths"))
    found = [next(confirmed) if one is None else one for one in matched]
    if len(inputs.levels) > 1:
        known = [index for index in everything if found[index] is None]
        task.map(Task(_propose, shared), known, "looking for planes")
        task.map(Task(_fill_plain_areas, shared), known, "filling plain areas")
    return found


def _needs_coarser(task: DepthTask, inputs: _Inputs) -> bool:
    """Return whether much of the photos may have depths that full size does not show."""
    shares = task.map(Task(_open_share, Shared(inputs)), range(len(task.views)), "looking for what is left open")
    known = [share for share in shares if share is not None]
    return bool(known) and float(np.mean(known)) >= MOST_OPEN


def _open_share(inputs: Shared[_Inputs], index: int) -> float | None:
    view, store = inputs.value.levels[0][index], inputs.value.store
    return open_share(store.photo(view), store.read_estimate(view)) if store.has(view, "photometric") else None


def _match(inputs: Shared[_Inputs], level: int, index: int) -> Rejected | None:
    """Match a photo with its neighbors at one level."""
    task = inputs.value
    views, options = task.levels[level], task.options
    view = views[index]
    if task.store.has(view, "photometric"):
        return None
    candidates = [views[other] for other in task.ranked[index]]
    try:
        found = match_depths(view, candidates, task.store.photo, options.neighbors, task.tolerance(level))
    except FAILURES as err:
        return Rejected(f"the computation failed: {error_reason(err)}")
    if isinstance(found, Rejected):
        return found
    task.store.write_estimate(view, found)
    return None


def _confirm(inputs: Shared[_Inputs], usable: NDArray[np.bool_], index: int) -> Rejected | None:
    """Keep the depths of a photo that others confirm, and fill in those of coarser levels."""
    task = inputs.value
    view = task.levels[0][index]
    if task.store.has(view, "geometric"):
        return None
    found = _confirm_level(task, 0, usable, index)
    for level in range(1, len(task.levels)):
        coarse = _confirm_level(task, level, usable, index)
        if not isinstance(coarse, Rejected):
            fine = DepthMap.unknown(view) if isinstance(found, Rejected) else found
            # at half the size, what may be a sky looks like a plain wall
            blank = blank_areas(task.store.photo(view), fine.depth).blank
            found = fill_from_coarse(
                fine, view, coarse, task.levels[level][index], near_pixels(blank, fine.depth.shape)
            )
    if isinstance(found, Rejected):
        return found
    task.store.write_maps(view, found)
    return None


def _propose(inputs: Shared[_Inputs], index: int) -> None:
    """Keep planes for the plain areas of a photo, but for what may be a sky; where that fails, none."""
    task = inputs.value
    view, store = task.levels[0][index], task.store
    if not store.has(view, "proposed"):
        photo, depth = store.photo(view), store.read_depth(view, "geometric")
        try:
            proposed = propose_planes(depth, photo, task.tolerance(1))
        except FAILURES:  # plain areas stay open
            proposed = np.zeros_like(depth)
        proposed[near_pixels(blank_areas(photo, depth).blank, depth.shape)] = 0
        store.write_proposal(view, proposed)


def _fill_plain_areas(inputs: Shared[_Inputs], index: int) -> None:
    """Fill the plain areas of a photo with the planes that others propose, too; once more changes nothing."""
    task = inputs.value
    views, store = task.levels[0], task.store

    view, near = views[index], [views[other] for other in task.ranked[index]]
    proposed = store.read_depth(view, "proposed")
    if not proposed.any():
        return
    maps = store.read_maps(view)
    others = [
        (other, store.read_depth(other, "geometric"), store.read_depth(other, "proposed"))
        for other in near
        if store.has(other, "proposed")
    ]
    agreed = agreed_proposals(view, (maps.depth, proposed), others, task.tolerance(1))
    store.write_maps(view, add_depths(maps, agreed, view))


def _confirm_level(task: _Inputs, level: int, usable: NDArray[np.bool_], index: int) -> DepthMap | Rejected:
    views, store = task.levels[level], task.store
    view = views[index]
    if not store.has(view, "photometric"):
        return Rejected("no depth map of this size")
    others = [
        (views[other], store.read_depth(views[other]))
        for other in task.ranked[index]
        if usable[other] and store.has(views[other], "photometric")
    ]
    estimate, photo = store.read_estimate(view), store.photo(view)
    try:
        return confirm_depths(view, photo, estimate, others, task.options.min_agreeing, task.tolerance(level))
    except FAILURES as err:
        return Rejected(f"the computation failed: {error_reason(err)}")
