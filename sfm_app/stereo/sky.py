"""The sky, detected by parallax, and its outline."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.numerical import local_deviation
from sfm_app.stereo.view import GrayImage, View
from sfm_app.tasks import ParallelMap, Shared, Task
from sfm_app.types.arrays import BoolArray, DepthArray, FloatArray, IndexArray


@dataclass(frozen=True, slots=True)
class SkyOptions:
    """Which areas are blank, which of them are sky, and where the sky ends."""

    longer_side: int = 128
    """Cells along the longer side of a photo. Chosen on `railing`, where twice as many find no more of the sky."""
    window_px: int = 5
    """Side of the square in which gray levels vary little."""
    most_variation: float = 6.0
    """Largest standard deviation of the gray levels in it, mean over a cell. Chosen by hand: skies have 0.3 to 1.2."""
    open_share: float = 0.2
    """Share of the pixels of a cell with a depth below which the cell may be blank. Chosen by hand."""
    known_share: float = 0.5
    """Share of the pixels of a cell with a depth from which the cell is a surface. Chosen by hand."""
    bright_rank: float = 0.75
    """Share of the surfaces in a photo that are darker than a sky; skies have 0.81 or more, the ground 0.0 to 0.4."""
    partners: int = 16
    """Most photos that vote about a photo. Chosen by hand."""
    agreeing: float = 0.85
    """Share of agreeing votes in a scene with a sky. Four sets with a sky have 0.90 or more, others 0.75 or less."""
    doubtful: float = 0.67
    """The same share from which a scene may have a sky. Rendered houses before a sky have 0.75 to 0.81."""
    visible: float = 0.4
    """The same share with occluded views included. Sets with a sky have 0.53 or more, others 0.43 or less."""
    least_visible: float = 0.3
    """The same share for one area; plain walls have 0.1 to 0.2. Chosen on castle-P19."""
    least_share: float = 0.003
    """Least share of the photo for an area at its border that votes about the scene. Chosen by hand."""
    same_place: float = 1e-6
    """Photos nearer than this share of the largest distance are parts of one wide photo. Points with a smaller share of
    the largest depth lie beside a photo or behind it. By definition: rounding."""
    darker: float = 10.0
    """Gray levels by which other parts of the sky, beyond branches, may be darker. Chosen on `railing`."""
    reach: float = 0.02
    """Distance beyond its cells within which a sky ends, in longer sides: matching extends depths as far."""
    tolerance: float = 3.0
    """Largest difference in gray levels from the surrounding sky; real skies vary by 1. Chosen on `railing`."""
    steady: float = 0.3
    """Added to the variance of positions in a slope fit, in squared cells: a row of cells has no slope across it."""
    least_weight: float = 1e-4
    """Least weight of the surrounding sky in an average. By definition: rounding."""


OPTIONS = SkyOptions()


@dataclass(frozen=True, slots=True, eq=False)
class PhotoAreas:
    """A photo in cells, and its blank areas; number 0 is everything else."""

    labels: NDArray[np.uint16]
    """(h, w) number of the area of each cell."""
    known: BoolArray
    """(h, w) cells with depths on at least half of their pixels."""
    size: IndexArray
    """(A,) cells of each area."""
    gray: FloatArray
    """(A,) mean gray level of each area."""
    at_border: BoolArray
    """(A,) areas at the border of the photo."""

    @property
    def blank(self) -> BoolArray:
        """(h, w) cells of all areas."""
        return self.labels > 0


def blank_areas(photo: GrayImage, depth: DepthArray) -> PhotoAreas:
    """Find the bright and even areas of a photo with hardly any depths."""
    variation = local_deviation(photo, OPTIONS.window_px)
    cells, known = to_cells(photo.astype(np.float32)), to_cells((depth > 0).astype(np.float32))
    blank = (known < OPTIONS.open_share) & (to_cells(variation) <= OPTIONS.most_variation)
    labels = cv2.connectedComponents(blank.view(np.uint8), connectivity=4)[1]
    surfaces = known >= OPTIONS.known_share
    levels, mean_gray = np.sort(cells[surfaces]), _mean_gray(labels, cells)
    bright = np.searchsorted(levels, mean_gray) >= max(1.0, OPTIONS.bright_rank * len(levels))
    bright[0] = False
    labels = np.asarray((np.cumsum(bright) * bright)[labels])
    size = np.bincount(labels.ravel())
    at_border = np.zeros(len(size), bool)
    at_border[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
    at_border[0] = False
    return PhotoAreas(labels.astype(np.uint16), surfaces, size, _mean_gray(labels, cells), at_border)


def _mean_gray(labels: NDArray[np.signedinteger], gray: NDArray[np.float32]) -> FloatArray:
    return np.asarray(np.bincount(labels.ravel(), gray.ravel()) / np.maximum(np.bincount(labels.ravel()), 1))


def to_cells(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (h, w) the means over cells of values (H, W)."""
    height, width = values.shape
    scale = min(1.0, OPTIONS.longer_side / max(height, width))
    size = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)


