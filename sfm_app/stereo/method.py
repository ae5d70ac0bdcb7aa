"""The interface of depth-map methods, and the method that runs on every machine."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sfm_app.numerical import FAILURES, error_reason
from sfm_app.settings import DepthSettings
from sfm_app.stereo.depth import DepthEstimate, DepthMap, confirm_depths, match_depths
from sfm_app.stereo.view import GrayImage, View
from sfm_app.tasks import Shared, Task
from sfm_app.types import Rejected

Kind = Literal["photometric", "geometric"]
"""COLMAP's names for a depth map before and after the check against the other photos."""


class DepthStore(Protocol):
    """Reads photos and keeps maps; a map appears complete or not at all."""

    def photo(self, view: View, /) -> GrayImage:
        """Return the photo without distortion, (H, W)."""

    def has(self, view: View, kind: Kind, /) -> bool:
        """Return whether a map is there.

        Args:
            view: the photo.
            kind: before or after the check against other photos.
        """

    def read_estimate(self, view: View, /) -> DepthEstimate:
        """Return the photometric map."""

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

    def __call__(
        self, function: Callable[[int], Rejected | None], items: Sequence[int], label: str, /
    ) -> list[Rejected | None]: ...


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

    views: Sequence[View]
    ranked: Sequence[Sequence[int]]
    options: DepthSettings
    store: DepthStore


def make_depth_maps_on_cpu(task: DepthTask) -> list[Rejected | None]:
    """Match every photo with its neighbors, then keep what the depth maps of other photos confirm.

    Returns:
        For every view the reason why it has no maps, or None.
    """
    everything = range(len(task.views))
    inputs = Shared(_Inputs(task.views, task.ranked, task.options, task.store))
    matched = task.map(Task(_match, inputs), everything, "matching depths")
    usable = np.array([found is None for found in matched])
    confirm = Task(_confirm, inputs, usable)
    confirmed = iter(task.map(confirm, [index for index in everything if usable[index]], "confirming depths"))
    return [next(confirmed) if found is None else found for found in matched]


def _match(inputs: Shared[_Inputs], index: int) -> Rejected | None:
    task = inputs.value
    view = task.views[index]
    if task.store.has(view, "photometric"):
        return None
    candidates = [task.views[other] for other in task.ranked[index]]
    try:
        found = match_depths(view, candidates, task.store.photo, task.options.neighbors, task.options.consistency)
    except FAILURES as err:
        return Rejected(f"the computation failed: {error_reason(err)}")
    if isinstance(found, Rejected):
        return found
    task.store.write_estimate(view, found)
    return None


def _confirm(inputs: Shared[_Inputs], usable: NDArray[np.bool_], index: int) -> Rejected | None:
    task = inputs.value
    view = task.views[index]
    if task.store.has(view, "geometric"):
        return None
    others = [
        (task.views[other], task.store.read_estimate(task.views[other]).depth)
        for other in task.ranked[index]
        if usable[other]
    ]
    estimate, options = task.store.read_estimate(view), task.options
    photo = task.store.photo(view)
    try:
        found = confirm_depths(view, photo, estimate, others, options.min_agreeing, options.consistency)
    except FAILURES as err:
        return Rejected(f"the computation failed: {error_reason(err)}")
    if isinstance(found, Rejected):
        return found
    task.store.write_maps(view, found)
    return None
