"""Volumes of a surface above and below a plane, within a polygon."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.frame.sighted_points import Sightlines, place_covariance
from sfm_app.geometry.raster import NOTHING, draw
from sfm_app.types import Surface
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

CELLS = 500
"""Heights along the longer side of the polygon. Chosen by hand: the sum over a cone is then exact to 0.01 %."""
SAMPLES, EDGE_SAMPLES = 25, 100
"""Places at which the surface's deviation is found, and heights along an edge. Chosen by hand."""
CRACKS = 1e-4
"""Largest share of cells without surface that is taken as cracks between triangles. By definition: rounding."""
FLAT = 1e-6
"""Largest width of corners that lie on a line, relative to their length. By definition: rounding."""


@dataclass(frozen=True, slots=True)
class Volume:
    """Volumes between a surface and a plane within a polygon, in cubes of the unit of the exported files."""

    cut: float
    """Of what lies above the plane, >= 0; above is the side of the cameras."""
    fill: float
    """Of what is missing below the plane, >= 0."""
    cut_deviation: float
    """Standard deviations; they exclude the deviation of an arbitrary unit."""
    fill_deviation: float
    net_deviation: float
    area: float
    """Of the polygon in the plane, in squares of the unit."""
    missing: float
    """Share of the area that has no surface; it counts with the heights beside it."""
    metric: bool
    """Whether the unit is the meter."""

    @property
    def net(self) -> float:
        """What lies above the plane less what is missing below it."""
        return self.cut - self.fill

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        volumes = {"cut": self.cut, "fill": self.fill, "net": self.net}
        deviations = {
            "cut_deviation": self.cut_deviation,
            "fill_deviation": self.fill_deviation,
            "net_deviation": self.net_deviation,
        }
        others = {"area": self.area, "missing_percent": round(100 * self.missing, 2)}
        return volumes | deviations | others | {"unit": "meter" if self.metric else "arbitrary"}


def measure_volume(corners: FloatArray, surface: Surface, model: Sightlines, deviation: float | None) -> Volume:
    """Return the volumes between a surface and the plane through corners (N, 3) of a polygon by least squares.

    All are in the frame of exported files, whose unit has a relative `deviation`, None if arbitrary. The surface that
    counts is the first from the cameras' side along the plane's normal. The deviations cover the depths of surface
    and corners by the photos that see them, as one error of all places together; the edge; the unit; and the parts
    without surface. A ValueError says why there is no polygon, or no surface in it.
    """
    axes, middle = _plane_axes(corners, model)
    flat = (corners - middle) @ axes.T
    _check_simple(flat[:, :2])
    low, reach = flat[:, :2].min(axis=0), np.ptp(flat[:, :2], axis=0)
    cell = float(reach.max()) / CELLS
    shape = tuple(int(np.ceil(side / cell)) for side in reach[::-1])
    heights = _heights((surface.vertices - middle) @ axes.T, surface.faces, low, cell, shape)
    places = np.stack(np.meshgrid(*(0.5 + np.arange(size) for size in shape[::-1])), axis=-1) * cell + low
    inside = _inside(places, flat[:, :2])
    seen = inside & np.isfinite(heights)
    if not seen.any():
        raise ValueError("the model has no surface in the polygon")
    missing = 1.0 - float(seen.sum() / inside.sum())
    missing = missing if missing > CRACKS else 0.0
    heights = _fill_holes(heights)
    area, step = _area(flat[:, :2]), _area(flat[:, :2]) / int(inside.sum())
    each = heights[inside]

    spread = float(np.ptp(heights[seen]))  # what is not seen may be as high as the highest place, or as low
    errors = _Errors(corners, flat, axes[2], model)
    shown = np.column_stack([places[seen], heights[seen]]) @ axes + middle
    sigma = errors.surface_sigma(shown)
    edges = heights[_edge_cells(flat[:, :2], low, cell, shape)]
    values, deviations = list[float](), list[float]()
    for sign, clip in ((1.0, True), (-1.0, True), (1.0, False)):
        value = step * float(np.maximum(sign * each, 0.0).sum() if clip else each.sum())
        part = places[inside][sign * each > -sigma] if clip else places[inside]
        edge = np.maximum(sign * edges, 0.0) if clip else np.abs(edges)
        variance = (
            (step * len(part)) ** 2 * (sigma**2 + errors.plane_variance(part))
            + errors.edge_variance(edge.mean(axis=1))
            + (missing * area * spread / 2) ** 2
            + (3 * value * (deviation or 0.0)) ** 2
        )
        values.append(value)
        deviations.append(float(np.sqrt(variance)))
    (cut, fill, _), (of_cut, of_fill, of_net) = values, deviations
    return Volume(cut, fill, of_cut, of_fill, of_net, area, missing, deviation is not None)


