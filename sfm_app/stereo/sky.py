"""The sky, detected by parallax, and its outline."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.triangles import border_angle
from sfm_app.stereo.view import DepthArray, GrayImage, View

# Blank areas of a photo, each of which may be sky: even, without depths, and brighter than most surfaces.

LONGER_SIDE = 128
"""Cells along the longer side of a photo. Chosen on `railing`, where twice as many find no more of the sky."""
WINDOW_PX = 5
"""Side of the square in which gray levels vary little."""
MOST_VARIATION = 6.0
"""Largest standard deviation of the gray levels in it, as the mean over a cell. Skies of the real sets have 0.3 to 1.2,
noise and compression included; the ground of castle-P19 has 3, plain walls 1 to 2. Chosen by hand."""
OPEN_SHARE, KNOWN_SHARE = 0.2, 0.5
"""Share of the pixels of a cell with a depth: it is open below the first, known from the second. Chosen by hand."""
BRIGHT_RANK = 0.75
"""Share of the surfaces in a photo that are darker than a sky. Chosen on castle-P19 and `garden`, where skies have 1.0
and 0.81 and more, and most of castle-P19's ground and kitchen1000's furniture 0.0 to 0.4."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoAreas:
    """A photo in cells, and its blank areas; number 0 is everything else."""

    labels: NDArray[np.uint16]
    """(h, w) number of the area of each cell."""
    known: NDArray[np.bool_]
    """(h, w) whether at least half of a cell has a depth."""
    size: NDArray[np.int64]
    """(A,) cells of each area."""
    gray: NDArray[np.float64]
    """(A,) mean gray level of each area."""
    at_border: NDArray[np.bool_]
    """(A,) whether an area touches the border of the photo."""

    @property
    def blank(self) -> NDArray[np.bool_]:
        """(h, w) cells of all areas."""
        return self.labels > 0


