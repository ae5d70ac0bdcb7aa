"""Areas without texture: walls, which have a surface, and skies, which have none; walls are filled with planes."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.view import GrayImage
from sfm_app.types.arrays import BoolArray, DepthArray, FloatArray, IndexArray


@dataclass(frozen=True, slots=True)
class PlainAreaOptions:
    """What distinguishes walls from skies, and when the depths of an area lie on a plane."""

    close_px: int = 9
    """Side of the square that decides whether a pixel is known. Chosen by hand."""
    least_share: float = 0.1
    """Least share of known pixels in it, against single known pixels by chance. Chosen by hand."""
    min_sides: int = 3
    """Least number of the four sides of a pixel with known pixels. Chosen on `garden` and `ornament`."""
    blank_correlation: float = 0.1
    """Correlation below which photos are unrelated; noise alone reaches half of it."""
    speck_px: int = 5
    """Side of the square for majority voting, because noise correlates by chance in places."""
    min_share: float = 0.03
    """Least confirmed share of a wall; other photos confirm a twelfth or more of it, but a hundredth of a sky."""
    far_share: float = 0.02
    """Distance in longer sides over which matching extends sure depths; `garden` and `ornament` have a hundredth."""
    least_far_px: int = 100
    """Fewest pixels beyond this distance that distinguish a wall from a sky. Chosen by hand."""
    blur_px: float = 1.5
    """Standard deviation of the blur before the gradient of the photo."""
    max_slope: float = 2.5
    """Largest gradient of the blurred photo within an area, in gray levels per pixel."""
    min_area: float = 0.002
    """Smallest area, as a share of the photo; the surface reconstruction closes smaller gaps."""
    min_known: float = 0.1
    """Least share of an area that has a depth."""
    min_on_plane: float = 0.8
    """Least share of the known depths that lie on the plane."""
    samples: int = 100
    """Random triples of pixels that propose a plane."""
    sampled_pixels: int = 2000
    """Pixels that vote about a proposed plane."""
    cells: int = 6
    """Cells along each side of an area: averages of known depths in cells separate curvature from noise."""
    cell_pixels: int = 25
    """Fewest known depths of a cell."""
    max_bend: float = 0.3
    """Largest root mean square of the cells' mean residuals, in tolerances."""


OPTIONS = PlainAreaOptions()


def enclosed_pixels(known: BoolArray) -> BoolArray:
    """Mark pixels with known ones on three of their four sides: depths may be interpolated, but not extrapolated."""
    share = cv2.blur(known.astype(np.float32), (OPTIONS.close_px, OPTIONS.close_px))
    dense = (share >= OPTIONS.least_share).view(np.uint8)
    sides = np.zeros(known.shape, np.uint8)
    for axis in (0, 1):
        sides += np.maximum.accumulate(dense, axis=axis)
        sides += np.flip(np.maximum.accumulate(np.flip(dense, axis), axis=axis), axis)
    return np.asarray(sides >= OPTIONS.min_sides)


# Semi-global matching extends depths from the borders into both kinds of area in the same way in every photo, so
# photos taken close to each other agree. They agree across a whole wall, but only along the rim of a sky.


def plain_walls(weak: BoolArray, confirmed: BoolArray) -> BoolArray:
    """Mark areas of weak texture, (H, W), with confirmed depths far from all sure depths."""
    smooth = cv2.medianBlur(weak.view(np.uint8), OPTIONS.speck_px)
    count, areas = cv2.connectedComponents(smooth, connectivity=4)
    sure = confirmed & ~weak
    distance = cv2.distanceTransform(1 - sure.view(np.uint8), cv2.DIST_L2, 3)
    far = distance > OPTIONS.far_share * max(weak.shape)
    size = np.bincount(areas[far], minlength=count)
    share = np.bincount(areas[far], confirmed[far], count) / np.maximum(size, 1)
    wall = (size >= OPTIONS.least_far_px) & (share >= OPTIONS.min_share)
    wall[0] = False  # label 0: everything that has texture
    return np.asarray(wall)[areas]


def surfaceless_areas(confidence: NDArray[np.float32], confirmed: BoolArray) -> BoolArray:
    """Mark blank areas, (H, W), with almost no confirmed depths; the confidence is 0 where there is no depth."""
    blank = cv2.medianBlur((confidence < OPTIONS.blank_correlation).view(np.uint8), OPTIONS.speck_px)
    count, areas = cv2.connectedComponents(blank, connectivity=4)
    size = np.maximum(np.bincount(areas.ravel(), minlength=count), 1)
    share = np.bincount(areas.ravel(), confirmed.ravel(), count) / size
    share[0] = 1.0  # label 0: everything that is not blank
    return np.asarray(share < OPTIONS.min_share)[areas]


