"""View graphs of thousands of photos without any picture: a walk through a town, its matches and their truth."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from sfm_app.geometry.camera import camera_matrix
from sfm_app.geometry.distances import sampson_distance
from sfm_app.geometry.epipolar import fundamental_from_pose
from sfm_app.ransac.refine.sampson_refit import refine_sampson
from sfm_app.retrieval.choice import choose_by_rank
from sfm_app.synthetic.town_walk import BLOCK_M, PITCH_M, STREET_M, TownWalk, walk_town
from sfm_app.types import EpipolarFit, MatchedImage, MatchGraph, PairId, ViewGraph

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

HEIGHT_M, RELIEF_M = 9.0, 1.2
"""Height of houses, and depth of what stands out of their facades or before them: a plane alone leaves F open."""
POINTS_PER_M = 14.0
"""Points of a facade per meter of street."""
NEAR_M, FAR_M = 2.0, 45.0
"""Distances at which points are seen."""
MOST_POINTS = 300
"""Points that a photo sees."""
ROW = 5
"""Photos in a row that see equal houses."""
FEWEST_SHARED = 24
"""Least number of common points of a pair that is matched."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TownOptions:
    """A town and its photos."""

    photos: int = 1000
    step_m: float = 1.5
    neighbors: int = 30
    """Photos that each one is matched with."""
    noise_px: float = 0.5
    """Standard deviation of keypoints on each axis."""
    outliers: float = 0.25
    """Share of wrong matches in each pair."""
    look_alikes: float = 0.01
    """Pairs of photos of equal houses in different streets, as a share of the true ones."""
    size: tuple[int, int] = (1200, 900)
    focal_px: float = 1000.0
    threshold_px: float = 1.5
    """Largest Sampson distance of an inlier."""


@dataclass(frozen=True, slots=True, eq=False)
class TownGraph:
    """Matches and fundamental matrices of a town, and its truth."""

    matches: MatchGraph
    views: ViewGraph
    K: FloatArray
    R: FloatArray
    """(N, 3, 3) camera from world."""
    centers: FloatArray
    """(N, 3) meters."""
    look_alikes: frozenset[PairId]
    """Pairs whose matches join different places."""


def make_town_graph(options: TownOptions, seed: int) -> TownGraph:
    """Make the view graph of a walk through a town.

    Photos are numbered from 1 in the order of the walk. Pairs of look-alikes take houses of another street for those of
    the first photo: their matches agree with a relative pose, which is wrong.

    Args:
        options: size of the walk, noise and outliers.
        seed: same seed, same graph.
    """
    rng = np.random.default_rng([seed, 722])
    walk = walk_town(options.photos, options.step_m, seed)
    X, lines = _facade_points(walk.blocks, rng)
    K = camera_matrix(options.focal_px, options.focal_px, options.size[0] / 2, options.size[1] / 2)
    seen = [np.sort(found) for found in _visible_points(walk, X, lines, K, options, rng)]
    keypoints = {
        photo: _project(X[points], walk.rotations[photo - 1], walk.centers[photo - 1], K)
        + rng.normal(scale=options.noise_px, size=(len(points), 2))
        for photo, points in enumerate(seen, start=1)
    }
    pairs = {pair: _common(seen[pair[0] - 1], seen[pair[1] - 1]) for pair in _matched_pairs(seen, options.neighbors)}
    poses = {pair: pair for pair in pairs}
    false = _look_alikes(seen, keypoints, round(options.look_alikes * len(pairs)), options.noise_px, rng)
    for pair, (rows, posed_as) in false.items():
        pairs[pair], poses[pair] = rows, posed_as
    matches, fits = {}, {}
    for pair in sorted(pairs):
        matches[pair] = _with_outliers(pairs[pair], [len(keypoints[photo]) for photo in pair], options.outliers, rng)
        F = _pair_matrix(poses[pair], walk, K)
        fits[pair] = _fit(
            np.hstack([keypoints[photo][matches[pair][:, k]] for k, photo in enumerate(pair)]), F, options
        )
    images = {k: MatchedImage(k, f"{k:05d}.jpg", "camera", *options.size) for k in keypoints}
    graph = MatchGraph(images, keypoints, matches)
    return TownGraph(graph, ViewGraph(fits, {}), K, walk.rotations, walk.centers, frozenset(false))


def _facade_points(blocks: int, rng: np.random.Generator) -> tuple[FloatArray, IndexArray]:
    """Return (P, 3) points, and (P, 2) the street that they face: direction, 0 for x and 1 for z, and number."""
    count = round(POINTS_PER_M * BLOCK_M)
    found, lines = [], []
    for direction in range(2):
        for line in range(blocks + 1):
            for side in (-1, 1):
                rows = [block for block in range(-1, blocks + 1) for _ in range(count)]
                along = PITCH_M * np.array(rows) + STREET_M / 2 + rng.uniform(0, BLOCK_M, len(rows))
                across = PITCH_M * line + side * (STREET_M / 2 + rng.uniform(-RELIEF_M, RELIEF_M, len(rows)))
                high = rng.uniform(0.0, HEIGHT_M, len(rows))
                axes = (along, high, across) if direction == 0 else (across, high, along)
                found.append(np.column_stack(axes))
                lines.append(np.tile([direction, line], (len(rows), 1)))
    return np.concatenate(found), np.concatenate(lines)


