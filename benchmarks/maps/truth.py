"""The true orthophoto and heights of a scene on the pixels of a raster, and errors of a raster against them."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.common.results import Row
from sfm_app.synthetic.render import GAMMA, PreparedScene, cast_rays, is_sunlit, shade

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

ORIGIN = np.array([320000.0, 5400000.0, 500.0])
"""Of the scene on the map: UTM has the scale 1 there."""
ABOVE_M = 100.0
"""Where rays begin, above everything."""
STRONG = (120.0, 240.0)
"""Canny's thresholds in gray levels: edges that a person sees."""
REACH_PX, STEP_PX = 6.0, 0.25
"""Half length of the profiles across an edge, and their step."""
MOST_SHIFT_PX = 4.0
ALIKE = 0.7
"""Least correlation of two profiles that show the same edge."""
MOST_EDGES = 20_000
JUMP_M, NEAR_PX = 1.0, 4
"""A roof's edge has a step of this height in so many pixels."""
TOLERANCE_PX = 1.5
"""Error of a height that passes, in pixels: what we want of the DSM."""


@dataclass(frozen=True, slots=True, eq=False)
class TrueMap:
    """What a perfect raster shows."""

    gray: NDArray[np.float32]
    heights: FloatArray
    """(H, W) on the map; NaN beside the scene."""


def true_map(scene: PreparedScene, left: float, top: float, pixel: float, size: tuple[int, int]) -> TrueMap:
    """Render a scene from above, by 2 x 2 parallel rays for each pixel of a raster (height, width) on the map."""
    height, width = size
    total, heights = np.zeros((height * width, 3)), np.full(height * width, np.nan)
    down = np.tile([0.0, -1.0, 0.0], (height * width, 1))
    for dy, dx in ((0.25, 0.25), (0.25, 0.75), (0.75, 0.25), (0.75, 0.75)):
        hits, lit = _cast(scene, left, top, pixel, size, (dx, dy))
        shade(
            (down, hits["primitive_ids"], hits["primitive_uvs"], np.full(len(down), pixel), lit),
            (scene.faces, scene.vertex_table, scene.face_material, scene.materials, scene.lights),
            total,
        )
    middle, _ = _cast(scene, left, top, pixel, size, (0.5, 0.5))
    seen = np.isfinite(middle["t_hit"])
    heights[seen] = ABOVE_M - middle["t_hit"][seen] + ORIGIN[2]
    colors = 255.0 * np.clip(total / 4.0, 0.0, 1.0) ** (1.0 / GAMMA)
    gray = cv2.cvtColor(colors.reshape(height, width, 3).astype(np.float32), cv2.COLOR_RGB2GRAY)
    return TrueMap(np.asarray(gray, np.float32), heights.reshape(height, width))


def _cast(
    scene: PreparedScene, left: float, top: float, pixel: float, size: tuple[int, int], offset: tuple[float, float]
) -> tuple[dict[str, NDArray[np.generic]], BoolArray]:
    x, y = np.meshgrid(np.arange(size[1]) + offset[0], np.arange(size[0]) + offset[1])
    east, north = left + pixel * x.ravel() - ORIGIN[0], top - pixel * y.ravel() - ORIGIN[1]
    origin = np.column_stack([east, np.full(len(east), ABOVE_M), -north])
    down = np.tile([0.0, -1.0, 0.0], (len(east), 1))
    hits = cast_rays(scene.rays, origin, down)
    return hits, is_sunlit(scene, origin, down, hits)


