"""A surface of which only points are known, as a depth camera gives them: how far things are from it, and alignment."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sfm_app.geometry.poses import Similarity

FloatArray = NDArray[np.float64]

PLANE_POINTS, PLANE_RADIUS = 96, 0.05
"""Largest number of points that a plane is fitted to, and their largest distance from theirs, in meters. The points of
a depth camera fill a band, which is as thick as depths are noisy; the circle has to be wider than the band is thick.
kitchen1000: the standard deviation across the planes is 1.4 cm in the median, 1.9 cm for 90 %."""
LEAST_POINTS = 6
"""A plane through fewer points says little: the distance is that to the nearest point."""
PATCH = 0.015
"""How far from its point a plane stands for the surface, in meters: the size of a cell of kitchen1000."""
AT_ONCE = 20_000
"""Number of points whose neighbors are in memory at a time."""
PAIR_LIMITS = (0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05)
"""By round of the alignment: largest distance from its plane's point at which a place takes part, in meters."""
KEPT = 0.9
"""Share of these places that an alignment is fitted to: those that are nearest to their planes."""
LEAST_PAIRS = 100
"""Fewer places determine no alignment."""


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """Points of a surface, with the plane through each and its neighbors."""

    points: FloatArray
    """(N, 3) in meters."""
    middles: FloatArray
    """(N, 3) the point moved onto its plane."""
    normals: FloatArray
    """(N, 3) unit normals of the planes, of either sign; zero where there is no plane."""
    roughness: FloatArray
    """(N,) root mean square distance of the neighbors from the plane, in meters; nan where there is none."""
    tree: cKDTree

    @classmethod
    def from_points(cls, points: FloatArray) -> "Scan":
        """Fit a plane to the neighborhood of each point, and again around the middle of the band that it lies in.

        A circle around a point at the face of the band has more points of that face, and so a plane that leans to it.

        Args:
            points: (N, 3) in meters.
        """
        tree = cKDTree(points)
        parts = [_planes(points, tree, slice(k, k + AT_ONCE)) for k in range(0, len(points), AT_ONCE)]
        center, normals, roughness = (np.concatenate(part) for part in zip(*parts, strict=True))
        middles = points - ((points - center) * normals).sum(axis=1, keepdims=True) * normals
        inner = tree.query(middles)[1]
        center, normals, roughness = center[inner], normals[inner], roughness[inner]
        middles = points - ((points - center) * normals).sum(axis=1, keepdims=True) * normals
        return cls(points, middles, normals, roughness, tree)

    def distances(self, places: FloatArray) -> FloatArray:
        """Return (M,) distances of places from the surface, in meters.

        The nearest point alone is too far away where surface lies between the points, and too near where the points
        fill a thick band. So what counts is the plane of the nearest point, as far as it stands for the surface.

        Args:
            places: (M, 3).
        """
        to_point, nearest = self.tree.query(places)
        off = places - self.middles[nearest]
        height = (off * self.normals[nearest]).sum(axis=1)
        aside = np.sqrt(np.maximum((off**2).sum(axis=1) - height**2, 0.0))
        to_plane = np.hypot(height, np.maximum(aside - PATCH, 0.0))
        return np.where(self.normals[nearest].any(axis=1), to_plane, to_point)

    def point_distances(self, places: FloatArray) -> FloatArray:
        """Return (M,) distances of places from the nearest point, in meters.

        Args:
            places: (M, 3).
        """
        return np.asarray(self.tree.query(places)[0])


def align(places: FloatArray, scan: Scan, limits: Sequence[float] = PAIR_LIMITS) -> Similarity:
    """Return the similarity that moves places onto a scan: point to plane, trimmed (Chen and Medioni 1992).

    Args:
        places: (M, 3) samples of a surface that lies near the scan already; some may lie anywhere.
        scan: the surface to move them to.
        limits: largest distance of a place that takes part, in meters, by round.

    Raises:
        ValueError: hardly any place is near the scan.
    """
    found = Similarity(1.0, np.eye(3), np.zeros(3))
    for limit in limits:
        moved = found(places)
        away, found_at = scan.tree.query(moved, distance_upper_bound=limit)
        nearest = np.asarray(found_at)
        near = np.flatnonzero(np.isfinite(away))
        near = near[scan.normals[nearest[near]].any(axis=1)]
        if len(near) < LEAST_PAIRS:
            raise ValueError(f"{len(near)} samples of the surface are within {limit:g} m of the scan")
        normals = scan.normals[nearest[near]]
        height = ((moved[near] - scan.middles[nearest[near]]) * normals).sum(axis=1)
        kept = np.abs(height) <= np.quantile(np.abs(height), KEPT)
        found = _step(moved[near][kept], normals[kept], height[kept]).compose(found)
    return found


def _step(x: FloatArray, normals: FloatArray, height: FloatArray) -> Similarity:
    """Return the small similarity that brings points with these heights above planes onto them, to first order."""
    middle = x.mean(axis=0)
    x = x - middle
    J = np.column_stack([np.cross(x, normals), normals, (x * normals).sum(axis=1)])
    step = np.linalg.lstsq(J, -height, rcond=None)[0]
    R, scale = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[6]))
    return Similarity(scale, R, middle + step[3:6] - scale * R @ middle)


def _planes(points: FloatArray, tree: cKDTree, part: slice) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return center, normal and roughness of the plane through the neighbors of each of these points."""
    away, neighbors = tree.query(points[part], k=PLANE_POINTS, distance_upper_bound=PLANE_RADIUS)
    known = np.isfinite(away)
    count = known.sum(axis=1)
    around = points[np.where(known, neighbors, 0)]
    center = (around * known[..., None]).sum(axis=1) / count[:, None]
    off = (around - center[:, None]) * known[..., None]
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", off, off) / count[:, None, None])
    flat = count >= LEAST_POINTS
    roughness = np.where(flat, np.sqrt(np.maximum(values[:, 0], 0.0)), np.nan)
    return center, np.where(flat[:, None], vectors[:, :, 0], 0.0), roughness
