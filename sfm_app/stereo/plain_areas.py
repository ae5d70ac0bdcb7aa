"""Areas without texture: they get planes that their surroundings and other photos propose."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.stereo.view import DepthArray, GrayImage
from sfm_app.types.arrays import FloatArray

# What lies between known pixels, and not beyond them: depths may be interpolated, but not extrapolated.
#
# A sky of the color of the wall beside it, and a plain wall of which little is known, look alike but for this.

CLOSE_PX, LEAST_SHARE = 9, 0.1
"""Side of a square, and the share of it that has to be known, so that chance counts nothing. Chosen by hand."""
MIN_SIDES = 3
"""Of the four sides of a pixel, those on which something has to be known. Chosen on `garden` and `ornament`."""


def enclosed_pixels(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark pixels (H, W) with known ones on at least three of their four sides, at any distance.

    Args:
        known: (H, W).
    """
    around = (cv2.blur(known.astype(np.float32), (CLOSE_PX, CLOSE_PX)) >= LEAST_SHARE).view(np.uint8)
    sides = np.zeros(known.shape, np.uint8)
    for axis in (0, 1):
        sides += np.maximum.accumulate(around, axis=axis)
        sides += np.flip(np.maximum.accumulate(np.flip(around, axis), axis=axis), axis)
    return np.asarray(sides >= MIN_SIDES)


# Textureless areas of a photo: plain walls, which have a surface, and skies, which have none.
#
# Semi-global matching extends depths from the borders into both kinds of area in the same way in every photo, so
# photos taken close to each other agree. They agree across a whole wall, but only along the rim of a sky.

BLANK_CORRELATION = 0.1
"""Correlation below which photos are unrelated; noise alone reaches half of it."""
SPECK_PX = 5
"""Side of the square for majority voting, because noise correlates by chance in places."""
MIN_SHARE = 0.03
"""Other photos confirm a twelfth or more of a wall, but at most a hundredth of a sky."""

FAR_SHARE = 0.02
"""Distance from the nearest sure depth, in longer sides of the photo, over which semi-global matching carries depths
on. Chosen on `garden` and `ornament`, where it is a hundredth, with `corner` left out."""
LEAST_FAR_PX = 100
"""Fewest pixels farther away that tell a wall from a sky. Chosen by hand."""


def plain_walls(weak: NDArray[np.bool_], confirmed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark areas of weak texture, (H, W), that other photos confirm far from all sure depths, too.

    Args:
        weak: (H, W) where there is hardly any texture.
        confirmed: (H, W) whether enough other photos confirm the depth.
    """
    smooth = cv2.medianBlur(weak.view(np.uint8), SPECK_PX)
    count, areas = cv2.connectedComponents(smooth, connectivity=4)
    sure = confirmed & ~weak
    away = cv2.distanceTransform(1 - sure.view(np.uint8), cv2.DIST_L2, 3)
    far = away > FAR_SHARE * max(weak.shape)
    size = np.bincount(areas[far], minlength=count)
    share = np.bincount(areas[far], confirmed[far], count) / np.maximum(size, 1)
    wall = (size >= LEAST_FAR_PX) & (share >= MIN_SHARE)
    wall[0] = False  # label 0: everything that has texture
    return np.asarray(wall)[areas]


def surfaceless_areas(confidence: NDArray[np.float32], confirmed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark blank areas of which almost nothing is confirmed, (H, W).

    Args:
        confidence: (H, W) in [0, 1], 0 where there is no depth.
        confirmed: (H, W) whether enough other photos confirm the depth.
    """
    blank = cv2.medianBlur((confidence < BLANK_CORRELATION).view(np.uint8), SPECK_PX)
    count, areas = cv2.connectedComponents(blank, connectivity=4)
    size = np.maximum(np.bincount(areas.ravel(), minlength=count), 1)
    share = np.bincount(areas.ravel(), confirmed.ravel(), count) / size
    share[0] = 1.0  # label 0: everything that is not blank
    return np.asarray(share < MIN_SHARE)[areas]


# Plain walls: areas of uniform color whose known depths lie on one plane are filled with that plane.
#
# Areas of one color cannot be matched: their depths are sparse and noisy. Flat objects are often painted uniformly,
# so a plane is more accurate than depths of single pixels (Gallup, Frahm, Pollefeys: Piecewise planar and non-
# planar stereo for urban scene reconstruction. CVPR 2010). Planes are not extrapolated beyond the known depths;
# skies have none.

BLUR_PX = 1.5
MAX_SLOPE = 2.5
"""Largest gradient of the blurred photo within an area, in gray levels per pixel."""
MIN_AREA = 0.002
"""Smallest area, as a share of the photo; the surface reconstruction closes smaller gaps."""
MIN_KNOWN = 0.1
"""Least share of an area that has a depth."""
MIN_ON_PLANE = 0.8
"""Least share of the known depths that lie on the plane."""
SAMPLES, SAMPLED_PIXELS = 100, 2000
CELLS = 6
"""Cells along each side of an area: averages of known depths in cells separate curvature from noise."""
CELL_PIXELS = 25
MAX_BEND = 0.3
"""Largest root mean square of the cells' mean residuals, in tolerances."""


def fill_planar_areas(depth: DepthArray, image: GrayImage, tolerance: float, walls: NDArray[np.bool_]) -> DepthArray:
    """Replace depths in areas of uniform color by planes, within the convex hull of the known depths.

    Outside walls, only between known depths: what has the color of a wall may be the sky beside it.

    Args:
        depth: (H, W) depths that other photos confirm, 0 where unknown.
        image: (H, W) the photo.
        tolerance: largest relative difference of depths that agree.
        walls: (H, W) what is known to be a wall.

    Returns:
        (H, W) depth, unchanged in other areas.
    """
    bridged = depth.copy()
    labels, stats = uniform_areas(image)
    for label in range(1, len(stats)):
        left, top, width, height, area = stats[label]
        if area < MIN_AREA * image.size:
            continue
        box = np.s_[top : top + height, left : left + width]
        _fill_area(bridged[box], labels[box] == label, tolerance, walls[box])
    return bridged


def uniform_areas(image: GrayImage) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return (H, W) the numbers of areas of uniform color, 0 for none, and OpenCV's (N, 5) boxes and sizes of them."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR_PX)
    slope = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125))
    uniform = np.asarray(slope < MAX_SLOPE)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(uniform.view(np.uint8), connectivity=4)
    return np.asarray(labels, np.int32), np.asarray(stats, np.int32)


