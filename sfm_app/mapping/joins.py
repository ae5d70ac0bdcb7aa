"""One model of all fragments: each photo once, and tracks merged where they hold the same keypoint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm_app.colmap.joined_model import PlacedPhotos
from sfm_app.geometry.poses import Similarity, explained_mask, robust_similarity
from sfm_app.numerical import FAILURES
from sfm_app.posegraph.rotations import average_rotations, connected_groups, partners_of
from sfm_app.types import MatchGraph, PairId, ViewGraph
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

# Joins. One photo in both models determines a similarity: rotation and position by its camera, scale by the distances
# of its points. The similarity with which most shared photos agree is refined on their points.


class OPTIONS:
    """Similarities between fragments, and their errors. Chosen by hand."""

    min_photos: int = 3
    """Least shared photos that agree."""
    min_points: int = 12
    """Least points of these in both models."""
    min_photo_points: int = 4
    """Least shared points that determine the scale of a photo."""
    agreement_deg: float = 3.0
    """Largest angle of shared photos that agree with a similarity."""
    agreement_shift: float = 0.1
    """Largest shift of these, as a share of the distance of their points."""
    max_fitted: int = 400
    """Most points that a similarity is fitted to. Chosen by hand for speed."""
    loose_factor: float = 6.0
    """Largest error of an explained match across a join, in inlier thresholds: parts bend."""
    max_checked: int = 150
    """Most pairs across a join that are checked, those with most inliers."""
    max_deg: float = 8.0
    """Angle of a join to the common frame above which it contradicts the others."""
    max_scale: float = 0.15
    """The same for the logarithm of its scale."""
    max_shift: float = 0.2
    """The same for its shift, as a share of the radius of the smaller fragment."""
    rounds: int = 40
    """Rounds of reweighting towards the least sum of errors."""
    min_error: float = 1e-4
    """Error below which a join gets no more weight."""
    same_deg: float = 5.0
    """Largest angle of a photo to its pose in the merged model for its points to count."""
    same_shift: float = 0.25
    """Largest shift of it, as a share of the median distance of its points."""


@dataclass(frozen=True, slots=True, eq=False)
class Fragment:
    """A model of a part, or a piece of one."""

    part: int
    own: frozenset[int]
    """Photos that no other part owns."""
    placed: PlacedPhotos

    @property
    def radius(self) -> float:
        """Median distance of the cameras from their middle, in units of the model."""
        centers = self.placed.centers
        return float(np.median(np.linalg.norm(centers - np.median(centers, axis=0), axis=1)))


@dataclass(frozen=True, slots=True, eq=False)
class Join:
    """A similarity between two fragments, with its evidence."""

    first: int
    """Number of the fragment in whose frame the similarity ends."""
    second: int
    similarity: Similarity
    """From the frame of the second fragment into that of the first."""
    photos: int
    shared: int
    """Photos that both hold."""
    points: int
    """Points of the agreeing photos that both hold."""
    middle: FloatArray
    """(1, 3) middle of the agreeing photos in the frame of the second fragment."""
    explained: int = 0
    """Matches across the join, of photos that only one of them holds, that it explains."""
    contradicted: int = 0
    """Inliers of fundamental matrices across it that it does not explain."""

    @property
    def weight(self) -> float:
        """Evidence for the join: agreeing photos, of which each further one counts less, and explained matches."""
        return self.photos / (1.0 + self.photos / 10.0) + self.explained / (100.0 + self.explained)


def find_join(first: int, second: int, fragments: Sequence[Fragment]) -> Join | None:
    """Return the similarity between two fragments; None where they share too little, or do not agree."""
    a, b = fragments[first].placed, fragments[second].placed
    photos, rows_a, rows_b = np.intersect1d(a.photos, b.photos, return_indices=True)
    if len(photos) < OPTIONS.min_photos:
        return None
    shared = _SharedPhotos(a, b, photos, rows_a, rows_b)
    agreeing, similarity = shared.best_hypothesis()
    if np.count_nonzero(agreeing) < OPTIONS.min_photos:
        return None
    points = np.flatnonzero(agreeing[shared.photo])
    if len(points) < OPTIONS.min_points:
        return None
    refined = shared.refine(points, similarity)
    agreeing_now = shared.agreement(refined)[0]
    if np.count_nonzero(agreeing_now) >= np.count_nonzero(agreeing):
        similarity, agreeing = refined, agreeing_now
    observations = np.flatnonzero(agreeing[shared.photo])
    point_count = len(np.unique(shared.rows_a[observations]))
    middle = shared.cb[agreeing].mean(axis=0)[None]
    count = int(np.count_nonzero(agreeing))
    return Join(first, second, similarity, count, len(photos), point_count, middle)


class _SharedPhotos:
    def __init__(
        self, a: PlacedPhotos, b: PlacedPhotos, photos: IndexArray, rows_a: IndexArray, rows_b: IndexArray
    ) -> None:
        keys = [_observation_keys(model, photos) for model in (a, b)]
        _, at_a, at_b = np.intersect1d(keys[0][0], keys[1][0], return_indices=True)
        at_a, at_b = keys[0][1][at_a], keys[1][1][at_b]
        self.photo = np.searchsorted(photos, a.photo[at_a])
        """(M,) number of the photo of each shared observation."""
        self.rows_a = a.point[at_a]
        """(M,) row of its point in the first model."""
        self.Xa, self.Xb = a.X[self.rows_a], b.X[b.point[at_b]]
        self.Ra, self.Rb, self.ca, self.cb = a.R[rows_a], b.R[rows_b], a.centers[rows_a], b.centers[rows_b]
        far_a, far_b = (
            np.linalg.norm(X - centers[self.photo], axis=1) for X, centers in ((self.Xa, self.ca), (self.Xb, self.cb))
        )
        self.distance = self._medians(far_a)
        """(N,) median distance from each photo to its points, in the first model."""
        self.scale = self._medians(far_a / np.maximum(far_b, 1e-300))
        """(N,) scale of the first model over that of the second, as each photo has it; NaN for photos of few points."""
        usual = np.nanmedian(self.distance) if np.isfinite(self.distance).any() else 1.0
        self.distance = np.where(np.isfinite(self.distance), self.distance, usual)

    def _medians(self, values: FloatArray) -> FloatArray:
        """Return (N,) medians by photo of one value for each observation; NaN for photos with few of them."""
        medians = np.full(len(self.ca), np.nan)
        for number in range(len(medians)):
            of_photo = self.photo == number
            if np.count_nonzero(of_photo) >= OPTIONS.min_photo_points:
                medians[number] = np.median(values[of_photo])
        return medians

    def best_hypothesis(self) -> tuple[BoolArray, Similarity]:
        """Return a mask of the agreeing photos for the best similarity of a single photo, and this similarity."""
        best, score = (np.zeros(len(self.ca), np.bool_), Similarity(1.0, np.eye(3), np.zeros(3))), (0, 0.0)
        for number in np.flatnonzero(np.isfinite(self.scale)):
            R, scale = self.Ra[number].T @ self.Rb[number], float(self.scale[number])
            candidate = Similarity(scale, R, self.ca[number] - scale * R @ self.cb[number])
            agreeing, shifts = self.agreement(candidate)
            rank = int(np.count_nonzero(agreeing)), -float(shifts[agreeing].sum())
            if rank > score:
                best, score = (agreeing, candidate), rank
        return best

    def agreement(self, similarity: Similarity) -> tuple[BoolArray, FloatArray]:
        """Return (n,) which photos agree, and their shifts by the distance of their points."""
        angles = _angles_deg(self.Ra, np.einsum("nij,kj->nik", self.Rb, similarity.R))
        shifts = np.linalg.norm(similarity(self.cb) - self.ca, axis=1) / self.distance
        return (angles <= OPTIONS.agreement_deg) & (shifts <= OPTIONS.agreement_shift), shifts

    def refine(self, points: IndexArray, similarity: Similarity) -> Similarity:
        """Fit a similarity to shared points; return the given one where they do not determine any."""
        _, once = np.unique(self.rows_a[points], return_index=True)
        chosen = points[np.sort(once)]
        chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), OPTIONS.max_fitted)).astype(np.int64)]
        try:
            return robust_similarity(self.Xb[chosen], self.Xa[chosen])
        except FAILURES:  # on a line
            return similarity


def _angles_deg(R: FloatArray, S: FloatArray) -> FloatArray:
    """Return the angles (N,) between rotations (N, 3, 3)."""
    return np.asarray(np.degrees(np.arccos(np.clip((np.einsum("nij,nij->n", R, S) - 1.0) / 2.0, -1.0, 1.0))))


def _observation_keys(model: PlacedPhotos, photos: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Return a number for each keypoint of some photos that is in a point, and the rows of these observations."""
    rows = np.flatnonzero(np.isin(model.photo, photos))
    keys, first = np.unique(model.photo[rows] * (1 << 32) + model.keypoint[rows], return_index=True)
    return keys, rows[first]