def _visible_points(
    walk: TownWalk, X: FloatArray, lines: IndexArray, K: FloatArray, options: TownOptions, rng: np.random.Generator
) -> Iterator[IndexArray]:
    """Yield the points that each photo sees: inside the picture, and along a street that it is in.

    Of many, all photos prefer the same ones.
    """
    tree, preference = cKDTree(X[:, [0, 2]]), rng.uniform(size=len(X))
    for R, center in zip(walk.rotations, walk.centers, strict=True):
        near = np.array(tree.query_ball_point(center[[0, 2]], FAR_M), np.int64)
        local = (X[near] - center) @ R.T
        with np.errstate(divide="ignore", invalid="ignore"):
            x = (local @ K.T)[:, :2] / local[:, 2:]
        inside = (local[:, 2] > NEAR_M) & ((x > 0) & (x < options.size)).all(axis=1)
        offsets = np.abs(center[[2, 0]][lines[near, 0]] - PITCH_M * lines[near, 1])
        near = near[inside & (offsets < STREET_M / 2)]
        yield near[np.argsort(preference[near])[:MOST_POINTS]]


def _project(X: FloatArray, R: FloatArray, center: FloatArray, K: FloatArray) -> FloatArray:
    local = (X - center) @ R.T @ K.T
    return np.asarray(local[:, :2] / local[:, 2:])


def _matched_pairs(seen: list[IndexArray], neighbors: int) -> list[PairId]:
    """Return the pairs that are matched, chosen as a run chooses them."""
    rows = np.repeat(np.arange(len(seen)), [len(points) for points in seen])
    points = np.concatenate(seen)
    shown = sparse.coo_array((np.ones(len(points), np.int64), (rows, points))).tocsr()
    shared = sparse.triu(sparse.csr_array(shown @ shown.T), k=1).tocoo()
    ends = zip(*(axis.tolist() for axis in shared.coords), strict=True)
    scores = {(i + 1, j + 1): count for (i, j), count in zip(ends, shared.data.tolist(), strict=True)}
    return sorted(choose_by_rank(scores, FEWEST_SHARED, neighbors))


def _common(first: IndexArray, second: IndexArray) -> IndexArray:
    """Return (N, 2) the rows of equal points in two sorted lists."""
    return np.column_stack(np.intersect1d(first, second, assume_unique=True, return_indices=True)[1:])


def _look_alikes(
    seen: list[IndexArray], keypoints: dict[int, FloatArray], count: int, noise_px: float, rng: np.random.Generator
) -> dict[PairId, tuple[IndexArray, PairId]]:
    """Return pairs that join different places: their matches, and the pair whose pose these have.

    A few photos in a row get the keypoints of others far away, as if the houses there were equal.
    """
    found: dict[PairId, tuple[IndexArray, PairId]] = {}
    photos = len(seen)
    while len(found) < count:
        here, there = rng.integers(1, photos - ROW, 2).tolist()
        if abs(here - there) < photos // 4:
            continue
        for step in range(ROW):
            copied = seen[there + step - 1]
            start = len(keypoints[here + step])
            shown = keypoints[there + step][: len(copied)] + rng.normal(scale=noise_px, size=(len(copied), 2))
            keypoints[here + step] = np.concatenate([keypoints[here + step], shown])
            for other in range(there, there + ROW):
                rows = _common(copied, seen[other - 1]) + np.array([start, 0])
                if other == there + step or len(rows) < FEWEST_SHARED:
                    continue
                if here + step < other:
                    found[here + step, other] = rows, (there + step, other)
                else:
                    found[other, here + step] = rows[:, ::-1], (other, there + step)
    return found


def _with_outliers(
    rows: IndexArray, keypoints: list[int], share: float, rng: np.random.Generator
) -> NDArray[np.uint32]:
    """Return (M, 2) matches with wrong ones among them; as of a matcher, no keypoint has two."""
    left = [rng.permutation(np.setdiff1d(np.arange(count), rows[:, side])) for side, count in enumerate(keypoints)]
    wrong = min(round(len(rows) * share / (1.0 - share)), *map(len, left))
    return np.concatenate([rows, np.column_stack([free[:wrong] for free in left])]).astype(np.uint32)


def _pair_matrix(pair: PairId, walk: TownWalk, K: FloatArray) -> FloatArray:
    """Return the true fundamental matrix of a pair."""
    i, j = pair[0] - 1, pair[1] - 1
    R = walk.rotations[j] @ walk.rotations[i].T
    return fundamental_from_pose(K, K, R, walk.rotations[j] @ (walk.centers[i] - walk.centers[j]))


def _fit(points: FloatArray, F: FloatArray, options: TownOptions) -> EpipolarFit:
    """Return what an estimator would find that starts near the truth."""
    F = refine_sampson(np.ascontiguousarray(points), F, scale=options.threshold_px)
    distances = sampson_distance(F, points[:, :2], points[:, 2:])
    inliers = distances < options.threshold_px
    rms = float(np.sqrt(np.mean(distances[inliers] ** 2))) if inliers.any() else 0.0
    return EpipolarFit(F / np.linalg.norm(F), inliers, inliers.astype(np.float64), 100, rms)
