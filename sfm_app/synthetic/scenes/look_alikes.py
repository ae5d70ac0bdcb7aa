"""Simulate matches of photos of a place with identical objects in several positions; nothing is rendered.

Every point has an appearance; corresponding points of identical objects share theirs. As with SIFT, points match if
they look the same from about the same side, wherever they stand. The relative pose of a pair is the one that most of
its matches agree with: that of the place, or that of a pair of identical objects.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.camera import camera_matrix
from sfm_app.types import Calibration, MatchedImage, MatchGraph, PairId, RelativePose

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]
Placement = tuple[FloatArray, FloatArray]
"""R and t from an object's own frame to the world, or from the world to a camera."""
Things = tuple[FloatArray, FloatArray]
"""(N, 3) points and (N, 3) normals."""

FOCAL, SIZE = 900.0, (1000, 750)
SEEN, MATCHED = 0.8, 0.75
"""Share of the points in view that become keypoints, and of common keypoints from one direction that are matched."""
WIDE_DEG, SCALE = 25.0, 0.5
"""Angle, and logarithm of the ratio of distances, at which the share of matches drops by a factor e."""
NOISE_PX = 0.3
MIN_MATCHES = 16
"""Matches that must agree on a pose; a pair with fewer has no pose."""
NEAR, FAR, MIN_FACING_COSINE = 0.3, 30.0, 0.2
"""Range of depths of visible points, and least cosine between a point's normal and the direction to the camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Points of a place, and the poses of its objects."""

    X: FloatArray
    """(N, 3)"""
    normals: FloatArray
    """(N, 3) of length 1; zeros where a point is seen from all sides."""
    appearances: IndexArray
    """(N,) appearance numbers; equal for points that look the same."""
    placement_ids: IndexArray
    """(N,) index of each point's placement; -1 for unique points."""
    placements: tuple[Placement, ...]
    """Placements of the objects; the last one, the identity, is that of the unique points."""
    pillar: float = 0.0
    """Radius of an upright cylinder about the origin that hides what is behind it; 0 for none."""


@dataclass(frozen=True, slots=True, eq=False)
class LookAlikeScene:
    """Matches of photos of the place, and their ground truth."""

    matches: MatchGraph
    cameras: dict[int, Calibration]
    poses: dict[PairId, RelativePose]
    true_pairs: frozenset[PairId]
    """Pairs with a correct relative pose."""


def make_place(unique: Things, repeated: Sequence[tuple[Things, Sequence[Placement]]], pillar: float = 0.0) -> Place:
    """Build a place from unique points and repeated objects.

    Args:
        unique: points and their normals, (N, 3) each, that occur once.
        repeated: points and normals of objects, in their own frames, each with all its placements.
        pillar: radius of an upright cylinder about the origin that hides what is behind it; 0 for none.
    """
    X, normals = [unique[0]], [unique[1]]
    looks, stands = [np.arange(len(unique[0]))], [np.full(len(unique[0]), -1)]
    placements: list[Placement] = []
    first = len(unique[0])
    for (points, directions), places in repeated:
        for R, t in places:
            X.append(points @ R.T + t)
            normals.append(directions @ R.T)
            looks.append(first + np.arange(len(points)))
            stands.append(np.full(len(points), len(placements)))
            placements.append((R, t))
        first += len(points)
    at_home = (np.eye(3), np.zeros(3))
    return Place(
        np.concatenate(X),
        np.concatenate(normals),
        np.concatenate(looks),
        np.concatenate(stands),
        (*placements, at_home),
        pillar,
    )


def match_photos(place: Place, views: Sequence[Placement], seed: int = 0) -> LookAlikeScene:
    """Make simulated photos of a place and their matches.

    Args:
        place: its points.
        views: R and t of each photo, from the world to the camera.
        seed: determines visibility, noise and matching.
    """
    rng = np.random.default_rng([seed, 71])
    K = camera_matrix(FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2)
    seen, keypoints = {}, {}
    for photo, view in enumerate(views, start=1):
        seen[photo], keypoints[photo] = _photograph(place, view, rng)
    matches, poses, true = {}, {}, set()
    for a, b in combinations(seen, 2):
        chosen, shown = (seen[a], seen[b]), (views[a - 1], views[b - 1])
        rows = _matching_rows(place, chosen, shown, rng)
        kinds = np.stack([place.placement_ids[one[column]] for one, column in zip(chosen, rows.T, strict=True)], axis=1)
        kinds[kinds[:, 0] == kinds[:, 1]] = -1  # an object that is matched to itself agrees with the unique points
        names, which, counts = np.unique(kinds, axis=0, return_inverse=True, return_counts=True)
        if not len(rows) or counts.max() < MIN_MATCHES:
            continue
        best = int(np.argmax(counts))
        stands = (place.placements[names[best][0]], place.placements[names[best][1]])
        matches[a, b] = rows.astype(np.uint32)
        poses[a, b] = _relative_pose(shown, stands, which.ravel() == best)
        if names[best][0] == names[best][1]:
            true.add((a, b))
    images = {photo: MatchedImage(photo, f"{photo:04d}.jpg", "camera", *SIZE) for photo in seen}
    camera = Calibration(K, *SIZE, method="exif", identifiable=True)
    return LookAlikeScene(MatchGraph(images, keypoints, matches), dict.fromkeys(seen, camera), poses, frozenset(true))


