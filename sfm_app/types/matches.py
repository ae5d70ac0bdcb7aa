"""Keypoints and raw, unverified matches."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.types.photos import Frame, GpsPosition

PairId = tuple[int, int]
"""(image id 1, image id 2) with id1 < id2, ids as in COLMAP's database."""


@dataclass(frozen=True, slots=True)
class MatchedImage:
    """One photo as the match graph knows it."""

    id: int
    name: str
    group: str
    width: int
    height: int
    exif_focal_px: float | None = None
    gps: GpsPosition | None = None
    turn_deg: int = 0
    """Clockwise rotation that makes it upright, according to EXIF and its shape."""
    shown: Frame | None = None
    """The picture inside the bars; None where there are no bars."""
    projection: str = "perspective"
    """"equirectangular" for a panorama, "perspective" for every other photo, also for fisheyes."""
    time_s: float | None = None
    """When it was taken, if it is a frame of a video: seconds from its start."""


@dataclass(frozen=True, slots=True)
class MatchGraph:
    """Photos as nodes, raw matches as edges."""

    images: Mapping[int, MatchedImage]
    keypoints: Mapping[int, NDArray[np.float64]]
    """Per image id: (N, 2) pixels."""
    matches: Mapping[PairId, NDArray[np.uint32]]
    """Per pair: (M, 2) keypoint indices in image 1 and image 2."""

    def points(self, pair: PairId) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the matched points of one pair: x1, x2, each (M, 2) pixels."""
        rows = self.matches[pair]
        return self.keypoints[pair[0]][rows[:, 0]], self.keypoints[pair[1]][rows[:, 1]]
