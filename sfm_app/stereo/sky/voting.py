"""Which blank areas are infinitely far: other photos show something alike in the same directions.

A plain wall moves against the background from photo to photo, a sky does not. Where a sky is hidden, something nearer
has a depth, and that photo has no vote.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.culling import border_angle
from sfm_app.stereo.sky.areas import PhotoAreas
from sfm_app.stereo.view import View

PARTNERS = 16
"""Photos that vote about a photo. Chosen by hand."""
AGREEING, SEEN = 0.85, 0.4
"""A scene has a sky if this share of the votes agrees, and if there are votes for this share of the views, those in
which something nearer is in front included. Chosen on castle-P19, `railing`, `garden` and `statue` (0.90 and 0.53 or
more), and on books21, lund-door12 and `corner` (0.75 and 0.42, 0.54 and 0.43, 0.67 and 0.09). kitchen1000,
fountain-P11, fox50 and oats23 have 0.55 and 0.05 or less; the skies of reichstag10, of ten days, 0.70 and 0.51."""
LEAST_SEEN = 0.3
"""The same of one area: plain walls of castle-P19 have 0.1 to 0.2. Chosen on castle-P19."""
LEAST_SHARE = 0.003
"""Of the photo, of an area at its border by which skies are told. Chosen by hand."""
SAME_PLACE = 1e-6
"""Photos nearer than this share of the largest distance are parts of one wide photo; what has a smaller share of the
largest depth lies beside a photo or behind it. By definition: rounding."""
DARKER = 10.0
"""Gray levels by which other parts of the sky, beyond branches, may be darker. Chosen on `railing`."""


@dataclass(frozen=True, slots=True, eq=False)
class Votes:
    """What other photos show in the directions of the blank areas of a photo."""

    counts: NDArray[np.float64]
    """(3, A) over the cells of each area: something alike, which is a blank area; something else without a depth; and
    something nearer, with a depth."""

    @property
    def seen(self) -> NDArray[np.float64]:
        """(A,) share of something alike."""
        return np.asarray(self.counts[0] / np.maximum(self.counts.sum(axis=0), 1))


def spread_partners(views: Sequence[View], index: int) -> list[int]:
    """Return the photos that vote about a photo: they look into a part of its directions, from near and from far.

    Args:
        views: all photos.
        index: of the photo.
    """
    own = views[index]
    axes, centers = np.stack([view.R[2] for view in views]), np.stack([view.center for view in views])
    widest = np.array([border_angle(view.K, view.width, view.height) for view in views])
    shared = np.arccos(np.clip(axes @ own.R[2], -1, 1)) < widest + widest[index]
    distance = np.linalg.norm(centers - own.center, axis=1)
    found = np.flatnonzero(shared & (distance > SAME_PLACE * distance.max()))
    found = found[np.argsort(distance[found], kind="stable")]
    if len(found) > PARTNERS:
        found = found[np.linspace(0, len(found) - 1, PARTNERS).round().astype(np.int64)]
    return found.tolist()


def count_votes(areas: Sequence[PhotoAreas], views: Sequence[View], index: int) -> Votes:
    """Count what other photos show in the directions of a photo's blank areas.

    Args:
        areas: of all photos.
        views: all photos.
        index: of the photo.
    """
    own, view = areas[index], views[index]
    height, width = own.labels.shape
    y, x = np.nonzero(own.blank)
    pixels = np.stack([(x + 0.5) * (view.width / width), (y + 0.5) * (view.height / height), np.ones(len(x))])
    rays = view.R.T @ np.linalg.inv(view.K) @ pixels
    counts = np.zeros((3, len(x)))
    for number in spread_partners(views, index):
        seen, cell = _look_along(rays, views[number], areas[number].labels.shape)
        alike, known = areas[number].blank[cell], areas[number].known[cell]
        counts[:, seen] += np.stack([alike, ~alike & ~known, known])
    return Votes(np.stack([np.bincount(own.labels[y, x], row, len(own.size)) for row in counts]))


def _look_along(
    rays: NDArray[np.float64], view: View, shape: tuple[int, ...]
) -> tuple[NDArray[np.bool_], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return which directions (3, N) a photo sees, and in which row and column of its cells."""
    u, v, depth = view.K @ view.R @ rays
    ahead = depth > SAME_PLACE * np.abs(depth).max(initial=0.0)
    at = np.stack([v, u]) / np.where(ahead, depth, 1.0)
    row, column = np.floor(at * (np.array(shape) / [view.height, view.width])[:, None]).astype(np.int64)
    seen = ahead & (row >= 0) & (column >= 0) & (row < shape[0]) & (column < shape[1])
    return seen, (row[seen], column[seen])


def find_skies(areas: Sequence[PhotoAreas], votes: Sequence[Votes]) -> list[NDArray[np.bool_]]:
    """Return the cells (h, w) of each photo that show sky; none where the scene has no sky, or where that is unsure.

    Args:
        areas: of all photos.
        votes: of the other photos.
    """
    large = [one.at_border & (one.size >= LEAST_SHARE * one.labels.size) for one in areas]
    together = sum((vote.counts[:, own].sum(axis=1) for vote, own in zip(votes, large, strict=True)), np.zeros(3))
    alike, other, nearer = together
    if not alike or alike < AGREEING * (alike + other) or alike < SEEN * (alike + other + nearer):
        return [np.zeros(one.labels.shape, bool) for one in areas]
    return [_sky_of(*one) for one in zip(areas, votes, large, strict=True)]


def _sky_of(areas: PhotoAreas, votes: Votes, large: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the cells of a photo that show sky: large areas at its border, and others that are as bright."""
    far = votes.seen >= LEAST_SEEN
    sure = large & far
    if not sure.any():
        return np.zeros(areas.labels.shape, bool)
    sky = far & (sure | (areas.gray >= areas.gray[sure].min() - DARKER))
    sky[0] = False
    return np.asarray(sky[areas.labels])