def _photograph(place: Place, view: Placement, rng: np.random.Generator) -> tuple[IndexArray, FloatArray]:
    """Return the indices of the points visible in a photo, and their pixels."""
    R, t = view
    Y = place.X @ R.T + t
    with np.errstate(divide="ignore", invalid="ignore"):
        x = Y[:, :2] / Y[:, 2:] * FOCAL + 0.5 * np.array(SIZE)
    center = -R.T @ t
    way = center - place.X
    facing = (place.normals * way).sum(1) >= MIN_FACING_COSINE * np.linalg.norm(way, axis=1)
    facing |= ~place.normals.any(axis=1)
    good = (Y[:, 2] > NEAR) & (Y[:, 2] < FAR) & ((x > 0) & (x < SIZE)).all(axis=1) & facing
    good &= rng.uniform(size=len(good)) < SEEN
    if place.pillar:
        good &= ~_is_hidden(place.X, center, place.pillar)
    chosen = np.flatnonzero(good)
    return chosen, x[chosen] + rng.normal(0.0, NOISE_PX, (len(chosen), 2))


def _is_hidden(X: FloatArray, center: FloatArray, radius: float) -> NDArray[np.bool_]:
    """Return (N,) whether the line of sight to a point passes through the cylinder.

    Points on the cylinder itself count as visible.
    """
    ground, start = X[:, [0, 2]], center[[0, 2]]
    way = ground - start
    nearest = np.clip(-(way @ start) / (way**2).sum(1), 0.0, 1.0)
    closest = np.linalg.norm(start + nearest[:, None] * way, axis=1)
    return np.asarray((closest < radius) & (np.linalg.norm(ground, axis=1) > 1.01 * radius), np.bool_)


def _matching_rows(
    place: Place, seen: Sequence[IndexArray], views: Sequence[Placement], rng: np.random.Generator
) -> IndexArray:
    """Return (M, 2) pairs of keypoints that look the same, are unique in both photos, and seen from similar sides."""
    looks = [place.appearances[one] for one in seen]
    common, *ends = np.intersect1d(looks[0], looks[1], return_indices=True)
    once = [np.bincount(one, minlength=int(place.appearances.max()) + 1)[common] == 1 for one in looks]
    rows = np.stack(ends, axis=1)[once[0] & once[1]]
    turns = np.array([R for R, _ in place.placements])
    ways = []
    for (R, t), one, column in zip(views, seen, rows.T, strict=True):
        way = -R.T @ t - place.X[one[column]]
        # in the frame of the point's object
        ways.append(np.einsum("nji,nj->ni", turns[place.placement_ids[one[column]]], way))
    lengths = [np.linalg.norm(way, axis=1) for way in ways]
    cosines = (ways[0] * ways[1]).sum(1) / (lengths[0] * lengths[1])
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    likely = MATCHED * np.exp(-((angles / WIDE_DEG) ** 2) - (np.log(lengths[0] / lengths[1]) / SCALE) ** 2)
    return np.asarray(rows[rng.uniform(size=len(rows)) < likely], np.int64)


def _relative_pose(views: Sequence[Placement], stands: Sequence[Placement], inliers: NDArray[np.bool_]) -> RelativePose:
    """Return the pose of view 2 from view 1 if the objects of two placements are taken for the same object."""
    (R1, t1), (R2, t2) = ((R @ S, R @ s + t) for (R, t), (S, s) in zip(views, stands, strict=True))
    R = R2 @ R1.T
    t = t2 - R @ t1
    return RelativePose(R, t / np.linalg.norm(t), inliers, angle_deg=10.0, in_front=1.0)
