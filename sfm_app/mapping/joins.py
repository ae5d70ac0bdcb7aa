"""One model of all fragments: each photo once, and tracks merged where they hold the same keypoint."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sfm_app.colmap.joined_model import PlacedPhotos
from sfm_app.geometry.poses import Similarity, robust_similarity
from sfm_app.numerical import FAILURES
from sfm_app.posegraph.pair_pose import is_in_front, pose_distances
from sfm_app.posegraph.rotations import DisjointGroups, average_rotations, connected_groups
from sfm_app.types import MatchGraph, PairId, ViewGraph
from sfm_app.types.arrays import FloatArray, IndexArray

# Similarities between models of parts, from the photos and points that both hold.
#
# One photo in both models tells all of a similarity: the rotation and the position of its camera, and by the
# distances of its points the scale. The similarity with which most of the shared photos agree is refined on their
# points. A photo that one of the parts has misplaced, as among look-alikes, does not agree.

LEAST_PHOTOS, LEAST_POINTS = 3, 12
"""Smallest number of shared photos that agree, and of points that these see in both models. Chosen by hand."""
LEAST_OF_PHOTO = 4
"""Smallest number of shared points by which a photo tells the scale."""
AGREEMENT_DEG, AGREEMENT_SHIFT = 3.0, 0.1
"""Shared photos agree with a similarity up to this angle, and this shift as a share of the distance of their points.
Chosen by hand: misplaced photos are off by far more, parts that bend by far less."""
MOST_FITTED = 400
"""Most points that a similarity is fitted to. Chosen by hand for speed."""
LOOSE_FACTOR, MOST_CHECKED = 6.0, 150
"""Largest error of an explained match across a join, in inlier thresholds: parts bend, and are adjusted together only
later. Most pairs across a join that are checked, those with most inliers. Chosen by hand."""


@dataclass(frozen=True, slots=True, eq=False)
class Fragment:
    """A model of a part, or a piece of one."""

    part: int
    """Number of the part."""
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
    """Shared photos that agree."""
    shared: int
    """Photos that both hold."""
    points: int
    """Points of the agreeing photos that both hold."""
    off_deg: float
    """Median angle between the rotations of the agreeing photos."""
    off: float
    """Median distance of their centers, as a share of the distance of their points."""
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
    """Return the similarity between two fragments; None where they share too little, or do not agree.

    Args:
        first, second: numbers of fragments.
        fragments: all of them.
    """
    a, b = fragments[first].placed, fragments[second].placed
    photos, rows_a, rows_b = np.intersect1d(a.photos, b.photos, return_indices=True)
    if len(photos) < LEAST_PHOTOS:
        return None
    shared = _SharedPhotos(a, b, photos, rows_a, rows_b)
    agreeing, similarity = shared.best_hypothesis()
    if np.count_nonzero(agreeing) < LEAST_PHOTOS:
        return None
    points = np.flatnonzero(agreeing[shared.photo])
    if len(points) < LEAST_POINTS:
        return None
    refined = shared.refine(points, similarity)
    now = shared.agreement(refined)[0]
    if np.count_nonzero(now) >= np.count_nonzero(agreeing):
        similarity, agreeing = refined, now
    _, angles, shifts = shared.agreement(similarity)
    seen = np.flatnonzero(agreeing[shared.photo])
    points_seen = len(np.unique(shared.rows_a[seen]))
    deviations = float(np.median(angles[agreeing])), float(np.median(shifts[agreeing]))
    middle = shared.cb[agreeing].mean(axis=0)[None]
    count = int(np.count_nonzero(agreeing))
    return Join(first, second, similarity, count, len(photos), points_seen, *deviations, middle)


class _SharedPhotos:
    """Photos in two models, with the points that both triangulated from the same keypoints."""

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
        found = np.full(len(self.ca), np.nan)
        for number in range(len(found)):
            seen = self.photo == number
            if np.count_nonzero(seen) >= LEAST_OF_PHOTO:
                found[number] = np.median(values[seen])
        return found

    def best_hypothesis(self) -> tuple[NDArray[np.bool_], Similarity]:
        """Return which photos agree with the similarity of that photo with which most agree, and this similarity."""
        best, score = (np.zeros(len(self.ca), np.bool_), Similarity(1.0, np.eye(3), np.zeros(3))), (0, 0.0)
        for number in np.flatnonzero(np.isfinite(self.scale)):
            R, scale = self.Ra[number].T @ self.Rb[number], float(self.scale[number])
            tried = Similarity(scale, R, self.ca[number] - scale * R @ self.cb[number])
            agreeing, _, shifts = self.agreement(tried)
            found = int(np.count_nonzero(agreeing)), -float(shifts[agreeing].sum())
            if found > score:
                best, score = (agreeing, tried), found
        return best

    def agreement(self, similarity: Similarity) -> tuple[NDArray[np.bool_], FloatArray, FloatArray]:
        """Return (n,) which photos agree, their angles in degrees, and their shifts by the distance of their points."""
        turned = np.einsum("nij,kj->nik", self.Rb, similarity.R)
        traces = np.einsum("nij,nij->n", self.Ra, turned)
        angles = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
        shifts = np.linalg.norm(similarity(self.cb) - self.ca, axis=1) / self.distance
        return (angles <= AGREEMENT_DEG) & (shifts <= AGREEMENT_SHIFT), angles, shifts

    def refine(self, points: IndexArray, similarity: Similarity) -> Similarity:
        """Fit a similarity to shared points.

        Args:
            points: numbers of shared observations.
            similarity: the result where they do not determine one.
        """
        _, once = np.unique(self.rows_a[points], return_index=True)
        chosen = points[np.sort(once)]
        chosen = chosen[np.linspace(0, len(chosen) - 1, min(len(chosen), MOST_FITTED)).astype(np.int64)]
        try:
            return robust_similarity(self.Xb[chosen], self.Xa[chosen])
        except FAILURES:  # on a line
            return similarity


def _observation_keys(model: PlacedPhotos, photos: IndexArray) -> tuple[IndexArray, IndexArray]:
    """Return a number for each keypoint of some photos that is in a point, and the rows of these observations."""
    rows = np.flatnonzero(np.isin(model.photo, photos))
    keys, first = np.unique(model.photo[rows] * (1 << 32) + model.keypoint[rows], return_index=True)
    return keys, rows[first]


class AcrossJoins:
    """Matches of photos that only one of two fragments holds: they bear out a join, or contradict it.

    Args:
        matches: keypoints and raw matches.
        views: fundamental matrices.
        max_error_px: largest Sampson distance of an inlier.
    """

    def __init__(self, matches: MatchGraph, views: ViewGraph, max_error_px: float) -> None:
        self.matches, self.views, self.max_error_px = matches, views, max_error_px
        self.partners: dict[int, list[int]] = {}
        for a, b in views.fits:
            self.partners.setdefault(a, []).append(b)
            self.partners.setdefault(b, []).append(a)

    def count(self, join: Join, fragments: Sequence[Fragment]) -> tuple[int, int]:
        """Return how many matches across a join it explains, and how many inliers it contradicts.

        The shared photos are not asked: they made the join.

        Args:
            join: of two fragments.
            fragments: all of them.
        """
        a, b = fragments[join.first].placed, fragments[join.second].placed
        explained = contradicted = 0
        for photo_a, photo_b in self._pairs(a, b):
            pair = min(photo_a, photo_b), max(photo_a, photo_b)
            rows = self.matches.matches[pair]
            rows = rows if pair[0] == photo_a else rows[:, ::-1]
            x_a, x_b = self.matches.keypoints[photo_a][rows[:, 0]], self.matches.keypoints[photo_b][rows[:, 1]]
            lines = np.hstack([a.bearings(photo_a, x_a), b.bearings(photo_b, x_b)])
            at_a, at_b = np.searchsorted(a.photos, photo_a), np.searchsorted(b.photos, photo_b)
            turned = b.R[at_b] @ join.similarity.R.T
            t = turned @ (a.centers[at_a] - join.similarity(b.centers[at_b][None])[0])
            R, t = turned @ a.R[at_a].T, t / max(float(np.linalg.norm(t)), 1e-300)
            near = pose_distances(lines, R, t) <= LOOSE_FACTOR * self.max_error_px
            right = near & is_in_front(lines, R, t)
            explained += int(np.count_nonzero(right))
            contradicted += int(np.count_nonzero(self.views.fits[pair].inliers & ~right))
        return explained, contradicted

    def _pairs(self, a: PlacedPhotos, b: PlacedPhotos) -> list[PairId]:
        """Return the pairs with most inliers between photos that only one model holds, the first model's first."""
        here, there = set(a.photos.tolist()), set(b.photos.tolist())
        alone = there - here
        found = [
            (-self.views.fits[min(i, j), max(i, j)].inlier_count, i, j)
            for i in sorted(here - there)
            for j in self.partners.get(i, ())
            if j in alone
        ]
        return [(i, j) for _, i, j in sorted(found)[:MOST_CHECKED]]


