"""The plane that most points of a scene lie on, among planes of a given inclination."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.unit_vectors import axis_angle_deg, component_along, normalize, smallest_eigenvector

FloatArray = NDArray[np.float64]

TRIPLES, MOST_POINTS = 1000, 4000
"""Number of samples of three points, and of the points that score them."""

INLIER_DISTANCE = 0.01
"""Points within this share of the scene's size lie on the plane."""

LEAST_SHARE = 0.15
"""A plane needs this share of the points."""


@dataclass(frozen=True, slots=True, eq=False)
class Plane:
    """A plane that many points lie on."""

    normal: FloatArray
    """(3,) unit vector on the side of the given axis."""
    share: float
    """Share of the points that lie on it, 0 to 1."""
    deviation_deg: float
    """Standard deviation of the normal, from the scatter of the points."""


def dominant_plane(points: FloatArray, axis: FloatArray, between_deg: tuple[float, float]) -> Plane | None:
    """Find the plane with most points whose normal is at a given angle to an axis: floors (0, 20), walls (80, 90).

    RANSAC with a fixed seed, then least squares on the points near the plane; None if no plane has enough of them.

    Args:
        points: (N, 3), of any scale.
        axis: (3,) unit vector.
        between_deg: least and largest angle between normal and axis, in degrees in [0, 90].
    """
    rng = np.random.default_rng(0)
    cloud = points[rng.permutation(len(points))[:MOST_POINTS]]
    if len(cloud) < 10:
        return None
    center = np.median(cloud, axis=0)
    reach = INLIER_DISTANCE * float(np.percentile(np.linalg.norm(cloud - center, axis=1), 80))
    best, most = None, LEAST_SHARE * len(cloud)
    for triple in rng.integers(0, len(cloud), (TRIPLES, 3)):
        a, b, c = cloud[triple]
        normal = normalize(np.cross(b - a, c - a))
        if not normal.any() or not between_deg[0] <= axis_angle_deg(normal, axis) <= between_deg[1]:
            continue
        near = np.abs(component_along(cloud - a, normal)) < reach
        if np.count_nonzero(near) > most:
            best, most = near, float(np.count_nonzero(near))
    return None if best is None else _fit_plane(cloud[best], axis, float(best.mean()))


def _fit_plane(points: FloatArray, axis: FloatArray, share: float) -> Plane:
    spread = points - points.mean(axis=0)
    scatter = np.einsum("ni,nj->ij", spread, spread)
    small, middle, _ = np.linalg.eigvalsh(scatter)
    # rounding leaves the least eigenvalue of points on one plane below zero
    deviation = np.degrees(np.arctan2(np.sqrt(max(small, 0.0) / len(points)), np.sqrt(max(middle, 1e-30))))
    return Plane(smallest_eigenvector(scatter, axis), share, float(deviation))
