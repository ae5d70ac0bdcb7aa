"""Photos that see the same place if their model is right, and what they have in common.

A street that a look-alike holds on top of another one fits all matches that were found. What gives it away is what was
not found: photos of both streets stand at the same place, look the same way, and share no point (Zach et al. 2010,
Heinly et al. 2014 look for such missing matches between pairs of photos).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.models.model import focal_px, posed_images
from sfm_app.colmap.types import Camera, Reconstruction, all_points
from sfm_app.posegraph.coverage import CELLS, cell_numbers
from sfm_app.posegraph.look_alikes import LEAST_CELLS
from sfm_app.posegraph.missing import MIN_CELL_POINTS, is_matched_again, is_well_inside
from sfm_app.types import PairId

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Mask = NDArray[np.bool_]

CANDIDATES = 40
"""Photos nearby with which a photo may meet. Chosen by hand."""
MOST_TURN_DEG = 45.0
"""Largest angle between the mean viewing rays of photos that are compared. Chosen by hand."""
LEAST_PHOTOS = 3
"""Photos that have to see a point before another one is expected to: two may agree by chance."""
LEAST_DISTANCE = 1e-12
"""Distances are at least this, so that they divide."""
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
    focal_px: float
    pose: FloatArray
    """(3, 4) camera from world."""
    center: FloatArray
    rows: IndexArray
    """(N,) numbers of its points, ascending."""
    reach: FloatArray
    """By cell, how far away what it sees there is; -1 where it sees nothing."""
    firm: IndexArray
    """(M,) numbers of the points that others see, too."""
    rays: FloatArray
    """(M, 3) from its center to them, of length 1."""
    distances: FloatArray
    """(M,) from its center to them."""


def find_meetings(model: Reconstruction) -> dict[PairId, Meeting]:
    """Return by pair what photos that stand side by side and look the same way have in common.

    Args:
        model: with poses and points.
    """
    with translate_errors("reading points"):
        points, sights = _read_sights(model)
        found: dict[PairId, list[int]] = {}
        for photo, other in _neighbors(sights):
            expected, shared = _compare(sights[photo], sights[other], points)
            if expected >= LEAST_CELLS:
                sums = found.setdefault((min(photo, other), max(photo, other)), [0, 0])
                sums[0] += expected
                sums[1] += shared
    return {pair: Meeting(*sums) for pair, sums in sorted(found.items())}


def _read_sights(model: Reconstruction) -> tuple[FloatArray, dict[int, Sight]]:
    """Return the points (P, 3) of a model, and by id its posed photos that see points which others see, too."""
    stored = sorted(all_points(model), key=lambda item: item[0])
    points = np.array([point.xyz for _, point in stored], np.float64).reshape(-1, 3)
    often = np.array([point.track.length() >= LEAST_PHOTOS for _, point in stored], np.bool_)
    keys, found = np.array([key for key, _ in stored], np.int64), {}
    for image in posed_images(model):
        seen = image.get_observation_points2D()
        rows, first = np.unique(np.searchsorted(keys, [one.point3D_id for one in seen]), return_index=True)
        if often[rows].any():
            x = np.array([one.xy for one in seen], np.float64)[first]
            found[image.image_id] = _look(model, image.image_id, (rows, x), points, often[rows])
    return points, found


def _look(
    model: Reconstruction, photo: int, seen: tuple[IndexArray, FloatArray], points: FloatArray, often: Mask
) -> Sight:
    """Return what a photo sees: rows of points (N,) at pixels (N, 2), of which others often see some, too."""
    image = model.images[photo]
    camera, (rows, x) = model.cameras[image.camera_id], seen
    center = np.asarray(image.projection_center(), np.float64)
    rays = points[rows] - center
    distances = np.maximum(np.linalg.norm(rays, axis=1), LEAST_DISTANCE)
    cells = cell_numbers(x, camera.width, camera.height)
    reach = np.full((CELLS + 1) ** 2, -1.0)
    for cell in np.unique(cells):
        reach[cell] = np.median(distances[cells == cell])
    return Sight(
        camera, focal_px(model, photo), np.asarray(image.cam_from_world().matrix()), center, rows, reach,
        rows[often], (rays / distances[:, None])[often], distances[often],
    )  # fmt: skip


def _neighbors(sights: Mapping[int, Sight]) -> Iterator[PairId]:
    """Yield photos with others nearby that look the same way; some of these where there are many."""
    if not sights:
        return
    photos, seers = list(sights), list(sights.values())
    tree = KDTree(np.array([sight.center for sight in seers]))
    directions = np.array([sight.rays.mean(axis=0) for sight in seers])
    directions /= np.maximum(np.linalg.norm(directions, axis=1), LEAST_DISTANCE)[:, None]
    for number, sight in enumerate(seers):
        near = np.array(sorted(tree.query_ball_point(sight.center, float(np.median(sight.distances)))), np.int64)
        near = near[(directions[near] @ directions[number] > np.cos(np.radians(MOST_TURN_DEG))) & (near != number)]
        chosen = near[np.unique(np.linspace(0, len(near) - 1, min(CANDIDATES, len(near))).astype(np.int64))]
        yield from ((photos[number], photos[other]) for other in chosen)


def _compare(here: Sight, there: Sight, points: FloatArray) -> tuple[int, int]:
    """Count the cells of a photo in which it should see points of another one, and those in which it does."""
    away = points[here.firm] - there.center
    lengths = np.maximum(np.linalg.norm(away, axis=1), LEAST_DISTANCE)
    smaller = lengths / here.distances * here.focal_px / there.focal_px
    again = is_matched_again(smaller, (here.rays * away).sum(axis=1) / lengths)
    rows, lengths = here.firm[again], lengths[again]
    inside = points[rows] @ there.pose[:, :3].T + there.pose[:, 3]
    x = np.asarray(there.camera.img_from_cam(inside), np.float64).reshape(-1, 2)
    shown = is_well_inside(x, there.camera.width, there.camera.height)
    rows, cells = rows[shown], cell_numbers(x[shown], there.camera.width, there.camera.height)
    open_ = lengths[shown] < BEHIND * there.reach[cells]
    rows, cells = rows[open_], cells[open_]
    expected, counts = np.unique(cells, return_counts=True)
    expected = expected[counts >= MIN_CELL_POINTS]
    hit = cells[np.isin(rows, there.rows, assume_unique=True)]
    return len(expected), int(np.count_nonzero(np.isin(expected, hit)))