def blank_areas(photo: GrayImage, depth: DepthArray) -> PhotoAreas:
    """Find the bright and even areas of a photo in which hardly any depth is known.

    Args:
        photo: (H, W).
        depth: (H, W), 0 where unknown.
    """
    gray = photo.astype(np.float32)
    mean = cv2.blur(gray, (WINDOW_PX, WINDOW_PX))
    variation = np.sqrt(np.maximum(cv2.blur(gray * gray, (WINDOW_PX, WINDOW_PX)) - mean * mean, 0))
    cells, known = _to_cells(gray), _to_cells((depth > 0).astype(np.float32))
    blank = (known < OPEN_SHARE) & (_to_cells(variation) <= MOST_VARIATION)
    labels = cv2.connectedComponents(blank.view(np.uint8), connectivity=4)[1]
    surfaces = known >= KNOWN_SHARE
    labels = _keep_bright(labels, cells, np.sort(cells[surfaces]))
    size = np.bincount(labels.ravel())
    at_border = np.zeros(len(size), bool)
    at_border[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
    at_border[0] = False
    return PhotoAreas(labels.astype(np.uint16), surfaces, size, _mean_gray(labels, cells), at_border)


def _keep_bright(
    labels: NDArray[np.int32], gray: NDArray[np.float32], surfaces: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Return the areas that are brighter than most surfaces, numbered from 1; 0 elsewhere.

    Args:
        labels: (h, w) of all areas.
        gray: (h, w) mean gray levels.
        surfaces: (S,) gray levels of what has a depth, ascending.
    """
    bright = np.searchsorted(surfaces, _mean_gray(labels, gray)) >= max(1.0, BRIGHT_RANK * len(surfaces))
    bright[0] = False
    return np.asarray((np.cumsum(bright) * bright)[labels])


def _mean_gray(labels: NDArray[np.signedinteger], gray: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.asarray(np.bincount(labels.ravel(), gray.ravel()) / np.maximum(np.bincount(labels.ravel()), 1))


def _to_cells(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (h, w) the means over cells of values (H, W)."""
    height, width = values.shape
    scale = min(1.0, LONGER_SIDE / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)


# Which blank areas are infinitely far: other photos show something alike in the same directions.
#
# A plain wall moves against the background from photo to photo, a sky does not. Where a sky is hidden, something
# nearer has a depth, and that photo has no vote.

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


# The pixels of a sky, given its cells: up to the outlines of what stands before it.

REACH = 0.02
"""How far beyond its cells a sky is looked for, in longer sides of the photo: as far as semi-global matching carries
depths on. Chosen on `garden` and `ornament`."""
TOLERANCE = 3.0
"""Largest difference in gray levels from the sky around, after noise is smoothed; real skies vary by 1. Chosen on
`railing`, together with the rim."""
NARROW_PX, RIM_PX = 9, 3
"""Width below which a thing before the sky is narrow, and the rim of depths that it keeps on each side: fewer pixels of
depths are too few for a surface. Chosen on `railing`: 72 % of its thin things are found, and 69 % with a rim of 2 and a
tolerance of 4."""
BUMP_PX = 1
"""Beside what is broad, this is a ragged outline and no narrow thing. Chosen on the fisheye demo."""
BLUR_PX = 2
"""Pixels beside a sky that are part sky, part what stands before it; matching gives them depths of their own. Chosen on
castle-P19, where photos that are left out fit 0.15 dB better with 1 and 0.4 dB better with 2; railing was left out."""
STEADY = 0.3
"""Added, in squared cells, to the variance of the places by which the slope of a sky is told: few cells in a row tell
none across it. Chosen on the fisheye demo; railing, garden, courtyard and town were left out: 0.1 to 1 help all."""
LEAST_WEIGHT = 1e-4
"""Of the sky around that is averaged. By definition: rounding."""


def sky_pixels(photo: GrayImage, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark the pixels (H, W) of the sky: near its cells, of the gray level that it has there, and blurred with it.

    Args:
        photo: (H, W).
        cells: (h, w) cells of the sky.
    """
    if not cells.any():
        return np.zeros(photo.shape, bool)
    around = cv2.resize(_continue_sky(photo, cells), photo.shape[::-1])
    smooth = cv2.GaussianBlur(photo.astype(np.float32), (3, 3), 0)  # a median would swallow wires
    sky = near_pixels(cells, photo.shape) & (np.abs(smooth - around) <= TOLERANCE)
    return _widen(sky, BLUR_PX) & ~_find_narrow_rims(sky)


def near_pixels(cells: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Mark the pixels (H, W) in cells and within reach of them.

    Args:
        cells: (h, w).
        shape: (H, W).
    """
    side = 2 * round(REACH * max(cells.shape)) + 1
    near = cv2.dilate(cells.view(np.uint8), np.ones((side, side), np.uint8))
    return np.asarray(cv2.resize(near, shape[::-1], interpolation=cv2.INTER_NEAREST) > 0)


def _continue_sky(photo: GrayImage, cells: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Return (h, w) the gray level of the sky around each cell, continued along its slope: skies pale downwards."""
    gray = cv2.resize(photo, cells.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float64)
    y, x = np.mgrid[: cells.shape[0], : cells.shape[1]].astype(np.float64)
    weight = np.maximum(_blur(cells.astype(np.float64)), LEAST_WEIGHT)
    x_mean, y_mean, level = (_blur(cells * values) / weight for values in (x, y, gray))
    # variances and covariances of place and gray level, as a plane is fitted
    xx = _blur(cells * x * x) / weight - x_mean * x_mean + STEADY
    yy = _blur(cells * y * y) / weight - y_mean * y_mean + STEADY
    xy = _blur(cells * x * y) / weight - x_mean * y_mean
    xg, yg = _blur(cells * x * gray) / weight - x_mean * level, _blur(cells * y * gray) / weight - y_mean * level
    slope_x, slope_y = yy * xg - xy * yg, xx * yg - xy * xg
    slopes = slope_x * (x - x_mean) + slope_y * (y - y_mean)
    return np.asarray(level + slopes / (xx * yy - xy * xy), np.float32)


def _blur(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return sums (h, w) of the values around each cell, those nearby with more weight."""
    return np.asarray(cv2.GaussianBlur(values, (0, 0), REACH * max(values.shape)), np.float64)


def _find_narrow_rims(sky: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark pixels beside things before the sky that are narrow, such as branches: they keep a rim."""
    things = ~sky
    window = np.ones((NARROW_PX, NARROW_PX), np.uint8)
    broad = cv2.morphologyEx(things.view(np.uint8), cv2.MORPH_OPEN, window) > 0
    return _widen(things & ~_widen(broad, BUMP_PX), RIM_PX)


def _widen(mask: NDArray[np.bool_], pixels: int) -> NDArray[np.bool_]:
    """Return the mask with everything that is at most some pixels beside it."""
    side = 2 * pixels + 1
    return np.asarray(cv2.dilate(mask.view(np.uint8), np.ones((side, side), np.uint8)) > 0)