# Blank areas at infinity: other photos show blank areas in the same directions.
# A plain wall moves against the background from photo to photo, a sky does not. Where a nearer object with a depth
# occludes the sky, that photo has no vote.


def spread_partners(views: Sequence[View], index: int) -> list[int]:
    """Return the photos that vote about a photo: they share directions with it, from near and far positions."""
    own = views[index]
    axes, centers = np.stack([view.axis for view in views]), np.stack([view.center for view in views])
    widest = np.array([view.widest_angle for view in views])
    shared = np.arccos(np.clip(axes @ own.axis, -1, 1)) < widest + widest[index]
    distance = np.linalg.norm(centers - own.center, axis=1)
    partners = np.flatnonzero(shared & (distance > OPTIONS.same_place * distance.max()))
    partners = partners[np.argsort(distance[partners], kind="stable")]
    if len(partners) > OPTIONS.partners:
        partners = partners[np.linspace(0, len(partners) - 1, OPTIONS.partners).round().astype(np.int64)]
    return partners.tolist()


def compare_areas(areas: Sequence[PhotoAreas], views: Sequence[View], spread: ParallelMap) -> list[FloatArray]:
    """Return for each photo the votes (3, A) of the others about its blank areas; see `count_votes`."""
    return spread(Task(_count_votes, Shared((areas, views))), range(len(views)), "comparing blank areas")


def _count_votes(photos: Shared[tuple[Sequence[PhotoAreas], Sequence[View]]], index: int) -> FloatArray:
    return count_votes(*photos.value, index)


def count_votes(areas: Sequence[PhotoAreas], views: Sequence[View], index: int) -> FloatArray:
    """Count the votes (3, A) of other photos for each blank area: as blank, as open, as behind a nearer surface."""
    own, view = areas[index], views[index]
    height, width = own.labels.shape
    y, x = np.nonzero(own.blank)
    pixels = np.stack([(x + 0.5) * (view.width / width), (y + 0.5) * (view.height / height), np.ones(len(x))])
    rays = view.R.T @ np.linalg.inv(view.K) @ pixels
    counts = np.zeros((3, len(x)))
    for number in spread_partners(views, index):
        visible, cell = _find_cells(rays, views[number], areas[number].labels.shape)
        blank, known = areas[number].blank[cell], areas[number].known[cell]
        counts[:, visible] += np.stack([blank, ~blank & ~known, known])
    return np.array([np.bincount(own.labels[y, x], row, len(own.size)) for row in counts], np.float64)


def _find_cells(
    rays: FloatArray, view: View, shape: tuple[int, ...]
) -> tuple[BoolArray, tuple[IndexArray, IndexArray]]:
    """Return which directions (3, N) a photo shows, and in which row and column of its cells."""
    u, v, depth = view.K @ view.R @ rays
    ahead = depth > OPTIONS.same_place * np.abs(depth).max(initial=0.0)
    at = np.stack([v, u]) / np.where(ahead, depth, 1.0)
    row, column = np.floor(at * (np.array(shape) / [view.height, view.width])[:, None]).astype(np.int64)
    visible = ahead & (row >= 0) & (column >= 0) & (row < shape[0]) & (column < shape[1])
    return visible, (row[visible], column[visible])


def find_skies(areas: Sequence[PhotoAreas], votes: Sequence[FloatArray]) -> list[BoolArray]:
    """Return the sky cells (h, w) of each photo; none if the votes do not show that the scene has a sky."""
    # a sky needs agreement among the votes, and votes from enough views
    large, (blank, other, nearer) = _count_large(areas, votes)
    if not blank or blank < OPTIONS.agreeing * (blank + other) or blank < OPTIONS.visible * (blank + other + nearer):
        return [np.zeros(one.labels.shape, bool) for one in areas]
    return [_sky_of(*one) for one in zip(areas, votes, large, strict=True)]


