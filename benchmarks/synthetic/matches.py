"""Matches and view graphs without any picture, with their truth.

`make_two_motions`: a pair in which an object moves by itself (thesis 4.4.2). `match_photos`: a place with identical
objects in several positions. `make_town_graph`: a walk of thousands of photos through a town.

Every point of a place has an appearance; corresponding points of identical objects share theirs. As with SIFT, points
match if they look the same from about the same side, wherever they stand. The relative pose of a pair is the one that
most of its matches agree with: that of the place, or that of a pair of identical objects.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from benchmarks.synthetic.town import BLOCK_M, PITCH_M, STREET_M, TownWalk, walk_town
from sfm_app.camera.models import camera_matrix
from sfm_app.errors import ConfigError
from sfm_app.fundamental.refits import refine_sampson
from sfm_app.geometry.epipolar import fundamental_from_pose, sampson_distance
from sfm_app.retrieval import choose_by_rank
from sfm_app.synthetic.correspondences import DEPTHS, MAX_SETUPS, PairOptions, TwoViews, make_pair, random_rotation
from sfm_app.types import Calibration, EpipolarFit, MatchedImage, MatchGraph, PairId, RelativePose, ViewGraph

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

RADIUS = (0.1, 0.2)
"""Range of the radius of the moving object, in units of the distance to the middle of the scene."""
MAX_TURN_DEG, MAX_SHIFT = 30.0, 0.3
"""Largest turn of the object about its center and shift per axis between the two images."""
LEAST_DEPARTURE_PX = 5.0
"""Median Sampson distance of the object's exact matches to the geometry of the scene: an object that slides along its
epipolar lines does not count as moving."""


@dataclass(frozen=True, slots=True, eq=False)
class TwoMotions:
    """Matches of a still scene, of an object that moves, and outliers, in random order."""

    pair: TwoViews
    """Ground truth of the still scene; the object's matches are outliers in `is_inlier`."""
    is_moving: NDArray[np.bool_]
    """(N,), whether a match lies on the object."""
    moving_F: FloatArray
    """(3, 3) fundamental matrix of the object: x2' F x1 = 0 for its exact points, Frobenius norm 1."""


def make_two_motions(options: PairOptions, moving: float, seed: int) -> TwoMotions:
    """Return a pair as from `make_pair`, with an object that has its own rigid motion.

    Args:
        options: the pair; `points` counts all matches and `outliers` is a share of all.
        moving: share of the matches on the object, in (0, 1), smaller than the still scene's share of inliers.
        seed: same seed, same pair.

    Raises:
        ConfigError: the scene would not be the dominant motion, or no such setup is found.
    """
    count = round(moving * options.points)
    if not 0 < count < options.points - count - round(options.outliers * options.points):
        raise ConfigError("two motions: the moving object needs a share above 0 and below that of the still inliers")
    still_count = options.points - count
    outliers = round(options.outliers * options.points) / still_count
    still = make_pair(replace(options, points=still_count, outliers=outliers), seed)
    rng = np.random.default_rng([seed, 442])
    exact1, exact2, moving_F = _moving_object(still, options, count, rng)
    order = rng.permutation(options.points)

    def join(of_scene: FloatArray, of_object: FloatArray) -> FloatArray:
        return np.concatenate([of_scene, of_object])[order]

    is_moving = order >= still_count
    noise = rng.normal(scale=options.sigma_px, size=(2, count, 2))
    pair = replace(
        still,
        x1=join(still.x1, exact1 + noise[0]),
        x2=join(still.x2, exact2 + noise[1]),
        exact_x1=join(still.exact_x1, exact1),
        exact_x2=join(still.exact_x2, exact2),
        is_inlier=np.append(still.is_inlier, np.zeros(count, np.bool_))[order],
    )
    return TwoMotions(pair, is_moving, moving_F)


def _moving_object(
    still: TwoViews, options: PairOptions, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return noise-free image points of a moving ball in both images, and its fundamental matrix."""
    size = np.array([options.width, options.height])
    for _ in range(MAX_SETUPS):
        pixel = np.append(rng.uniform(size=2) * size, 1.0)
        center = np.linalg.inv(still.K1) @ pixel * rng.uniform(*DEPTHS)
        turn = random_rotation(rng, MAX_TURN_DEG)
        shift = rng.uniform(-MAX_SHIFT, MAX_SHIFT, 3)
        R, t = still.R @ turn, still.R @ (center + shift - turn @ center) + still.t
        directions = rng.normal(size=(8 * count, 3))
        radii = rng.uniform(*RADIUS) * rng.uniform(size=(8 * count, 1)) ** (1 / 3)
        X = center + radii * directions / np.linalg.norm(directions, axis=1, keepdims=True)
        depths = np.stack([X[:, 2], (X @ R.T + t)[:, 2]])
        X = X[(depths > DEPTHS[0] / 4).all(axis=0)]
        x1, x2 = _project_object(still.K1, X), _project_object(still.K2, X @ R.T + t)
        seen = np.flatnonzero(((x1 >= 0) & (x1 <= size) & (x2 >= 0) & (x2 <= size)).all(axis=1))[:count]
        if len(seen) < count:
            continue
        if np.median(sampson_distance(still.F, x1[seen], x2[seen])) >= LEAST_DEPARTURE_PX:
            return x1[seen], x2[seen], fundamental_from_pose(still.K1, still.K2, R, t)
    raise ConfigError("no moving object is seen in both images", hint="lower max_rotation_deg or max_baseline")


def _project_object(K: FloatArray, X: FloatArray) -> FloatArray:
    h = X @ K.T
    return np.asarray(h[:, :2] / h[:, 2:])


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
NEAREST, FARTHEST, MIN_FACING_COSINE = 0.3, 30.0, 0.2
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
    good = (Y[:, 2] > NEAREST) & (Y[:, 2] < FARTHEST) & ((x > 0) & (x < SIZE)).all(axis=1) & facing
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
