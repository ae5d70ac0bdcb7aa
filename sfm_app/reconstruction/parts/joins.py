"""Similarities between models of parts, from the photos and points that both hold.

One photo in both models tells all of a similarity: the rotation and the position of its camera, and by the distances of
its points the scale. The similarity with which most of the shared photos agree is refined on their points. A photo that
one of the parts has misplaced, as among look-alikes, does not agree.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.models.joined_model import PlacedPhotos
from sfm_app.geometry.similarity import Similarity, robust_similarity
from sfm_app.numerical import FAILURES
from sfm_app.posegraph.pair_pose import is_in_front
from sfm_app.posegraph.refine import pose_distances
from sfm_app.types import MatchGraph, PairId, ViewGraph

FloatArray = NDArray[np.float64]
IndexArray = NDArray[np.int64]

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
