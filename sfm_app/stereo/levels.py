"""Coarser depth maps, which fill what finer ones leave open.

Plain surfaces show too little at full size: noise hides what texture they have. In a photo of half the size, noise is
half as strong and the windows cover twice as much (Xu and Tao: Multi-scale geometric consistency guided multi-view
stereo. CVPR 2019).
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.depth import WEAK_CORRELATION, DepthEstimate, DepthMap
from sfm_app.stereo.sky import blank_areas, near_pixels
from sfm_app.stereo.view import GrayImage, View

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