def _fill_area(depth: DepthArray, area: NDArray[np.bool_], tolerance: float, walls: NDArray[np.bool_]) -> None:
    """Replace the depths of an area, in its bounding box, if they lie on a plane."""
    known = area & (depth > 0)
    if np.count_nonzero(known) < max(MIN_KNOWN * np.count_nonzero(area), CELL_PIXELS):
        return
    row, col = np.nonzero(known)
    A = np.asarray(np.column_stack([np.ones(len(row)), col, row]), np.float64)
    inverse = np.asarray(1.0 / depth[known], np.float64)
    plane = consensus_plane(A, inverse, tolerance)
    residual = A @ plane / inverse - 1.0
    on_plane = np.abs(residual) < tolerance
    bend = _bend(row[on_plane], col[on_plane], residual[on_plane], depth.shape)
    if np.mean(on_plane) < MIN_ON_PLANE or bend > MAX_BEND * tolerance:
        return
    certain = np.zeros(depth.shape, np.bool_)
    certain[row[on_plane], col[on_plane]] = True
    row, col = np.nonzero(area & convex_hull(certain) & (walls | enclosed_pixels(certain)))
    depth[row, col] = 1.0 / (plane[0] + plane[1] * col + plane[2] * row)


def convex_hull(pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mark the pixels (H, W) within the convex hull of some.

    Args:
        pixels: (H, W), at least one.
    """
    row, col = np.nonzero(pixels)
    within = np.zeros(pixels.shape, np.uint8)
    cv2.fillConvexPoly(within, cv2.convexHull(np.column_stack([col, row]).astype(np.int32)), 1)
    return within > 0


def consensus_plane(A: FloatArray, inverse: FloatArray, tolerance: float) -> FloatArray:
    """Estimate inverse depth as a linear function of column and row, (3,), by consensus of the pixels.

    Args:
        A: (N, 3) one, column and row of each pixel.
        inverse: (N,) inverse depths.
        tolerance: largest relative difference of depths that agree.
    """
    rng = np.random.default_rng(0)
    some, triples = rng.integers(0, len(A), SAMPLED_PIXELS), rng.integers(0, len(A), (SAMPLES, 3))
    triples = triples[np.abs(np.linalg.det(A[triples])) >= 1.0]  # the others are collinear
    best = np.array([np.median(inverse), 0.0, 0.0])
    if len(triples):
        planes = np.linalg.solve(A[triples], inverse[triples][..., None])[..., 0]
        agreeing = np.count_nonzero(np.abs(A[some] @ planes.T / inverse[some, None] - 1.0) < tolerance, axis=0)
        if agreeing.any():
            best = planes[np.argmax(agreeing)]
    for _ in range(3):
        agrees = np.abs(A @ best / inverse - 1.0) < tolerance
        if np.count_nonzero(agrees) < 3:
            break
        best = np.linalg.lstsq(A[agrees], inverse[agrees], rcond=None)[0]
    return np.asarray(best)


def _bend(row: NDArray[np.int64], col: NDArray[np.int64], residual: FloatArray, shape: tuple[int, ...]) -> float:
    """Return the root mean square of the cells' mean residuals."""
    cell = row * CELLS // shape[0] * CELLS + col * CELLS // shape[1]
    count = np.bincount(cell, minlength=CELLS**2)
    full = count >= CELL_PIXELS
    means = np.bincount(cell, residual, CELLS**2)[full] / count[full]
    return float(np.sqrt(np.mean(means**2))) if len(means) else np.inf