class AcrossJoins:
    """Matches across joins, of photos that only one of two fragments holds: they support a join, or contradict it."""

    def __init__(self, matches: MatchGraph, views: ViewGraph, max_error_px: float) -> None:
        self.matches, self.views, self.max_error_px = matches, views, max_error_px
        self.partners = partners_of(views.fits)

    def count(self, join: Join, fragments: Sequence[Fragment]) -> tuple[int, int]:
        """Return how many matches a join explains, and how many inliers it contradicts, without shared photos."""
        a, b = fragments[join.first].placed, fragments[join.second].placed
        explained = contradicted = 0
        for photo_a, photo_b in self._pairs(a, b):
            pair = min(photo_a, photo_b), max(photo_a, photo_b)
            rows = self.matches.matches[pair]
            rows = rows if pair[0] == photo_a else rows[:, ::-1]
            x_a, x_b = self.matches.keypoints[photo_a][rows[:, 0]], self.matches.keypoints[photo_b][rows[:, 1]]
            lines = np.hstack([a.bearings(photo_a, x_a), b.bearings(photo_b, x_b)])
            at_a, at_b = np.searchsorted(a.photos, photo_a), np.searchsorted(b.photos, photo_b)
            R_b = b.R[at_b] @ join.similarity.R.T
            t = R_b @ (a.centers[at_a] - join.similarity(b.centers[at_b][None])[0])
            R, t = R_b @ a.R[at_a].T, t / max(float(np.linalg.norm(t)), 1e-300)
            explained_matches = explained_mask(lines, R, t, OPTIONS.loose_factor * self.max_error_px)
            explained += int(np.count_nonzero(explained_matches))
            contradicted += int(np.count_nonzero(self.views.fits[pair].inliers & ~explained_matches))
        return explained, contradicted

    def _pairs(self, a: PlacedPhotos, b: PlacedPhotos) -> list[PairId]:
        """Return the pairs with most inliers between photos that only one model holds, the first model first."""
        here, there = set(a.photos.tolist()), set(b.photos.tolist())
        alone = there - here
        ranked = [
            (-self.views.fits[min(i, j), max(i, j)].inlier_count, i, j)
            for i in here - there
            for j in alone.intersection(self.partners.get(i, ()))
        ]
        return [(i, j) for _, i, j in sorted(ranked)[: OPTIONS.max_checked]]


