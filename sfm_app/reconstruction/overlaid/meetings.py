"""Photos that see the same place if their model is right, and what they have in common.

A street that a look-alike holds on top of another one fits all matches that were found. What gives it away is what was
not found: photos of both streets stand at the same place, look the same way, and share no point (Zach et al. 2010,
Heinly et al. 2014 look for such missing matches between pairs of photos).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.model import posed_images
from sfm_app.colmap.types import Camera, Reconstruction, all_points
from sfm_app.types import PairId

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

CELLS = 12
"""Cells along the longer side of a photo, as in the look for look-alikes before mapping."""
CANDIDATES = 40
"""Photos nearby with which a photo may meet. Chosen by hand."""
MOST_DEG, MOST_SCALE = 20.0, 1.5
"""Largest change of viewing angle, and of distance, at which a point is matched again, as in `posegraph.missing`."""
MOST_TURN_DEG = 45.0
"""Largest angle between the mean viewing rays of photos that are compared. Chosen by hand."""
BORDER = 0.05
"""Share of width and height: points that project this near the border may be outside, as in `posegraph.missing`."""
LEAST_PHOTOS = 3
"""Photos that have to see a point before another one is expected to: two may agree by chance."""
MIN_CELL_POINTS = 2
"""A cell with fewer expected points expects nothing, as in `posegraph.missing`."""
LEAST_CELLS = 15
"""Least number of expected cells for a photo to meet another one, as for look-alikes before mapping."""
BEHIND = 1.1
"""Points farther away than what a photo sees in a cell, by this factor, may be hidden. Chosen by hand."""


@dataclass(frozen=True, slots=True)
class Meeting:
    """Two photos that see the same place if the model is right."""

    expected: int
    """Cells of either photo in which points of the other one should be seen."""
    shared: int
    """Of these, cells in which a point of both is."""


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """A posed photo and the points that it sees."""

    camera: Camera
    pose: FloatArray
    """(3, 4) camera from world."""
    center: FloatArray
    rows: IndexArray
    """(N,) numbers of its points, ascending."""
    rays: FloatArray
    """(N, 3) from its center to them."""
    distances: FloatArray
    """(N,)"""
    reach: FloatArray
    """By cell, how far away what it sees there is; -1 where it sees nothing."""

    @property
    def direction(self) -> FloatArray:
        """Mean viewing ray, (3,) of length 1."""
        mean = (self.rays / self.distances[:, None]).mean(axis=0)
        return np.asarray(mean / max(float(np.linalg.norm(mean)), 1e-12))


def find_meetings(model: Reconstruction) -> dict[PairId, Meeting]:
    """Return by pair what photos that stand side by side and look the same way have in common.

    Args:
        model: with poses and points.
    """
    with translate_errors("reading points"):
        points, sights = _read_sights(model)
    if not sights:
        return {}
    often = np.bincount(np.concatenate([sight.rows for sight in sights.values()]), minlength=len(points))
    found: dict[PairId, list[int]] = {}
    for photo, other in _neighbors(sights):
        here = sights[photo]
        expected, shared = _compare(here, sights[other], often[here.rows] >= LEAST_PHOTOS, points)
        if expected >= LEAST_CELLS:
            sums = found.setdefault((min(photo, other), max(photo, other)), [0, 0])
            sums[0] += expected
            sums[1] += shared
    return {pair: Meeting(*sums) for pair, sums in sorted(found.items())}


def _read_sights(model: Reconstruction) -> tuple[FloatArray, dict[int, Sight]]:
    """Return the points (P, 3) of a model, and its posed photos that see any by id."""
    numbered = {key: number for number, (key, _) in enumerate(sorted(all_points(model), key=lambda item: item[0]))}
    points = np.array([model.points3D[key].xyz for key in numbered], np.float64).reshape(-1, 3)
    found = {}
    for image in posed_images(model):
        seen = [(numbered[point.point3D_id], point.xy) for point in image.points2D if point.has_point3D()]
        if seen:
            rows = np.array([number for number, _ in seen], np.int64)
            rows, first = np.unique(rows, return_index=True)
            x = np.array([xy for _, xy in seen], np.float64)[first]
            camera = model.cameras[image.camera_id]
            found[image.image_id] = _sight(camera, np.asarray(image.cam_from_world().matrix()), rows, points[rows], x)
    return points, found


def _sight(camera: Camera, pose: FloatArray, rows: IndexArray, points: FloatArray, x: FloatArray) -> Sight:
    center = -pose[:, :3].T @ pose[:, 3]
    rays = points - center
    distances = np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
    cells = _cells(x, camera)
    reach = np.full((CELLS + 1) ** 2, -1.0)
    for cell in np.unique(cells):
        reach[cell] = np.median(distances[cells == cell])
    return Sight(camera, pose, center, rows, rays, distances, reach)


def _cells(x: FloatArray, camera: Camera) -> IndexArray:
    """Return the numbers (N,) of the cells in which pixels (N, 2) of a photo lie."""
    columns, lines = np.clip(x * (CELLS / max(camera.width, camera.height)), 0, CELLS).astype(np.int64).T
    return np.asarray(lines * (CELLS + 1) + columns, np.int64)


def _neighbors(sights: dict[int, Sight]) -> Iterator[PairId]:
    """Yield photos with others nearby that look the same way; some of these where there are many."""
    photos = list(sights)
    tree = KDTree(np.array([sight.center for sight in sights.values()]))
    directions = np.array([sight.direction for sight in sights.values()])
    for number, (photo, sight) in enumerate(sights.items()):
        near = np.array(sorted(tree.query_ball_point(sight.center, float(np.median(sight.distances)))), np.int64)
        alike = directions[near] @ directions[number] > np.cos(np.radians(MOST_TURN_DEG))
        near = near[alike & (near != number)]
        chosen = near[np.unique(np.linspace(0, len(near) - 1, min(CANDIDATES, len(near))).astype(np.int64))]
        yield from ((photo, photos[other]) for other in chosen)


def _compare(here: Sight, there: Sight, often: Mask, points: FloatArray) -> tuple[int, int]:
    """Count the cells of a photo in which it should see points of another one, and those in which it does."""
    rows, rays, distances = here.rows[often], here.rays[often], here.distances[often]
    inside = points[rows] @ there.pose[:, :3].T + there.pose[:, 3]
    away = points[rows] - there.center
    lengths = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
    smaller, cosines = lengths / distances, (rays * away).sum(axis=1) / (distances * lengths)
    alike = (smaller < MOST_SCALE) & (smaller > 1.0 / MOST_SCALE) & (cosines > np.cos(np.radians(MOST_DEG)))
    if not alike.any():
        return 0, 0
    x = np.asarray(there.camera.img_from_cam(inside[alike]), np.float64).reshape(-1, 2)
    size = np.array([there.camera.width, there.camera.height], np.float64)
    with np.errstate(invalid="ignore"):
        shown = ((x > BORDER * size) & (x < (1.0 - BORDER) * size)).all(axis=1)  # NaN where it cannot be seen
    rows, lengths, cells = rows[alike][shown], lengths[alike][shown], _cells(x[shown], there.camera)
    open_ = lengths < BEHIND * there.reach[cells]
    rows, cells = rows[open_], cells[open_]
    expected, counts = np.unique(cells, return_counts=True)
    expected = expected[counts >= MIN_CELL_POINTS]
    hit = cells[np.isin(rows, there.rows, assume_unique=True)]
    return len(expected), int(np.count_nonzero(np.isin(expected, hit)))
