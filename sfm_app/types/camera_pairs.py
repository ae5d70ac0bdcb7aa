"""Pairs of photos with their data: the input of calibrators."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sfm_app.types.matches import PairId


@dataclass(frozen=True, slots=True, eq=False)
class CameraPairs:
    """Fundamental matrices of pairs with the same camera, and data of each pair.

    Nothing is checked here: a calibrator refuses malformed values with a ValueError, see `selfcal.inputs.prepare`.
    """

    Fs: NDArray[np.float64]
    """(P, 3, 3) in pixels, x2' F x1 = 0, any scale."""
    weights: NDArray[np.float64]
    """(P,) >= 0, weight of each F."""
    size: tuple[int, int]
    """(width, height) of the photos in pixels."""
    photos: tuple[PairId, ...] = ()
    """Per pair the ids of its two photos; empty where they are unknown."""
    inliers: tuple[NDArray[np.float64], ...] = ()
    """Per pair (N, 4) x1, y1, x2, y2 in pixels: the matches behind F; empty where only the Fs are known."""
    focal_hints_px: tuple[float, ...] = field(default=())
    """Focal lengths claimed by EXIF, in pixels, one per photo that has one; hints, never trusted."""

    @classmethod
    def from_Fs(cls, Fs: ArrayLike, size: tuple[int, int], weights: ArrayLike | None = None) -> "CameraPairs":
        """Make pairs from matrices alone.

        Args:
            Fs: (P, 3, 3) in pixels, x2' F x1 = 0, any scale.
            size: width and height of the photos in pixels.
            weights: (P,) >= 0; None for equal weights.
        """
        matrices = np.asarray(Fs, np.float64)
        return cls(matrices, np.ones(len(matrices)) if weights is None else np.asarray(weights, np.float64), size)


@dataclass(frozen=True, slots=True, eq=False)
class PhotoPairs:
    """All pairs of a set of photos, which may be of several cameras."""

    Fs: NDArray[np.float64]
    """(P, 3, 3) in pixels, x2' F x1 = 0, any scale."""
    weights: NDArray[np.float64]
    """(P,) >= 0, weight of each F."""
    photos: tuple[PairId, ...]
    """Per pair the ids of its two photos."""
    inliers: tuple[NDArray[np.float64], ...]
    """Per pair (N, 4) x1, y1, x2, y2 in pixels."""
    sizes: Mapping[int, tuple[int, int]]
    """(width, height) in pixels by photo."""
    groups: Mapping[int, str]
    """By photo the group that is assumed to share one camera."""
    focal_hints_px: Mapping[int, float] = field(default_factory=dict)
    """Claimed focal (EXIF) by photo, where there is one."""
    padded_sizes: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    """By photo with bars the size including the bars; `sizes` then has that of the picture inside them. Photos that
    bars bring to one size may each be of another camera."""

    def with_origins(self, corners: Mapping[int, tuple[int, int]]) -> "PhotoPairs":
        """Return the pairs with pixels counted from new origins (left, top), given by photo.

        The sizes stay the same.
        """
        if not corners:
            return self
        at = np.array([[corners.get(photo, (0, 0)) for photo in pair] for pair in self.photos]).reshape(-1, 2, 2)
        moves = np.tile(np.eye(3), (len(at), 2, 1, 1))
        moves[:, :, :2, 2] = at
        Fs = moves[:, 1].transpose(0, 2, 1) @ self.Fs @ moves[:, 0]
        inliers = tuple(x - corner.reshape(4) for x, corner in zip(self.inliers, at, strict=True))
        return replace(self, Fs=Fs, inliers=inliers)

    def to_camera_pairs(self, members: Collection[int]) -> CameraPairs:
        """Return the pairs whose photos are both members; all members have one size."""
        wanted = set(members)
        kept = [k for k, pair in enumerate(self.photos) if wanted.issuperset(pair)]
        return CameraPairs(
            Fs=self.Fs[kept].reshape(-1, 3, 3),
            weights=self.weights[kept],
            size=self.sizes[min(wanted)],
            photos=tuple(self.photos[k] for k in kept),
            inliers=tuple(self.inliers[k] for k in kept),
            focal_hints_px=tuple(
                self.focal_hints_px[photo] for photo in sorted(wanted) if photo in self.focal_hints_px
            ),
        )
