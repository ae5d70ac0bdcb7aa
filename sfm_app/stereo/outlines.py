"""Outlines of depth maps: which pixels belong to the surface in front, and which to what lies behind.

Windows that reach an object spread its depth over what lies behind, in every photo alike, so that no check between
depth maps removes it. Beside an outline each pixel therefore chooses once more between both surfaces: by its own
difference from the other photos, and by the grays of both surfaces around.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from sfm_app.jit import kernel
from sfm_app.numerical import local_deviation
from sfm_app.stereo.patch_match import BORDER, PhotoStack, PlaneArray, plane_normals, planes_of, stack_photos, warp
from sfm_app.stereo.view import DepthMap, GrayImage, View
from sfm_app.types.arrays import BoolArray, FloatArray

REACH_PX = BORDER + 1
"""A window centered this far from an outline still contains a pixel of the object; on a background without texture that
pixel alone decides."""
DISC = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * REACH_PX + 1, 2 * REACH_PX + 1))
AROUND_PX = 2 * REACH_PX
"""Largest row and column difference of the pixels whose grays describe a surface."""
BEHIND = 0.05
"""Relative difference of nearness beyond which a pixel lies behind another. Chosen by hand: a plane has it within
`REACH_PX` where it is seen at 5 degrees."""
SAME = 0.02
"""Relative difference of nearness within which a pixel keeps its own depth. Chosen by hand."""
PLAIN_GRAY = 8.0
"""Largest standard deviation of the grays of a gap that may be nothing: where matching fails in spite of texture, there
is something. Chosen by hand."""
LEAST_PIXELS = 5
"""Fewest pixels whose grays describe a surface."""
NOISE_GRAY = 3.0
"""Difference from another photo, in gray levels, that is e times less likely: sensor noise and inexact depths."""
WORST_GRAY = 20.0
"""Difference beyond which a pixel is of another surface, no matter how large. Chosen by hand."""
SURE = 0.3
"""Least logarithm of the odds that changes a pixel: alike surfaces keep their outline. Chosen on `railing`."""
SPREAD_GRAY = 8.0
"""Standard deviation of grays around each gray of a surface. Chosen on `garden`: 5 is as good."""
ALIKE = np.exp(-0.5 * (np.arange(256) / SPREAD_GRAY) ** 2)
UNIFORM = SPREAD_GRAY * np.sqrt(2.0 * np.pi) / 256.0
"""Likelihood of a gray of which nothing is known, in the units of `ALIKE`."""
STEPS = np.array(sorted((np.argwhere(DISC) - REACH_PX).tolist(), key=lambda step: step[0] ** 2 + step[1] ** 2))
"""(N, 2) rows and columns of the pixels within reach, nearest first."""


def sharpen_outlines(
    maps: DepthMap, view: View, image: GrayImage, others: Sequence[tuple[View, GrayImage]]
) -> DepthMap:
    """Let each pixel within `REACH_PX` of an outline choose between both surfaces, also where its depth is unknown.

    Behind an object may be nothing: a plain gap without depths that is wider than two rims.
    """
    planes, known = planes_of(maps.depth, maps.normals, view), maps.depth > 0
    plain = local_deviation(image, 3) <= PLAIN_GRAY
    empty = np.asarray(cv2.morphologyEx((plain & ~known).view(np.uint8), cv2.MORPH_OPEN, DISC)).view(np.bool_)
    nearness = planes[..., 0]
    lowest = cv2.erode(np.where(known | empty, nearness, np.float32(np.inf)), DISC, borderType=cv2.BORDER_REPLICATE)
    beside = cv2.dilate(nearness, DISC) > (1.0 + BEHIND) * lowest
    rim = known & (nearness > (1.0 + BEHIND) * lowest)
    chosen, changed = planes.copy(), np.zeros(known.shape, np.bool_)
    _choose(image, planes, (empty, beside, rim), stack_photos(view, others), chosen, changed)
    depth, normals = maps.depth.copy(), maps.normals.copy()
    depth[changed] = np.divide(1.0, chosen[..., 0], out=np.zeros_like(depth), where=chosen[..., 0] > 0)[changed]
    normals[changed] = plane_normals(chosen, view)[changed]
    return DepthMap(depth, normals)


@kernel
def _choose(
    image: GrayImage, planes: PlaneArray, masks: tuple[BoolArray, BoolArray, BoolArray], others: PhotoStack,
    chosen: PlaneArray, changed: BoolArray,
) -> None:  # fmt: skip
    """Fill in the planes that pixels change to; `masks` are (H, W): empty, beside an outline, and in front of one."""
    empty, beside, rim = masks
    height, width = image.shape
    near, far, costs = np.empty(3), np.empty(3), np.empty(len(others[3]))
    for row in range(1, height - 1):
        for col in range(1, width - 1):
            if not beside[row, col] or not _find_both(planes, empty, row, col, near, far):
                continue
            odds = _gray_odds(image, planes, empty, rim, row, col, near, far)
            if far[0] > 0.0:
                odds += _mismatch(image, row, col, near, others, costs) - _mismatch(image, row, col, far, others, costs)
            if not abs(odds) > SURE:  # also where it is nan
                continue
            plane, own = far if odds > 0.0 else near, planes[row, col, 0]
            if own == 0.0 or abs(own - plane[0]) > SAME * plane[0]:
                changed[row, col] = True
                for c in range(3):
                    chosen[row, col, c] = plane[c]


@kernel
def _find_both(planes: PlaneArray, empty: BoolArray, row: int, col: int, near: FloatArray, far: FloatArray) -> bool:
    """Fill in the planes, about a pixel, of the surfaces before and behind the outline; 0 for nothing behind it."""
    height, width, count, is_empty = empty.shape[0], empty.shape[1], 0, False
    for k in range(len(STEPS)):
        down, right = STEPS[k]
        i, j = row + down, col + right
        if not (0 <= i < height and 0 <= j < width):
            continue
        is_empty = is_empty or empty[i, j]
        q, across, along = float(planes[i, j, 0]), float(planes[i, j, 1]), float(planes[i, j, 2])
        here = q - across * right - along * down
        if q <= 0.0 or here <= 0.0:
            continue
        # two surfaces differ at this pixel, and at the other one: slopes are inexact
        there = near[0] + near[1] * right + near[2] * down
        if count == 1 and not (
            abs(here - near[0]) > BEHIND * max(here, near[0]) and abs(q - there) > BEHIND * max(q, there)
        ):
            continue
        plane = near if count == 0 else far
        plane[0], plane[1], plane[2] = here, across, along
        count += 1
        if count == 2:
            break
    if count == 0 or (count == 1 and not is_empty):
        return False
    if count == 1:
        far[:] = 0.0
    elif far[0] > near[0]:
        for c in range(3):
            near[c], far[c] = far[c], near[c]
    return True


@kernel
def _mismatch(image: GrayImage, row: int, col: int, plane: FloatArray, others: PhotoStack, costs: FloatArray) -> float:
    """Return the mean difference of nine pixels from the better half of the other photos, in `NOISE_GRAY`.

    nan where no other photo shows them.
    """
    stack, stride, sizes, projections = others
    count = 0
    for k in range(len(projections)):
        u, v, uu, uv, vu, vv = warp(projections[k], col + 0.5, row + 0.5, plane)
        du, dv = abs(uu) + abs(uv), abs(vu) + abs(vv)
        if not (u - du >= 0.5 and v - dv >= 0.5 and u + du < sizes[k, 1] - 0.5 and v + dv < sizes[k, 0] - 0.5):
            continue  # also where u is nan
        start, total = k * (len(stack) // len(projections)), 0.0
        for down in range(-1, 2):
            for right in range(-1, 2):
                x, y = u - 0.5 + right * uu + down * uv, v - 0.5 + right * vu + down * vv
                j, i = int(x), int(y)
                a, b, four = x - j, y - i, stack[start + i * stride + j]
                upper = (1.0 - a) * np.float64(four & 255) + a * np.float64((four >> 8) & 255)
                lower = (1.0 - a) * np.float64((four >> 16) & 255) + a * np.float64(four >> 24)
                gray = (1.0 - b) * upper + b * lower
                total += min(abs(gray - np.float64(image[row + down, col + right])), WORST_GRAY)
        costs[count] = total / (9.0 * NOISE_GRAY)
        count += 1
    if count == 0:
        return np.nan
    better = np.sort(costs[:count])[: (count + 1) // 2]
    return float(better.mean())


@kernel
def _gray_odds(  # noqa: PLR0913
    image: GrayImage, planes: PlaneArray, empty: BoolArray, rim: BoolArray, row: int, col: int, near: FloatArray,
    far: FloatArray,
) -> float:  # fmt: skip
    """Return the logarithm of the odds of a gray behind the outline to before it; nan where too few pixels tell.

    The rim of the object does not count: it may be of what lies behind. A thin object has nothing else.
    """
    height, width = image.shape
    middle = np.int64(image[row, col])
    behind, before, edge = np.zeros(2), np.zeros(2), np.zeros(2)  # numbers of pixels, and sums of likelihoods
    for i in range(max(row - AROUND_PX, 0), min(row + AROUND_PX + 1, height)):
        for j in range(max(col - AROUND_PX, 0), min(col + AROUND_PX + 1, width)):
            down, right, q = i - row, j - col, planes[i, j, 0]
            if q > 0.0:
                off = abs(q - (near[0] + near[1] * right + near[2] * down))
                off_far = abs(q - (far[0] + far[1] * right + far[2] * down))
                if min(off, off_far) > BEHIND * near[0]:
                    continue
                side = (edge if rim[i, j] else before) if off < off_far else behind
            elif empty[i, j] and far[0] == 0.0:
                side = behind
            else:
                continue
            side[0] += 1.0
            side[1] += ALIKE[abs(np.int64(image[i, j]) - middle)]
    if before[0] < LEAST_PIXELS:
        before += edge
    if min(before[0], behind[0]) < LEAST_PIXELS:
        return np.nan
    odds = (behind[1] + UNIFORM) / (behind[0] + 1.0) * (before[0] + 1.0) / (before[1] + UNIFORM)
    return float(np.log(odds))
