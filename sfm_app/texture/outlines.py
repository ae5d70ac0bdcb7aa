"""A surface as a photo sees it: what it hides, and where the photo shows something else beside outlines.

The outlines of a surface are off by pixels, and photos are blurred: beside an outline a photo may show what lies behind
on the object, or the object on what lies behind. Such foreign pixels get the colors beside them of their own surface.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.jit import kernel
from sfm_app.meshing.agreement import draw
from sfm_app.stereo.outlines import is_like, slope
from sfm_app.texture.views import PhotoView, project
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

JUMP = 0.01
"""Relative depth difference of adjacent pixels on two surfaces. Chosen by hand: a plane has it where it is seen at 2
degrees in a photo of 3 000 pixels."""
REACH = 0.004
"""Distance from an outline up to which pixels may be foreign, in longer sides of the photo: four pixels of a depth map,
as far as windows of matching reach."""
LEAST_REACH_PX = 2
"""Least such distance, because of blur."""
SAME = 0.03
"""Largest relative depth difference within a surface around a pixel. Chosen by hand."""
SAMPLES = 4
"""Pixels between a pixel and each side of the square that is compared with it, as wide as twice the reach."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A surface drawn into a photo."""

    nearness: NDArray[np.float32]
    """(H, W) 1 / depth; 0 without surface."""
    photo: NDArray[np.uint8]
    """(H, W, 3) with the colors of foreign pixels replaced."""
    foreign: BoolArray
    """(H, W)."""


def draw_sight(
    view: PhotoView, photo: NDArray[np.uint8], used: BoolArray | None, vertices: FloatArray, faces: IndexArray
) -> Sight:
    """Draw triangles (T, 3) into a photo (H, W, 3) of the view's size; `used` marks its usable pixels (H, W)."""
    pixels = np.empty((len(vertices), 3))
    _project_all(view.row, vertices, pixels)
    size = view.height, view.width
    nearness, foreign = np.zeros(size, np.float32), np.zeros(size, np.bool_)
    draw(pixels, faces, nearness, np.empty(size, np.int32))
    reach = max(LEAST_REACH_PX, round(REACH * max(size)))
    away = cv2.distanceTransform(1 - _outlines(nearness).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3)
    rim, used = (nearness > 0) & (away < reach), np.ones(size, np.bool_) if used is None else used
    _mark_foreign(nearness, rim, used, cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY), reach, foreign)
    row, col = np.nonzero(foreign)
    order = np.argsort(-away[row, col], kind="stable")
    mended = photo.copy()
    _spread_colors(nearness, foreign | ~used, row[order], col[order], mended)
    return Sight(nearness, mended, foreign)


def _outlines(nearness: NDArray[np.float32]) -> BoolArray:
    """Mark the pixels on both sides of each jump of the depth, (H, W)."""
    marks = np.zeros(nearness.shape, np.bool_)
    for axis in (0, 1):
        one, other = np.moveaxis(nearness, axis, 0)[:-1], np.moveaxis(nearness, axis, 0)[1:]
        jump = np.abs(one - other) > JUMP * np.maximum(one, other)
        np.moveaxis(marks, axis, 0)[:-1] |= jump
        np.moveaxis(marks, axis, 0)[1:] |= jump
    return marks


@kernel
def _project_all(camera: FloatArray, vertices: FloatArray, pixels: FloatArray) -> None:
    """Write pixels x, y and 1 / depth (V, 3) of vertices; the last is -1 of invisible ones."""
    for v in range(len(vertices)):
        pixels[v, 0], pixels[v, 1], depth = project(camera, vertices[v, 0], vertices[v, 1], vertices[v, 2])
        pixels[v, 2] = 1.0 / depth if depth > 0.0 else -1.0


@kernel
def _mark_foreign(
    nearness: NDArray[np.float32],
    rim: BoolArray,
    used: BoolArray,
    gray: NDArray[np.uint8],
    reach: int,
    foreign: BoolArray,
) -> None:
    """Mark pixels of the rim whose gray is likelier beside their surface than on it, each normally distributed."""
    height, width = gray.shape
    sums, step = np.empty((2, 3)), max(2 * reach // SAMPLES, 1)
    for y in range(height):
        for x in range(width):
            if not (rim[y, x] and used[y, x]):
                continue
            near, across, down = nearness[y, x], slope(nearness, y, x, 0, 1), slope(nearness, y, x, 1, 0)
            sums[:] = 0.0
            for k in range(-SAMPLES, SAMPLES + 1):
                for m in range(-SAMPLES, SAMPLES + 1):
                    i, j = y + k * step, x + m * step
                    if not (0 <= i < height and 0 <= j < width and used[i, j]):
                        continue
                    is_own = abs(nearness[i, j] - near - across * m * step - down * k * step) <= SAME * near
                    if is_own and rim[i, j]:
                        continue
                    kind, value = 0 if is_own else 1, float(gray[i, j])
                    sums[kind, 0] += 1.0
                    sums[kind, 1] += value
                    sums[kind, 2] += value * value
            foreign[y, x] = is_like(float(gray[y, x]), sums[1], sums[0])


@kernel
def _spread_colors(
    nearness: NDArray[np.float32], unknown: BoolArray, rows: IndexArray, cols: IndexArray, photo: NDArray[np.uint8]
) -> None:
    """Give unknown pixels (N,), in this order, the mean color of the known neighbors on their surface."""
    height, width = unknown.shape
    for n in range(len(rows)):
        y, x = rows[n], cols[n]
        red, green, blue, count = 0, 0, 0, 0
        for i in range(max(y - 1, 0), min(y + 2, height)):
            for j in range(max(x - 1, 0), min(x + 2, width)):
                is_own = abs(nearness[i, j] - nearness[y, x]) <= SAME * nearness[y, x]
                if is_own and not unknown[i, j]:
                    red += photo[i, j, 0]
                    green += photo[i, j, 1]
                    blue += photo[i, j, 2]
                    count += 1
        if count:
            photo[y, x, 0], photo[y, x, 1], photo[y, x, 2] = red // count, green // count, blue // count
            unknown[y, x] = False


@kernel
def is_hidden(nearness: NDArray[np.float32], x: float, y: float, depth: float, slack: float) -> bool:
    """Return whether all four pixels around a place show something nearer than its depth less a slack."""
    height, width = nearness.shape
    left, top = min(max(int(x - 0.5), 0), width - 1), min(max(int(y - 0.5), 0), height - 1)
    right, below = min(left + 1, width - 1), min(top + 1, height - 1)
    least = min(nearness[top, left], nearness[top, right], nearness[below, left], nearness[below, right])
    return least * (depth - slack) > 1.0
