"""Compare a surface with the true one: accuracy, and completeness over the places that the photos see."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.results import Row
from sfm_app.synthetic.compare import align_centers, sample_surface, scene_size, surface_distances
from sfm_app.synthetic.photo_folder import Truth
from sfm_app.synthetic.render import cast_rays, ray_caster
from sfm_app.types import Surface
from sfm_app.types.scene import camera_center

FloatArray = NDArray[np.float64]
ACCURATE, COMPLETE, FINE = 0.005, 0.01, 0.001
"""Distance limits of accuracy, of completeness and of "right in detail", in sizes of the scene."""
SAMPLES = 40_000
"""Number of points that a surface is sampled at, evenly over its area."""
SEEN_BY = 2
"""Least number of photos that see a place whose surface is required: depth takes two."""
GRAZING_DEG = 80.0
"""A place viewed at more than this angle to its normal does not count as seen."""
HIDDEN = 2e-3
"""Largest distance behind the first surface on a ray at which a place counts as seen, in sizes of the scene."""


def truth_scores(surface: Surface, centers: Mapping[str, FloatArray], truth: Truth, seen: FloatArray) -> Row:
    """Return accuracy, completeness, F, median distance and the share that is right in detail, all in percent.

    Args:
        surface: in the frame of the reconstruction; moved onto the truth by the camera centers.
        centers: (3,) by photo name in that frame.
        truth: truth of the rendered photos.
        seen: (N, 3) places of the true surface from `seen_places`.
    """
    names = ("accuracy %", "completeness %", "F %", "median %", "within 0.1 %")
    if not len(surface.faces):
        return dict.fromkeys(names)
    size, aligned = scene_size(truth), align_centers(centers, truth)(surface.vertices)
    to_truth = surface_distances(sample_surface(aligned, surface.faces, SAMPLES)[0], truth.vertices, truth.faces) / size
    to_found = surface_distances(seen, aligned, surface.faces) / size
    accuracy, completeness = float(np.mean(to_truth <= ACCURATE)), float(np.mean(to_found <= COMPLETE))
    both = 2.0 * accuracy * completeness / max(accuracy + completeness, 1e-9)
    values = (accuracy, completeness, both, float(np.median(to_truth)), float(np.mean(to_truth <= FINE)))
    return {name: round(100.0 * value, 3) for name, value in zip(names, values, strict=True)}


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """Places, and how photos see them."""

    places: FloatArray
    """(N, 3)."""
    count: NDArray[np.int64]
    """(N,) photos that see each: in frame, in front, not hidden, and not at a grazing angle."""
    steepest_deg: FloatArray
    """(N,) largest angle between the horizontal plane and the ray of such a photo; 0 where none sees the place."""


def seen_places(truth: Truth, photos: int = SEEN_BY, samples: int = 3 * SAMPLES) -> FloatArray:
    """Sample places of the true surface, evenly over its area, that enough photos see: in frame, in front, not hidden.

    Args:
        truth: truth of the rendered photos.
        photos: least number of photos.
        samples: number of samples over the whole surface, unseen parts included.
    """
    found = sights_of(truth, *sample_with_normals(truth, samples))
    return found.places[found.count >= photos]


def sights_of(
    truth: Truth,
    places: FloatArray,
    normals: FloatArray | None,
    slack: FloatArray | None = None,
    depths: tuple[float, float] = (0.0, np.inf),
) -> Sights:
    """Return how photos see places.

    Args:
        truth: truth of the rendered photos.
        places: (N, 3).
        normals: (N, 3) unit normals of the surface there; None where a place is seen from all sides.
        slack: (N,) how far behind the first surface on a ray a place still counts as seen; a small one if None.
        depths: range of the depth in which places count as seen.
    """
    caster = ray_caster(truth.vertices, truth.faces)
    slack = np.full(len(places), HIDDEN * scene_size(truth)) if slack is None else slack
    counted, steepest = np.zeros(len(places), np.int64), np.zeros(len(places))
    for name, pose in truth.cam_from_world.items():
        center, camera = camera_center(pose), truth.cameras[name]
        x = places @ pose[:, :3].T + pose[:, 3]
        plane = x[:, :2] / np.maximum(x[:, 2:], 1e-9)
        plane = plane * (1.0 + camera.radial * (plane**2).sum(axis=1, keepdims=True))
        pixel = plane * np.diag(camera.K)[:2] + camera.K[:2, 2]
        within = (x[:, 2] > depths[0]) & (x[:, 2] <= depths[1])
        within &= ((pixel >= 0) & (pixel <= [camera.width, camera.height])).all(axis=1)
        ways = places - center
        distance = np.linalg.norm(ways, axis=1)
        if normals is not None:
            within &= -(ways * normals).sum(axis=1) > np.cos(np.radians(GRAZING_DEG)) * distance
        asked = np.flatnonzero(within)
        # the ray directions have the length of the distance, so t_hit is in units of it
        first = cast_rays(caster, center, ways[asked])["t_hit"].astype(np.float64) * distance[asked]
        shown = asked[first >= distance[asked] - slack[asked]]
        counted[shown] += 1
        angle = np.degrees(np.arcsin(np.clip(-ways[shown, 1] / distance[shown], -1.0, 1.0)))
        steepest[shown] = np.maximum(steepest[shown], angle)
    return Sights(places, counted, steepest)


def sample_with_normals(truth: Truth, samples: int) -> tuple[FloatArray, FloatArray]:
    """Sample points on the true surface, evenly over its area, with the normals of their triangles.

    Args:
        truth: truth of the rendered photos.
        samples: number of points.
    """
    places, face = sample_surface(truth.vertices, truth.faces, samples)
    corners = truth.vertices[truth.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit = cross / np.maximum(np.linalg.norm(cross, axis=1, keepdims=True), 1e-12)
    return places, unit[face]
