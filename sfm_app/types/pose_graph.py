"""Relative poses of pairs of photos, and the graph that they form."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.types.matches import PairId

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class RelativePose:
    """Pose of view 2 from view 1, with its evidence."""

    R: FloatArray
    """(3, 3) rotation."""
    t: FloatArray
    """(3,) direction of the translation, length 1."""
    inliers: NDArray[np.bool_]
    """(M,) per match of the pair: within the threshold of this pose."""
    angle_deg: float
    """Median triangulation angle of the inliers before both cameras."""
    in_front: float
    """Share of the inliers before both cameras, 0 to 1."""
    kind: str = "calibrated"
    """"calibrated", "uncalibrated" (a camera is a guess: the inliers are those of F), "planar" (all inliers on one
    plane), "rotation" (they show no parallax, so that t means nothing)."""
    guided: bool = False
    """Whether it was found only with the help of other pairs."""

    @property
    def inlier_count(self) -> int:
        """Number of matches that agree with the pose."""
        return int(np.count_nonzero(self.inliers))


@dataclass(frozen=True, slots=True)
class LookAlikes:
    """Pairs of photos that match equal things in two places as if they were one."""

    pairs: tuple[PairId, ...]
    missing: float
    """Share, 0 to 1, of what these pairs would have in common if the places were one, but do not."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseGraph:
    """Pairs whose relative poses agree with each other, and what happened to the others."""

    poses: Mapping[PairId, RelativePose]
    dropped: Mapping[PairId, str]
    """Pairs with an epipolar geometry that were left out, with the reason."""
    groups: tuple[tuple[int, ...], ...]
    """Connected photos, the largest group first."""
    look_alikes: tuple[LookAlikes, ...] = ()
    """Look-alikes that were separated; their pairs are among the dropped ones."""
    doubtful: tuple[LookAlikes, ...] = ()
    """Loops, or look-alikes: pairs that stayed although the photos between theirs do not confirm them."""

    def connected_photos(self, photo: int) -> tuple[int, ...]:
        """Return all photos connected with this one; empty where there are none."""
        return next((group for group in self.groups if photo in group), ())