# Alignment. The frames minimize the errors of all joins robustly, as in rotation averaging: rotations first, then the
# logarithms of the scales, then the shifts. A join that is off by more than bending parts explain is dropped, the worst
# one first, and the frames are estimated again: chains do not drift where a loop closes them.


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Fragments in common frames."""

    frames: Mapping[int, Similarity]
    """From the frame of each fragment to the common one, for the largest group of joined fragments."""
    kept: tuple[Join, ...]
    dropped: tuple[Join, ...]
    """Joins that contradict the others."""


def align_fragments(fragments: Sequence[Fragment], joins: Sequence[Join]) -> Alignment:
    """Find a common frame for the fragments that joins connect, without joins that contradict the others."""
    radii = [fragment.radius for fragment in fragments]
    remaining, dropped = list(joins), list[Join]()
    while True:
        frames = _synchronize(remaining, len(fragments))
        implied = [frames[join.first].inverse().compose(frames[join.second]) for join in remaining]
        errors = [contradiction(join, one, radii) for join, one in zip(remaining, implied, strict=True)]
        # a single loop is equally far off in all of its joins: the one with least evidence goes
        ranked = sorted(range(len(remaining)), key=lambda k: (-errors[k] / remaining[k].weight, k))
        worst = next((k for k in ranked if errors[k] > 1.0), None)
        if worst is None:
            break
        dropped.append(remaining.pop(worst))
    groups = connected_groups([(join.first, join.second) for join in remaining], range(len(fragments)))
    photos = [set(fragment.placed.photos.tolist()) for fragment in fragments]
    main = max(
        groups, key=lambda group: (len(set[int]().union(*(photos[k] for k in group))), -min(group)), default=set()
    )
    return Alignment({number: frames[number] for number in sorted(main)}, tuple(remaining), tuple(dropped))


def contradiction(join: Join, expected: Similarity, radii: Sequence[float]) -> float:
    """Return the largest error of a join, as a multiple of its limit, if another similarity is right.

    Radii are in units of each fragment.
    """
    smaller = min(radii[join.first], expected.scale * radii[join.second])
    off_deg = float(_angles_deg(expected.R[None], join.similarity.R[None])[0])
    scale = abs(float(np.log(join.similarity.scale / expected.scale)))
    shift = float(np.linalg.norm(join.similarity(join.middle) - expected(join.middle))) / max(smaller, 1e-300)
    return max(off_deg / OPTIONS.max_deg, scale / OPTIONS.max_scale, shift / OPTIONS.max_shift)


def _synchronize(joins: Sequence[Join], count: int) -> dict[int, Similarity]:
    """Return the frames of all fragments that least contradict the joins; alone, each has its own."""
    frames = dict.fromkeys(range(count), Similarity(1.0, np.eye(3), np.zeros(3)))
    if not joins:
        return frames
    pairs = [(join.first, join.second) for join in joins]
    weights = {pair: join.weight for pair, join in zip(pairs, joins, strict=True)}
    relative = {pair: join.similarity.R.T for pair, join in zip(pairs, joins, strict=True)}
    rotations = {number: R.T for number, R in average_rotations(relative, weights)[0].items()}
    strengths = np.array([join.weight for join in joins])
    edges = np.array(pairs, np.int64)
    logs = np.log([join.similarity.scale for join in joins])[:, None]
    scales = np.exp(_robust_potentials(count, edges, logs, strengths, np.ones(len(joins)))[:, 0])
    turns = [Similarity(float(scale), rotations.get(k, np.eye(3)), np.zeros(3)) for k, scale in enumerate(scales)]
    # where the shared photos are, errors of rotations shift least
    steps = np.concatenate([turns[j.first](j.similarity(j.middle)) - turns[j.second](j.middle) for j in joins])
    sizes = np.full(len(joins), max(float(np.linalg.norm(steps, axis=1).mean()), 1e-300))
    shifts = _robust_potentials(count, edges, steps, strengths, sizes)
    return frames | {k: Similarity(float(scales[k]), rotations[k], shifts[k]) for k in sorted(rotations)}


def _robust_potentials(
    count: int, edges: IndexArray, steps: FloatArray, strengths: FloatArray, sizes: FloatArray
) -> FloatArray:
    """Return (count, k) values with the least distances to steps (J, k), second less first, along edges (J, 2)."""
    groups = connected_groups(((a, b) for a, b in edges.tolist()), range(count))
    free = np.setdiff1d(np.arange(count), [min(group) for group in groups])
    A = np.zeros((len(edges), count))
    A[np.arange(len(edges)), edges[:, 1]] += 1.0
    A[np.arange(len(edges)), edges[:, 0]] -= 1.0
    values, weights = np.zeros((count, steps.shape[1])), strengths.copy()
    for _ in range(OPTIONS.rounds):
        root = np.sqrt(weights)[:, None]
        values[free] = np.linalg.lstsq(root * A[:, free], root * steps, rcond=None)[0]
        errors = np.linalg.norm(A @ values - steps, axis=1) / sizes
        weights = strengths / np.maximum(errors, OPTIONS.min_error)
    return values


def merge_fragments(fragments: Sequence[Fragment], frames: Mapping[int, Similarity]) -> PlacedPhotos:
    """Return all photos and points with a frame; the owner of a photo determines its pose, or the largest fragment."""
    models: dict[int, PlacedPhotos] = {}
    for number, frame in sorted(frames.items()):
        placed = fragments[number].placed
        R = np.einsum("nij,kj->nik", placed.R, frame.R)
        models[number] = replace(placed, R=R, centers=frame(placed.centers), X=frame(placed.X))
    photos, R, centers, source = _choose_poses(fragments, models)
    cameras = {k: models[n].cameras[k] for k, n in zip(photos.tolist(), source.tolist(), strict=True)}
    tracks = [_sound_observations(model, photos, R, centers) for model in models.values()]
    X, point, photo, keypoint = _merge_tracks(tracks)
    return PlacedPhotos(photos, R, centers, X, point, photo, keypoint, cameras)


def _choose_poses(
    fragments: Sequence[Fragment], models: Mapping[int, PlacedPhotos]
) -> tuple[IndexArray, FloatArray, FloatArray, IndexArray]:
    photo = np.concatenate([model.photos for model in models.values()])
    number = np.concatenate([np.full(len(model.photos), k) for k, model in models.items()])
    size = np.concatenate([np.full(len(model.photos), len(model.photos)) for model in models.values()])
    own = np.array([one in fragments[k].own for one, k in zip(photo.tolist(), number.tolist(), strict=True)], np.bool_)
    order = np.lexsort((number, -size, ~own, photo))
    photos, first = np.unique(photo[order], return_index=True)
    R = np.concatenate([model.R for model in models.values()])
    centers = np.concatenate([model.centers for model in models.values()])
    best = order[first]
    return photos, R[best], centers[best], number[best]


def _sound_observations(
    model: PlacedPhotos, photos: IndexArray, R: FloatArray, centers: FloatArray
) -> tuple[FloatArray, IndexArray, IndexArray, IndexArray]:
    """Return the points, and the observations by photos whose pose in this model is that of the merged one."""
    rows = np.searchsorted(photos, model.photos)
    angles = _angles_deg(model.R, R[rows])
    at = np.searchsorted(model.photos, model.photo)
    distances = np.linalg.norm(model.X[model.point] - model.centers[at], axis=1)
    median_distance = float(np.median(distances)) if len(distances) else 1.0
    shifts = np.linalg.norm(model.centers - centers[rows], axis=1) / max(median_distance, 1e-300)
    is_sound = ((angles <= OPTIONS.same_deg) & (shifts <= OPTIONS.same_shift))[at]
    return model.X, model.point[is_sound], model.photo[is_sound], model.keypoint[is_sound]


def _merge_tracks(
    tracks: Sequence[tuple[FloatArray, IndexArray, IndexArray, IndexArray]],
) -> tuple[FloatArray, IndexArray, IndexArray, IndexArray]:
    """Return points (P, 3), and of each observation the point, the photo and the keypoint, in order of points.

    Tracks with a keypoint in common become one; of several keypoints of one photo in it, one stays. The input has, for
    each model, the points, and for each observation the row of the point, the photo and the keypoint.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    starts = np.cumsum([0, *(len(X) for X, *_ in tracks)])
    X = np.concatenate([X for X, *_ in tracks] or [np.zeros((0, 3))])
    point = np.concatenate([rows + start for (_, rows, *_), start in zip(tracks, starts, strict=False)])
    photo = np.concatenate([photos for _, _, photos, _ in tracks])
    keypoint = np.concatenate([keypoints for *_, keypoints in tracks])
    _, name = np.unique(photo * (1 << 32) + keypoint, return_inverse=True)
    keys = int(name.max(initial=-1)) + 1
    links = coo_array((np.ones(len(name), np.int8), (point, len(X) + name)), shape=(len(X) + keys,) * 2)
    _, track = connected_components(links, directed=False)
    views = np.bincount(point, minlength=len(X)).astype(np.float64)
    total = np.bincount(track[: len(X)], views)
    sums = np.column_stack([np.bincount(track[: len(X)], views * X[:, k]) for k in range(3)])
    mean = np.asarray(sums / np.maximum(total, 1.0)[:, None], np.float64)
    owner = track[: len(X)][point]
    order = np.lexsort((keypoint, photo, owner))
    owner, photo, keypoint = owner[order], photo[order], keypoint[order]
    first = np.ones(len(owner), bool)
    first[1:] = (owner[1:] != owner[:-1]) | (photo[1:] != photo[:-1])
    owner, photo, keypoint = owner[first], photo[first], keypoint[first]
    has_views = np.bincount(owner, minlength=len(mean)) >= 2
    is_long = has_views[owner]
    rows = np.cumsum(has_views) - 1
    return mean[has_views], rows[owner[is_long]], photo[is_long], keypoint[is_long]