def edge_errors(gray: NDArray[np.float32], covered: BoolArray, truth: TrueMap, seed: int = 0) -> Row:
    """Return how far edges of an orthophoto are off across their direction, in pixels: on the ground, and of roofs.

    Moved: of all edges, after the shift that fits best, which is the error of the place.
    """
    edges = cv2.Canny(truth.gray.astype(np.uint8), *STRONG, L2gradient=True) > 0
    margin = round(REACH_PX + MOST_SHIFT_PX)
    inside = cv2.erode(covered.astype(np.uint8), np.ones((2 * margin + 1,) * 2)) > 0
    inside[:margin], inside[-margin:], inside[:, :margin], inside[:, -margin:] = False, False, False, False
    rows, columns = np.nonzero(edges & inside)
    some = np.random.default_rng(seed).permutation(len(rows))[:MOST_EDGES]
    rows, columns = rows[some], columns[some]
    dx, dy = (cv2.Sobel(truth.gray, cv2.CV_64F, *order)[rows, columns] for order in ((1, 0), (0, 1)))
    length = np.maximum(np.hypot(dx, dy), 1e-9)
    along = np.arange(-REACH_PX - MOST_SHIFT_PX, REACH_PX + MOST_SHIFT_PX + 1e-6, STEP_PX)
    x, y = (
        columns[:, None] + dx[:, None] / length[:, None] * along,
        rows[:, None] + dy[:, None] / length[:, None] * along,
    )
    ours, true = (_profiles(image, x, y) for image in (gray, truth.gray))
    shifts, alike = _shifts(ours, true)
    highest = cv2.dilate(truth.heights, np.ones((2 * NEAR_PX + 1,) * 2))
    lowest = cv2.erode(truth.heights, np.ones((2 * NEAR_PX + 1,) * 2))
    roof = (highest - lowest)[rows, columns] > JUMP_M
    figures: Row = {"edges": len(rows), "found %": 100.0 * float(alike.mean())}
    across = np.column_stack([dx, dy]) / length[:, None]
    moved = np.linalg.lstsq(across[alike], shifts[alike], rcond=None)[0]
    figures["edges moved 90 %"] = float(np.quantile(np.abs(shifts - across @ moved)[alike], 0.9))
    for name, own in (("edges", alike & ~roof), ("roofs", alike & roof)):
        sizes = np.abs(shifts[own])
        figures |= {f"{name} median": float(np.median(sizes)), f"{name} 90 %": float(np.quantile(sizes, 0.9))}
    return figures


def _profiles(image: NDArray[np.float32], x: FloatArray, y: FloatArray) -> FloatArray:
    values = cv2.remap(image, x.astype(np.float32), y.astype(np.float32), cv2.INTER_CUBIC)
    return np.asarray(np.gradient(values.astype(np.float64), axis=1))


def _shifts(ours: FloatArray, true: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the shift of each profile in pixels by the largest correlation, and whether that is large enough."""
    most = round(MOST_SHIFT_PX / STEP_PX)
    core = true[:, most:-most]
    core = core / np.linalg.norm(core, axis=1, keepdims=True).clip(1e-9)
    scores = []
    for shift in range(2 * most + 1):
        part = ours[:, shift : shift + core.shape[1]]
        scores.append((part * core).sum(axis=1) / np.linalg.norm(part, axis=1).clip(1e-9))
    table = np.stack(scores, axis=1)
    best = table.argmax(axis=1)
    at = best.clip(1, 2 * most - 1)
    row = np.arange(len(table))
    low, middle, high = table[row, at - 1], table[row, at], table[row, at + 1]
    bend = np.minimum(low - 2.0 * middle + high, -1e-9)
    peak = at + np.clip(0.5 * (low - high) / bend, -1.0, 1.0)
    return (peak - most) * STEP_PX, (table.max(axis=1) > ALIKE) & (best > 0) & (best < 2 * most)


def height_errors(heights: FloatArray, truth: TrueMap, pixel: float) -> Row:
    """Return how far heights are off, in pixels, also after their median is subtracted, and how far the ground bends.

    The dome is the height of the paraboloid that fits the errors below 10 pixels, over the half diagonal.
    """
    there, seen = np.isfinite(truth.heights), np.isfinite(heights)
    error = (heights - truth.heights) / pixel
    both = there & seen
    y, x = np.mgrid[-1.0 : 1.0 : heights.shape[0] * 1j, -1.0 : 1.0 : heights.shape[1] * 1j]
    own = both & (np.abs(error) < 10.0)
    terms = np.column_stack([np.ones(own.sum()), x[own], y[own], (x[own] ** 2 + y[own] ** 2) / 2.0])
    dome = np.linalg.lstsq(terms, error[own], rcond=None)[0][3]
    return {
        "covered %": 100.0 * float(both.sum() / there.sum()),
        f"within {TOLERANCE_PX} px %": 100.0 * float((np.abs(error[both]) <= TOLERANCE_PX).mean()),
        "moved": 100.0 * float((np.abs(error[both] - np.median(error[both])) <= TOLERANCE_PX).mean()),
        "height median": float(np.median(error[both])),
        "height |90 %|": float(np.quantile(np.abs(error[both]), 0.9)),
        "dome": float(dome),
    }