class _Errors:
    """Errors of the surface, the plane and the edge, by the photos that see them."""

    def __init__(self, corners: FloatArray, flat: FloatArray, normal: FloatArray, model: Sightlines) -> None:
        self._flat, self._normal, self._model = flat, normal, model
        covariances = np.array([place_covariance(corner, model) for corner in corners])
        upwards = covariances @ normal @ normal
        # in the plane, both directions together
        self._aside = np.sqrt(np.maximum(np.trace(covariances, axis1=1, axis2=2) - upwards, 0.0))
        design = self._design(flat[:, :2])
        solve = np.linalg.pinv(design)
        self._plane = solve * upwards @ solve.T

    @staticmethod
    def _design(places: FloatArray) -> FloatArray:
        return np.column_stack([np.ones(len(places)), places])

    def surface_sigma(self, places: FloatArray) -> float:
        """Return the deviation of heights at places (N, 3) on the surface."""
        few = places[np.linspace(0, len(places) - 1, min(SAMPLES, len(places))).astype(int)]
        variances = [place_covariance(one, self._model) @ self._normal @ self._normal for one in few]
        return float(np.sqrt(np.mean(variances)))

    def plane_variance(self, places: FloatArray) -> float:
        """Return the variance of the mean height of the plane over places (N, 2) in it."""
        mean = self._design(places).mean(axis=0) if len(places) else np.zeros(3)
        return float(mean @ self._plane @ mean)

    def edge_variance(self, heights: FloatArray) -> float:
        """Return the variance of a volume by the corners' places in the plane, from mean heights (N,) on the edges."""
        xy = self._flat[:, :2]
        walls = heights * np.linalg.norm(np.roll(xy, -1, axis=0) - xy, axis=1)
        return float(np.sum((self._aside * (walls + np.roll(walls, 1)) / 2) ** 2))


def _plane_axes(corners: FloatArray, model: Sightlines) -> tuple[FloatArray, FloatArray]:
    """Return the plane's axes (3, 3), two in it and the normal towards the cameras, and a point (3,) of it."""
    middle = corners.mean(axis=0)
    _, sizes, axes = np.linalg.svd(corners - middle)
    if len(corners) < 3 or sizes[1] <= FLAT * sizes[0]:
        raise ValueError("a polygon has three or more corners that do not lie on a line")
    normal = axes[2] if axes[2] @ (model.centers.mean(axis=0) - middle) > 0 else -axes[2]
    return np.array([axes[0], np.cross(normal, axes[0]), normal]), middle


def _area(polygon: FloatArray) -> float:
    """Return the area of a polygon (N, 2)."""
    x, y = polygon.T
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def _check_simple(polygon: FloatArray) -> None:
    """Raise a ValueError if edges of a polygon (N, 2) cross."""

    def side(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    ends = np.roll(polygon, -1, axis=0)
    for i, (a, b) in enumerate(zip(polygon, ends, strict=True)):
        for c, d in zip(polygon[i + 1 :], ends[i + 1 :], strict=True):
            if side(a, b, c) * side(a, b, d) < 0 and side(c, d, a) * side(c, d, b) < 0:
                raise ValueError("the edges of the polygon cross: name the corners in order around it")


def _inside(places: FloatArray, polygon: FloatArray) -> BoolArray:
    """Return which places (H, W, 2) lie in a polygon (N, 2), by the edges that a ray to the right crosses."""
    x, y, inside = places[..., 0], places[..., 1], np.zeros(places.shape[:2], bool)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if ay != by:
            inside ^= ((ay > y) != (by > y)) & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return inside


def _heights(
    vertices: FloatArray, faces: IndexArray, low: FloatArray, cell: float, shape: tuple[int, ...]
) -> FloatArray:
    """Return the heights (H, W) of a surface at the middles of cells; NaN where none, or its back, is seen from above.

    Vertices (V, 3) are x, y and height; `low` (2,) is the corner of the cell 0, 0.
    """
    base = float(vertices[:, 2].min()) - 1.0
    pixels = np.column_stack([(vertices[:, :2] - low) / cell, vertices[:, 2] - base])
    pixels[:, 1] = shape[0] - pixels[:, 1]  # rows of a photo run down
    height, face = np.zeros(shape, np.float32), np.full(shape, NOTHING, np.int32)
    draw(pixels, faces, height, face)
    return np.where(face == NOTHING, np.nan, height.astype(np.float64) + base)[::-1]


def _fill_holes(heights: FloatArray) -> FloatArray:
    """Return heights with the nearest known ones where they are NaN."""
    from scipy.ndimage import distance_transform_edt  # takes long to load

    unknown = np.isnan(heights)
    nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return np.asarray(heights[tuple(nearest)])


def _edge_cells(
    polygon: FloatArray, low: FloatArray, cell: float, shape: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns (N, EDGE_SAMPLES) of cells along the edges of a polygon (N, 2)."""
    share = np.linspace(0.0, 1.0, EDGE_SAMPLES)[None, :, None]
    along = (1 - share) * polygon[:, None] + share * np.roll(polygon, -1, axis=0)[:, None]
    columns, rows = np.moveaxis(((along - low) / cell).astype(np.int64), -1, 0)
    return np.clip(rows, 0, shape[0] - 1), np.clip(columns, 0, shape[1] - 1)