# A common frame for all fragments from their joins, and which joins contradict the others.
#
# Around a loop of joins the similarities must multiply to the identity. All loops are asked at once, as in the
# averaging of rotations: the frames that minimize the errors of all joins are found robustly, rotations first, then
# the logarithms of the scales, then the shifts. A join that is off by more than bending parts explain is dropped,
# the worst one first, and the frames are found again: chains do not drift where a loop closes them.

MOST_DEG, MOST_SCALE, MOST_SHIFT = 8.0, 0.15, 0.2
"""Errors of a join above which it contradicts the others: its angle, the logarithm of its scale, and its shift as a
share of the radius of the smaller fragment. Chosen by hand: parts that bend stay below, look-alikes do not."""
ROUNDS, LEAST_ERROR = 40, 1e-4
"""Rounds of reweighting towards the least sum of errors, and error below which a join gets no more weight."""


@dataclass(frozen=True, slots=True)
class JoinError:
    """How far a similarity is from what others say."""

    off_deg: float
    scale: float
    """Logarithm of the ratio of scales."""
    shift: float
    """As a share of the radius of the smaller fragment."""

    @property
    def excess(self) -> float:
        """The largest of the three errors, as a multiple of its limit."""
        return max(self.off_deg / MOST_DEG, abs(self.scale) / MOST_SCALE, self.shift / MOST_SHIFT)


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Fragments in common frames."""

    frames: Mapping[int, Similarity]
    """From the frame of each fragment to the common one, for the largest group of joined fragments."""
    kept: tuple[tuple[Join, JoinError], ...]
    """Joins with their errors."""
    dropped: tuple[tuple[Join, JoinError], ...]
    """Joins that contradict the others, with their errors when they were dropped."""


def align_fragments(fragments: Sequence[Fragment], joins: Sequence[Join]) -> Alignment:
    """Find a common frame for the fragments that joins connect, without joins that contradict the others.

    Args:
        fragments: models of parts.
        joins: similarities between two of them.
    """
    radii = [fragment.radius for fragment in fragments]
    left = list(joins)
    dropped: list[tuple[Join, JoinError]] = []
    while True:
        frames = _synchronize(left, len(fragments))
        errors = [join_error(join, frames, radii) for join in left]
        # a single loop is equally far off in all of its joins: the one with least evidence goes
        ranked = sorted(range(len(left)), key=lambda k: (-errors[k].excess / left[k].weight, k))
        worst = next((k for k in ranked if errors[k].excess > 1.0), None)
        if worst is None:
            break
        dropped.append((left.pop(worst), errors[worst]))
    main = _main_group(fragments, left)
    kept = tuple(zip(left, errors, strict=True))
    return Alignment({number: frames[number] for number in sorted(main)}, kept, tuple(dropped))


def _main_group(fragments: Sequence[Fragment], joins: Sequence[Join]) -> set[int]:
    """Return the joined fragments that have most photos together."""
    groups = connected_groups([(join.first, join.second) for join in joins], range(len(fragments)))

    def count_photos(group: set[int]) -> int:
        return len({photo for number in group for photo in fragments[number].placed.photos.tolist()})

    return max(groups, key=lambda group: (count_photos(group), -min(group)), default=set())


def join_error(join: Join, frames: Mapping[int, Similarity], radii: Sequence[float]) -> JoinError:
    """Return how far a join is from the frames of its fragments.

    Args:
        join: of two fragments.
        frames: of all fragments.
        radii: of all fragments, in their own units.
    """
    expected = frames[join.first].inverse().compose(frames[join.second])
    return difference(join, expected, radii)


def difference(join: Join, expected: Similarity, radii: Sequence[float]) -> JoinError:
    """Return how far a join is from another similarity between its fragments.

    Args:
        join: of two fragments.
        expected: from the second fragment into the first.
        radii: of all fragments, in their own units.
    """
    cosine = (np.trace(expected.R.T @ join.similarity.R) - 1.0) / 2.0
    smaller = min(radii[join.first], expected.scale * radii[join.second])
    return JoinError(
        float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        float(np.log(join.similarity.scale / expected.scale)),
        float(np.linalg.norm(join.similarity(join.middle) - expected(join.middle))) / max(smaller, 1e-300),
    )


def _synchronize(joins: Sequence[Join], count: int) -> dict[int, Similarity]:
    """Return the frames of all fragments that least contradict the joins; alone, each has its own."""
    frames = dict.fromkeys(range(count), Similarity(1.0, np.eye(3), np.zeros(3)))
    if not joins:
        return frames
    pairs = [(join.first, join.second) for join in joins]
    weights = {pair: join.weight for pair, join in zip(pairs, joins, strict=True)}
    turned = {pair: join.similarity.R.T for pair, join in zip(pairs, joins, strict=True)}
    rotations = {number: R.T for number, R in average_rotations(turned, weights)[0].items()}
    strengths = np.array([join.weight for join in joins])
    edges = np.array(pairs, np.int64)
    logs = np.log([join.similarity.scale for join in joins])[:, None]
    scales = np.exp(_robust_potentials(count, edges, logs, strengths, np.ones(len(joins)))[:, 0])
    turns = [Similarity(float(scale), rotations.get(k, np.eye(3)), np.zeros(3)) for k, scale in enumerate(scales)]
    # where the shared photos are, errors of rotations shift least
    steps = np.concatenate(
        [turns[join.first](join.similarity(join.middle)) - turns[join.second](join.middle) for join in joins]
    )
    sizes = np.full(len(joins), max(float(np.linalg.norm(steps, axis=1).mean()), 1e-300))
    shifts = _robust_potentials(count, edges, steps, strengths, sizes)
    return frames | {
        number: Similarity(float(scales[number]), rotations[number], shifts[number]) for number in sorted(rotations)
    }


def _robust_potentials(
    count: int, edges: NDArray[np.int64], steps: FloatArray, strengths: FloatArray, sizes: FloatArray
) -> FloatArray:
    """Return (count, k) values whose differences have the least sum of weighted distances to steps.

    The first fragment of each group has 0.

    Args:
        count: fragments.
        edges: (J, 2) numbers of fragments.
        steps: (J, k) wanted differences, second less first.
        strengths: (J,) weights.
        sizes: (J,) units in which errors are measured.
    """
    groups = DisjointGroups(range(count))
    for a, b in edges.tolist():
        groups.join(a, b)
    held = sorted({min(members) for members in groups.members.values()})
    free = np.setdiff1d(np.arange(count), held)
    A = np.zeros((len(edges), count))
    A[np.arange(len(edges)), edges[:, 1]] += 1.0
    A[np.arange(len(edges)), edges[:, 0]] -= 1.0
    values, weights = np.zeros((count, steps.shape[1])), strengths.copy()
    for _ in range(ROUNDS):
        root = np.sqrt(weights)[:, None]
        values[free] = np.linalg.lstsq(root * A[:, free], root * steps, rcond=None)[0]
        errors = np.linalg.norm(A @ values - steps, axis=1) / sizes
        weights = strengths / np.maximum(errors, LEAST_ERROR)
    return values


def loop_errors(fragments: Sequence[Fragment], joins: Sequence[Join]) -> list[tuple[tuple[int, ...], JoinError]]:
    """Return the error around each loop that a join closes, with the fragments of the loop.

    The strongest joins form a tree. Each other join closes one loop with it.

    Args:
        fragments: models of parts.
        joins: similarities between two of them.
    """
    groups, near = DisjointGroups(range(len(fragments))), dict[int, list[tuple[int, Similarity]]]()
    radii = [fragment.radius for fragment in fragments]
    found, closing = [], []
    for join in sorted(joins, key=lambda join: (-join.weight, join.first, join.second)):
        if groups.join(join.first, join.second):
            near.setdefault(join.first, []).append((join.second, join.similarity))
            near.setdefault(join.second, []).append((join.first, join.similarity.inverse()))
        else:
            closing.append(join)
    for join in closing:
        way, similarity = _way(near, join.first, join.second)
        found.append((way, difference(join, similarity, radii)))
    return found


def _way(
    near: Mapping[int, Sequence[tuple[int, Similarity]]], start: int, end: int
) -> tuple[tuple[int, ...], Similarity]:
    """Return the fragments on the way along the tree, and the similarity from the end's frame into the start's."""
    waiting: list[tuple[tuple[int, ...], Similarity]] = [((start,), Similarity(1.0, np.eye(3), np.zeros(3)))]
    while waiting:
        way, so_far = waiting.pop()
        if way[-1] == end:
            return way, so_far
        waiting += [((*way, other), so_far.compose(step)) for other, step in near[way[-1]] if other not in way[-2:-1]]
    raise ValueError("no joins lead from one fragment to the other")


SAME_DEG, SAME_SHIFT = 5.0, 0.25
"""Angle, and shift as a share of the median distance of a photo's points, up to which a fragment has a photo where the
merged model has it; else its points do not count as seen by that photo. Chosen by hand."""


def merge_fragments(fragments: Sequence[Fragment], frames: Mapping[int, Similarity]) -> PlacedPhotos:
    """Return the photos and points of all fragments that have a frame.

    A photo has the pose that the part has found which owns it, else that of the largest fragment with it.

    Args:
        fragments: models of parts.
        frames: from the frame of a fragment into the common one, by its number.
    """
    moved = {number: _move(fragments[number].placed, frame) for number, frame in sorted(frames.items())}
    photos, R, centers, source = _choose_poses(fragments, moved)
    cameras = {
        photo: moved[number].cameras[photo] for photo, number in zip(photos.tolist(), source.tolist(), strict=True)
    }
    tracks = [_sound_observations(model, photos, R, centers) for model in moved.values()]
    X, point, photo, keypoint = _merge_tracks(tracks)
    return PlacedPhotos(photos, R, centers, X, point, photo, keypoint, cameras)


def _move(model: PlacedPhotos, frame: Similarity) -> PlacedPhotos:
    R = np.einsum("nij,kj->nik", model.R, frame.R)
    return PlacedPhotos(
        model.photos, R, frame(model.centers), frame(model.X), model.point, model.photo, model.keypoint, model.cameras
    )


def _choose_poses(
    fragments: Sequence[Fragment], moved: Mapping[int, PlacedPhotos]
) -> tuple[IndexArray, FloatArray, FloatArray, IndexArray]:
    """Return ids of all photos, their rotations and centers, and the fragments that these are from."""
    found: dict[int, tuple[tuple[bool, int, int], int, int]] = {}
    for number, model in moved.items():
        for row, photo in enumerate(model.photos.tolist()):
            rank = photo in fragments[number].own, len(model.photos), -number
            if photo not in found or rank > found[photo][0]:
                found[photo] = rank, number, row
    photos = sorted(found)
    chosen = [found[photo][1:] for photo in photos]
    return (
        np.array(photos, np.int64),
        np.array([moved[number].R[row] for number, row in chosen]).reshape(-1, 3, 3),
        np.array([moved[number].centers[row] for number, row in chosen]).reshape(-1, 3),
        np.array([number for number, _ in chosen], np.int64),
    )


def _sound_observations(
    model: PlacedPhotos, photos: IndexArray, R: FloatArray, centers: FloatArray
) -> tuple[FloatArray, IndexArray, IndexArray, IndexArray]:
    """Return the points, and the observations by photos whose pose in this model is that of the merged one."""
    rows = np.searchsorted(photos, model.photos)
    traces = np.einsum("nij,nij->n", model.R, R[rows])
    angles = np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))
    at = np.searchsorted(model.photos, model.photo)
    away = np.linalg.norm(model.X[model.point] - model.centers[at], axis=1)
    usual = float(np.median(away)) if len(away) else 1.0
    shifts = np.linalg.norm(model.centers - centers[rows], axis=1) / max(usual, 1e-300)
    kept = ((angles <= SAME_DEG) & (shifts <= SAME_SHIFT))[at]
    return model.X, model.point[kept], model.photo[kept], model.keypoint[kept]


def _merge_tracks(
    tracks: Sequence[tuple[FloatArray, IndexArray, IndexArray, IndexArray]],
) -> tuple[FloatArray, IndexArray, IndexArray, IndexArray]:
    """Return points (P, 3), and of each observation the point, the photo and the keypoint, in order of points.

    Tracks with a keypoint in common become one; of several keypoints of one photo in it, one stays.

    Args:
        tracks: of each model, the points, and of each observation the row of the point, the photo and the keypoint.
    """
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
    long = np.bincount(owner, minlength=len(mean)) >= 2
    kept = long[owner]
    rows = np.cumsum(long) - 1
    return mean[long], rows[owner[kept]], photo[kept], keypoint[kept]
