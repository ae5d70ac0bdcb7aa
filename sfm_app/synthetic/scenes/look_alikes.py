"""Matches of photos of a place in which equal things stand in several places; nothing is rendered.

Every point has a look, and points of equal things share theirs. Photos match what looks the same from about the same
side, wherever it stands, as SIFT does. The relative pose of a pair is that of the place, or of the thing, which most
of its matches agree with.
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
"""R and t that bring a thing from its own frame to where it stands, or the world before a camera."""
Things = tuple[FloatArray, FloatArray]
"""(N, 3) points and (N, 3) normals."""

FOCAL, SIZE = 900.0, (1000, 750)
SEEN, MATCHED = 0.8, 0.75
"""Share of the points in view that become keypoints, and of the common ones, from one side, that are matched."""
WIDE_DEG, SCALE = 25.0, 0.5
"""Angle, and logarithm of the ratio of distances, at which e times fewer are matched."""
NOISE_PX = 0.3
LEAST = 16
"""Matches that agree on a pose: a pair with fewer has none."""
NEAR, FAR, STEEP = 0.3, 30.0, 0.2
"""Distances from which points are seen, and the least cosine between a point's normal and the way to the camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """Points of a place, and how the things got there."""

    X: FloatArray
    """(N, 3)"""
    normals: FloatArray
    """(N, 3) of length 1; zeros where a point is seen from all sides."""
    looks: IndexArray
    """(N,) equal for points that look the same."""
    stands: IndexArray
    """(N,) number of the placement that brought the point here; -1 for points that are unique."""
    placements: tuple[Placement, ...]
    """Of the things; the last one stands for the place itself."""
    pillar: float = 0.0
    """Radius of an upright cylinder about the origin that hides what is behind it; 0 for none."""


@dataclass(frozen=True, slots=True, eq=False)
class LookAlikeScene:
    """What photos of the place have in common, and the truth about it."""

    matches: MatchGraph
    cameras: dict[int, Calibration]
    poses: dict[PairId, RelativePose]
    true: frozenset[PairId]
    """Pairs whose pose is that of the place."""


def gathered(unique: Things, repeated: Sequence[tuple[Things, Sequence[Placement]]], pillar: float = 0.0) -> Place:
    """Return a place.

    Args:
        unique: points and their normals, (N, 3) each, that are there once.
        repeated: points and normals of things, in their own frames, each with everywhere that it stands.
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


def matched(place: Place, views: Sequence[Placement], seed: int = 0) -> LookAlikeScene:
    """Photograph and match.

    Args:
        place: what is there.
        views: R and t of the photos, from the world.
        seed: of what is seen and what is matched.
    """
    rng = np.random.default_rng([seed, 71])
    K = camera_matrix(FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2)
    seen, keypoints = {}, {}
    for photo, view in enumerate(views, start=1):
        seen[photo], keypoints[photo] = _photographed(place, view, rng)
    matches, poses, true = {}, {}, set()
    for a, b in combinations(seen, 2):
        chosen, shown = (seen[a], seen[b]), (views[a - 1], views[b - 1])
        rows = _rows(place, chosen, shown, rng)
        kinds = np.stack([place.stands[one[column]] for one, column in zip(chosen, rows.T, strict=True)], axis=1)
        kinds[kinds[:, 0] == kinds[:, 1]] = -1  # at its own place a thing agrees with all else
        names, which, counts = np.unique(kinds, axis=0, return_inverse=True, return_counts=True)
        if not len(rows) or counts.max() < LEAST:
            continue
        best = int(np.argmax(counts))
        stands = (place.placements[names[best][0]], place.placements[names[best][1]])
        matches[a, b] = rows.astype(np.uint32)
        poses[a, b] = _relative(shown, stands, which.ravel() == best)
        if names[best][0] == names[best][1]:
            true.add((a, b))
    images = {photo: MatchedImage(photo, f"{photo:04d}.jpg", "camera", *SIZE) for photo in seen}
    camera = Calibration(K, *SIZE, method="exif", identifiable=True)
    return LookAlikeScene(MatchGraph(images, keypoints, matches), dict.fromkeys(seen, camera), poses, frozenset(true))


def _photographed(place: Place, view: Placement, rng: np.random.Generator) -> tuple[IndexArray, FloatArray]:
    """Return numbers of the points that a photo shows, and where."""
    R, t = view
    Y = place.X @ R.T + t
    with np.errstate(divide="ignore", invalid="ignore"):
        x = Y[:, :2] / Y[:, 2:] * FOCAL + 0.5 * np.array(SIZE)
    center = -R.T @ t
    way = center - place.X
    facing = (place.normals * way).sum(1) >= STEEP * np.linalg.norm(way, axis=1)
    facing |= ~place.normals.any(axis=1)
    good = (Y[:, 2] > NEAR) & (Y[:, 2] < FAR) & ((x > 0) & (x < SIZE)).all(axis=1) & facing
    good &= rng.uniform(size=len(good)) < SEEN
    if place.pillar:
        good &= ~_hidden(place.X, center, place.pillar)
    chosen = np.flatnonzero(good)
    return chosen, x[chosen] + rng.normal(0.0, NOISE_PX, (len(chosen), 2))


def _hidden(X: FloatArray, center: FloatArray, radius: float) -> NDArray[np.bool_]:
    """Return (N,) whether the way from the camera to a point runs through the cylinder.

    Its own surface is not hidden.
    """
    ground, start = X[:, [0, 2]], center[[0, 2]]
    way = ground - start
    nearest = np.clip(-(way @ start) / (way**2).sum(1), 0.0, 1.0)
    closest = np.linalg.norm(start + nearest[:, None] * way, axis=1)
    return np.asarray((closest < radius) & (np.linalg.norm(ground, axis=1) > 1.01 * radius), np.bool_)


def _rows(place: Place, seen: Sequence[IndexArray], views: Sequence[Placement], rng: np.random.Generator) -> IndexArray:
    """Return (M, 2) keypoints that look the same, once in either photo, and are seen from about the same side."""
    looks = [place.looks[one] for one in seen]
    common, *ends = np.intersect1d(looks[0], looks[1], return_indices=True)
    once = [np.bincount(one, minlength=int(place.looks.max()) + 1)[common] == 1 for one in looks]
    rows = np.stack(ends, axis=1)[once[0] & once[1]]
    turns = np.array([R for R, _ in place.placements])
    ways = []
    for (R, t), one, column in zip(views, seen, rows.T, strict=True):
        way = -R.T @ t - place.X[one[column]]
        # as the thing has it that the point belongs to
        ways.append(np.einsum("nji,nj->ni", turns[place.stands[one[column]]], way))
    lengths = [np.linalg.norm(way, axis=1) for way in ways]
    cosines = (ways[0] * ways[1]).sum(1) / (lengths[0] * lengths[1])
    angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    likely = MATCHED * np.exp(-((angles / WIDE_DEG) ** 2) - (np.log(lengths[0] / lengths[1]) / SCALE) ** 2)
    return np.asarray(rows[rng.uniform(size=len(rows)) < likely], np.int64)


def _relative(views: Sequence[Placement], stands: Sequence[Placement], inliers: NDArray[np.bool_]) -> RelativePose:
    """Return the pose of view 2 from view 1, with what stands here taken for what stands there."""
    (R1, t1), (R2, t2) = ((R @ S, R @ s + t) for (R, t), (S, s) in zip(views, stands, strict=True))
    R = R2 @ R1.T
    t = t2 - R @ t1
    return RelativePose(R, t / np.linalg.norm(t), inliers, angle_deg=10.0, in_front=1.0)