def possible_skies(areas: Sequence[PhotoAreas], votes: Sequence[FloatArray]) -> list[BoolArray]:
    """Return the cells (h, w) of each photo that may be sky: blank ones that the votes do not show to be walls."""
    _, (blank, other, _) = _count_large(areas, votes)
    if blank and blank >= OPTIONS.doubtful * (blank + other):
        return [one.blank for one in areas]
    found = []
    for one, vote in zip(areas, votes, strict=True):
        may = vote[0] >= OPTIONS.least_visible * vote.sum(axis=0)  # also where no photo has a vote
        may[0] = False
        found.append(np.asarray(may[one.labels]))
    return found


def _count_large(
    areas: Sequence[PhotoAreas], votes: Sequence[FloatArray]
) -> tuple[list[BoolArray], tuple[float, float, float]]:
    """Return the large areas (A,) of each photo at its border, and the sums of the three kinds of votes about these."""
    large = [one.at_border & (one.size >= OPTIONS.least_share * one.labels.size) for one in areas]
    blank, other, nearer = sum(
        (vote[:, own].sum(axis=1) for vote, own in zip(votes, large, strict=True)), np.zeros(3)
    ).tolist()
    return large, (blank, other, nearer)


def _sky_of(areas: PhotoAreas, votes: FloatArray, large: BoolArray) -> BoolArray:
    """Return the sky cells of a photo: large areas at its border, and other areas as bright as these."""
    far = votes[0] / np.maximum(votes.sum(axis=0), 1) >= OPTIONS.least_visible
    sure = large & far
    if not sure.any():
        return np.zeros(areas.labels.shape, bool)
    sky = far & (sure | (areas.gray >= areas.gray[sure].min() - OPTIONS.darker))
    sky[0] = False
    return np.asarray(sky[areas.labels])


def sky_pixels(photo: GrayImage, cells: BoolArray) -> BoolArray:
    """Mark the pixels (H, W) of the sky: near its cells (h, w), and of its gray level there."""
    if not cells.any():
        return np.zeros(photo.shape, bool)
    expected = cv2.resize(_continue_sky(photo, cells), photo.shape[::-1])
    smooth = cv2.GaussianBlur(photo.astype(np.float32), (3, 3), 0)  # a median would swallow wires
    return np.asarray(near_pixels(cells, photo.shape) & (np.abs(smooth - expected) <= OPTIONS.tolerance))


def near_pixels(cells: BoolArray, shape: tuple[int, ...]) -> BoolArray:
    """Mark the pixels of a photo of a shape (H, W) in cells (h, w) and within reach of them."""
    side = 2 * round(OPTIONS.reach * max(cells.shape)) + 1
    near = cv2.dilate(cells.view(np.uint8), np.ones((side, side), np.uint8))
    return np.asarray(cv2.resize(near, shape[::-1], interpolation=cv2.INTER_NEAREST) > 0)


def _continue_sky(photo: GrayImage, cells: BoolArray) -> NDArray[np.float32]:
    """Return (h, w) the gray level of the surrounding sky, continued along its slope: skies pale downwards."""
    gray = cv2.resize(photo, cells.shape[::-1], interpolation=cv2.INTER_AREA).astype(np.float64)
    y, x = np.mgrid[: cells.shape[0], : cells.shape[1]].astype(np.float64)
    weight = np.maximum(_blur(cells.astype(np.float64)), OPTIONS.least_weight)
    x_mean, y_mean, level = (_blur(cells * values) / weight for values in (x, y, gray))
    # variances and covariances of position and gray level for a plane fit
    xx = _blur(cells * x * x) / weight - x_mean * x_mean + OPTIONS.steady
    yy = _blur(cells * y * y) / weight - y_mean * y_mean + OPTIONS.steady
    xy = _blur(cells * x * y) / weight - x_mean * y_mean
    xg, yg = _blur(cells * x * gray) / weight - x_mean * level, _blur(cells * y * gray) / weight - y_mean * level
    slope_x, slope_y = yy * xg - xy * yg, xx * yg - xy * xg
    slopes = slope_x * (x - x_mean) + slope_y * (y - y_mean)
    return np.asarray(level + slopes / (xx * yy - xy * xy), np.float32)


def _blur(values: FloatArray) -> FloatArray:
    return np.asarray(cv2.GaussianBlur(values, (0, 0), OPTIONS.reach * max(values.shape)), np.float64)