# Areas of uniform color whose known depths lie on one plane are filled with that plane.
# Areas of one color cannot be matched: their depths are sparse and noisy. Flat objects are often painted uniformly,
# so a plane is more accurate than depths of single pixels (Gallup, Frahm, Pollefeys: Piecewise planar and non-
# planar stereo for urban scene reconstruction. CVPR 2010). Planes are not extrapolated beyond the known depths;
# skies have none.


def fill_planar_areas(depth: DepthArray, image: GrayImage, tolerance: float, walls: BoolArray) -> DepthArray:
    """Replace depths in areas of uniform color by planes, within the convex hull of the known depths.

    Outside `walls`, planes fill only enclosed pixels: an area of a wall's color may be the sky beside it. `tolerance`
    is the largest relative difference of depths that agree.
    """
    bridged = depth.copy()
    labels, stats = uniform_areas(image)
    for label in range(1, len(stats)):
        left, top, width, height, area = stats[label]
        if area < OPTIONS.min_area * image.size:
            continue
        box = np.s_[top : top + height, left : left + width]
        _fill_area(bridged[box], labels[box] == label, tolerance, walls[box])
    return bridged


def uniform_areas(image: GrayImage) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Label areas of uniform color: (H, W) their numbers, 0 for none, and OpenCV's (N, 5) boxes and sizes."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), OPTIONS.blur_px)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125))
    uniform = np.asarray(slope < OPTIONS.max_slope)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(uniform.view(np.uint8), connectivity=4)
    return np.asarray(labels, np.int32), np.asarray(stats, np.int32)


def _fill_area(depth: DepthArray, area: BoolArray, tolerance: float, walls: BoolArray) -> None:
    """Replace the depths of an area, in its bounding box, if they lie on a plane."""
    known = area & (depth > 0)
    if np.count_nonzero(known) < max(OPTIONS.min_known * np.count_nonzero(area), OPTIONS.cell_pixels):
        return
    row, col = np.nonzero(known)
    A = np.asarray(np.column_stack([np.ones(len(row)), col, row]), np.float64)
    inverse = np.asarray(1.0 / depth[known], np.float64)
    plane = consensus_plane(A, inverse, tolerance)
    residual = A @ plane / inverse - 1.0
    on_plane = np.abs(residual) < tolerance
    bend = _bend(row[on_plane], col[on_plane], residual[on_plane], depth.shape)
    if np.mean(on_plane) < OPTIONS.min_on_plane or bend > OPTIONS.max_bend * tolerance:
        return
    certain = np.zeros(depth.shape, np.bool_)
    certain[row[on_plane], col[on_plane]] = True
    row, col = np.nonzero(area & convex_hull(certain) & (walls | enclosed_pixels(certain)))
    depth[row, col] = 1.0 / (plane[0] + plane[1] * col + plane[2] * row)


def convex_hull(pixels: BoolArray) -> BoolArray:
    """Mark the pixels (H, W) within the convex hull of marked pixels (H, W), at least one."""
    row, col = np.nonzero(pixels)
    within = np.zeros(pixels.shape, np.uint8)
    cv2.fillConvexPoly(within, cv2.convexHull(np.column_stack([col, row]).astype(np.int32)), 1)
    return within > 0


def consensus_plane(A: FloatArray, inverse: FloatArray, tolerance: float) -> FloatArray:
    """Estimate inverse depth (N,) as a linear function of 1, column and row (N, 3), by consensus within a tolerance."""
    rng = np.random.default_rng(0)
    voters = rng.integers(0, len(A), OPTIONS.sampled_pixels)
    triples = rng.integers(0, len(A), (OPTIONS.samples, 3))
    triples = triples[np.abs(np.linalg.det(A[triples])) >= 1.0]  # the others are collinear
    best = np.array([np.median(inverse), 0.0, 0.0])
    if len(triples):
        planes = np.linalg.solve(A[triples], inverse[triples][..., None])[..., 0]
        agreeing = np.count_nonzero(np.abs(A[voters] @ planes.T / inverse[voters, None] - 1.0) < tolerance, axis=0)
        if agreeing.any():
            best = planes[np.argmax(agreeing)]
    for _ in range(3):
        agrees = np.abs(A @ best / inverse - 1.0) < tolerance
        if np.count_nonzero(agrees) < 3:
            break
        best = np.linalg.lstsq(A[agrees], inverse[agrees], rcond=None)[0]
    return np.asarray(best)


def _bend(row: IndexArray, col: IndexArray, residual: FloatArray, shape: tuple[int, ...]) -> float:
    """Return the root mean square of the cells' mean residuals."""
    cells = OPTIONS.cells
    cell = row * cells // shape[0] * cells + col * cells // shape[1]
    count = np.bincount(cell, minlength=cells**2)
    full = count >= OPTIONS.cell_pixels
    means = np.bincount(cell, residual, cells**2)[full] / count[full]
    return float(np.sqrt(np.mean(means**2))) if len(means) else np.inf
