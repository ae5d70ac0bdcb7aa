"""Other divisions of photos of one size: cameras split by focal, two cameras, one camera for each photo.

Ours, on the constraint of thesis 5.2.4.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from typing import NamedTuple

import numpy as np

from sfm_app.selfcal.consensus import Consensus, find_peak
from sfm_app.selfcal.groups import GROUPS, FocalGrid, VoteTables
from sfm_app.selfcal.pairs import LOG_FOCAL
from sfm_app.types import PairId
from sfm_app.types.arrays import FloatArray, IndexArray

# Photos of supposedly one camera, divided by focal: a zoom, or mixed devices without EXIF.
#
# Several cameras are several peaks of the consensus (thesis Figure 5.15, left undone there). The photos whose pairs
# agree on a peak are the core. For each other photo, its pairs with the core vote on its focal. Where photos clearly
# have another focal, every photo is assigned the camera with which its pairs agree best.


@dataclass(frozen=True, slots=True)
class FocalSplitOptions:
    """Division by focal. Section 6 of docs/algorithms/zero-curves.md. Chosen by hand."""

    sigma: float = 0.03
    """Width of the votes, in r: focals 3 % apart still agree, those 10 % apart do not."""
    fair_share: float = 0.5
    """Share of its possible votes that a photo needs to belong to a peak, or to have another focal."""
    other_focal: float = 0.05
    """Difference in log f from which on it is another camera."""
    least_focal_gain: float = 0.25
    """Least gain of another focal over that of the peak, as a share of a photo's votes. Section 6."""
    least_split_gain: float = 0.25
    """Least gain of a split, as a share of the votes of the photos of all other cameras together."""
    focal_reach: float = 1.1
    """Range in log f for a photo, up to three times longer or shorter."""
    trials: int = 111
    """Focals in that range."""
    most_peaks: int = 4
    """Peaks of the consensus that serve as starts."""
    rounds: int = 10
    """Most rounds of assigning photos to cameras."""


SPLIT = FocalSplitOptions()


def split_by_focal(
    tables: VoteTables, photos: Sequence[PairId], starts: Sequence[FloatArray]
) -> tuple[FloatArray, dict[int, int]]:
    """Find cameras (C, 5) that share all but the focal, and the number of the camera of each photo; one if all agree.

    The tables are of undistorted pairs, in longer sides from the middle of the photo; their members are not used. The
    starts (5,) are candidate cameras.
    """
    everyone = sorted({photo for pair in photos for photo in pair})
    pairs = _PairVotes(tables, photos)
    _, theta, core = max((pairs.find_core(theta, everyone) for theta in starts), key=lambda core: core[0])
    one = theta[None]
    steps = [focal for photo in everyone if photo not in core for focal in pairs.find_other_focal(photo, theta, core)]
    ordered: FloatArray = np.sort(np.array(steps))
    cuts = np.flatnonzero(np.diff(ordered) > SPLIT.other_focal) + 1
    focals = [float(np.median(run)) for run in np.split(ordered, cuts) if len(run)]
    if not focals:
        return one, dict.fromkeys(everyone, 0)
    cameras = np.repeat(one, 1 + len(focals), axis=0)
    cameras[1:, LOG_FOCAL] += focals
    labels = pairs.assign_cameras(cameras, everyone, core)
    alone = max(pairs.total(cameras, dict.fromkeys(everyone, k)) for k in range(len(cameras)))
    gain = pairs.total(cameras, labels) - alone
    if gain <= SPLIT.least_split_gain * pairs.most_votes({photo for photo, label in labels.items() if label != 0}):
        return one, dict.fromkeys(everyone, 0)
    used = sorted(set(labels.values()))
    return cameras[used], {photo: used.index(label) for photo, label in labels.items()}


def peak_cameras(consensus: Consensus) -> list[FloatArray]:
    """Return the peaks of the consensus as cameras (5,) without distortion, highest first."""
    peak = find_peak(consensus)
    return [np.append(theta, 0.0) for theta in (peak.theta, *peak.rivals)][: SPLIT.most_peaks]


class _PairVotes:
    def __init__(self, tables: VoteTables, photos: Sequence[PairId]) -> None:
        self.tables, self.photos = tables, photos
        self.pairs_of: dict[int, list[int]] = {}
        for k, pair in enumerate(photos):
            for photo in pair:
                self.pairs_of.setdefault(photo, []).append(k)

    def votes(self, pair: int, first: FloatArray, second: FloatArray) -> FloatArray:
        """Return (A, B) votes of a pair for all cameras (A, 5) of view 1 and (B, 5) of view 2."""
        return self.tables.votes(pair, first, second, SPLIT.sigma)

    def find_core(self, theta: FloatArray, everyone: Sequence[int]) -> tuple[float, FloatArray, set[int]]:
        """Return the votes beyond the fair share of the photos that agree on a camera, the camera, and these photos."""
        beyond = [
            float(self.votes(k, theta[None], theta[None])[0, 0] - SPLIT.fair_share * self.tables.weights[k])
            for k in range(len(self.photos))
        ]
        core = set(everyone)

        def score(photo: int) -> float:
            return sum((beyond[k] for k in self.pairs_of[photo] if core.issuperset(self.photos[k])), 0.0)

        scores = {photo: score(photo) for photo in everyone}
        waiting = [(value, photo) for photo, value in scores.items()]
        heapify(waiting)
        while len(core) > 2 and waiting:
            value, worst = heappop(waiting)
            if worst not in core or value != scores[worst]:  # an older score
                continue
            if value >= 0:
                break
            core.remove(worst)
            for other in {photo for k in self.pairs_of[worst] for photo in self.photos[k]} & core:
                scores[other] = score(other)
                heappush(waiting, (scores[other], other))
        inside = [value for pair, value in zip(self.photos, beyond, strict=True) if core.issuperset(pair)]
        return float(sum(inside)), theta, core

    def find_other_focal(self, photo: int, theta: FloatArray, core: set[int]) -> list[float]:
        """Return the step in log f to the focal that a photo's pairs with the core clearly prefer; empty for none."""
        steps = np.linspace(-SPLIT.focal_reach, SPLIT.focal_reach, SPLIT.trials)
        trials = np.repeat(theta[None], SPLIT.trials, axis=0)
        trials[:, LOG_FOCAL] += steps
        votes, most = np.zeros(SPLIT.trials), 0.0
        for k in self.pairs_of[photo]:
            first, second = self.photos[k]
            if first == photo and second in core:
                votes += self.votes(k, trials, theta[None])[:, 0]
            elif second == photo and first in core:
                votes += self.votes(k, theta[None], trials)[0]
            else:
                continue
            most += self.tables.weights[k]
        best = int(np.argmax(votes))
        gain = votes[best] - votes[SPLIT.trials // 2]
        clear = gain > SPLIT.least_focal_gain * most and votes[best] >= SPLIT.fair_share * most
        return [float(steps[best])] if clear and abs(steps[best]) > SPLIT.other_focal else []

    def assign_cameras(self, cameras: FloatArray, everyone: Sequence[int], core: set[int]) -> dict[int, int]:
        """Give every photo in turn the camera for which its pairs vote most, until none changes."""
        labels = {photo: 0 if photo in core else -1 for photo in everyone}
        for _ in range(SPLIT.rounds):
            before = dict(labels)
            for photo in everyone:
                votes = np.zeros(len(cameras))
                for k in self.pairs_of[photo]:
                    first, second = self.photos[k]
                    if first == photo and labels[second] >= 0:
                        votes += self.votes(k, cameras, cameras[labels[second]][None])[:, 0]
                    elif second == photo and labels[first] >= 0:
                        votes += self.votes(k, cameras[labels[first]][None], cameras)[0]
                labels[photo] = int(np.argmax(votes))
            if labels == before:
                break
        return labels

    def most_votes(self, chosen: set[int]) -> float:
        """Return the most votes that the pairs of the given photos can give."""
        touched = [bool(chosen.intersection(pair)) for pair in self.photos]
        return float(np.sum(self.tables.weights[touched]))

    def total(self, cameras: FloatArray, labels: dict[int, int]) -> float:
        return float(
            sum(
                self.votes(k, cameras[labels[first]][None], cameras[labels[second]][None])[0, 0]
                for k, (first, second) in enumerate(self.photos)
            )
        )


# Two cameras, decided from all pairs jointly.
#
# A minority that agrees on another focal cannot be found one photo at a time: its pairs give some votes to any focal,
# and a single photo moved to another camera disagrees with the rest of its group. So for each second focal on a grid
# every photo in turn takes the camera for which its pairs vote, until none changes. At the start, a photo takes the
# camera that its pairs prefer if both of their photos change.


@dataclass(frozen=True, slots=True)
class TwoCameraOptions:
    """Division among two cameras.

    The limits were chosen on 120 random scenes of one camera and on `benchmarks.trouble`, seeds 0 to 64.
    """

    least_steps_apart: int = 2
    """Least distance of two cameras, in steps of 7 % on the grid of focals; by hand."""
    refine_steps: int = 4
    """Steps that both focals may move in each round of the final refinement; by hand."""
    rounds: int = 20
    """Most rounds of assigning photos to cameras; by hand."""
    least_gain: float = 0.15
    """Least gain over one camera, as a share of the smaller camera's votes: one camera has 0.05 at most, two 0.22."""
    least_deviations: float = 2.5
    """Least gain in its standard deviations for certain two cameras; the folders have 2.8 to 7.9."""
    least_photos: int = 2
    """Least photos of the smaller camera; single photos are left to `split_by_focal`."""


TWO_CAMERAS = TwoCameraOptions()


def _voting_pairs(photos: Sequence[PairId]) -> tuple[IndexArray, list[int], IndexArray]:
    """Return the rows (P,) of the pairs that vote on a grid of focals, all photos, and (P, 2) their places in these."""
    rows = np.linspace(0, len(photos) - 1, min(len(photos), GROUPS.most_pairs)).astype(np.int64)
    everyone = sorted({photo for pair in photos for photo in pair})
    place = {photo: k for k, photo in enumerate(everyone)}
    members = np.array([[place[first], place[second]] for first, second in photos], np.int64).reshape(-1, 2)
    return rows, everyone, members[rows]


class TwoCameras(NamedTuple):
    """The best division of photos among two cameras."""

    cameras: FloatArray
    """(2, 5), the one with more photos first."""
    labels: dict[int, int]
    """Number of the camera by photo, for photos that have pairs."""
    gain: float
    """Votes that the division wins against one camera."""
    most_votes: float
    """Most votes that the pairs of the smaller camera's photos can give."""
    deviations: float
    """The gain in its standard deviations, pairs taken as independent."""
    smaller_count: int

    @property
    def is_possible(self) -> bool:
        """Whether there may be two cameras."""
        return self.smaller_count >= TWO_CAMERAS.least_photos and self.gain >= TWO_CAMERAS.least_gain * self.most_votes

    @property
    def is_certain(self) -> bool:
        """Whether there are certainly two cameras."""
        return self.is_possible and self.deviations >= TWO_CAMERAS.least_deviations


def divide_photos(tables: VoteTables, photos: Sequence[PairId], starts: Sequence[FloatArray]) -> TwoCameras | None:
    """Divide photos among two cameras that share all but the focal, by the votes of their pairs; None for no gain."""
    rows, everyone, members = _voting_pairs(photos)
    grids = [FocalGrid(tables, rows, theta, members) for theta in starts]
    shared = [np.einsum("pgg->g", grid.votes) for grid in grids]
    best = int(np.argmax([np.max(votes) for votes in shared]))
    grid, usual = grids[best], int(np.argmax(shared[best]))
    division = _Division(grid, len(everyone))
    divisions = [
        division.assign_photos(np.array([usual, other]), start)
        for other in range(GROUPS.focals)
        if abs(other - usual) >= TWO_CAMERAS.least_steps_apart
        for start in division.starts(usual, other)
    ]
    places, labels = max(divisions, key=lambda one: division.total(*one))
    places, labels = division.refine(places, labels)
    if len(set(labels.tolist())) == 1 or abs(places[0] - places[1]) < TWO_CAMERAS.least_steps_apart:
        return None
    if np.count_nonzero(labels) > len(labels) / 2:
        places, labels = places[::-1], 1 - labels
    gains = grid.pair_votes(places[labels]) - grid.votes[:, usual, usual]
    smaller = labels[members].astype(bool)
    theta = np.repeat(np.asarray(starts[best], np.float64)[None], 2, axis=0)
    theta[:, LOG_FOCAL] = grid.grid[places]
    noise = float(np.sqrt(np.sum(gains**2)))
    return TwoCameras(
        theta,
        {photo: int(labels[k]) for k, photo in enumerate(everyone)},
        gain=float(np.sum(gains)),
        most_votes=float(np.sum(tables.weights[rows][smaller.any(axis=1)])),
        deviations=float(np.sum(gains)) / noise if noise > 0.0 else 0.0,
        smaller_count=int(np.count_nonzero(labels)),
    )


class _Division:
    """Assignment of a number of photos to two cameras, by the votes of pairs on a grid."""

    def __init__(self, grid: FocalGrid, photos: int) -> None:
        self.grid, self.votes, self.members, self.photos = grid, grid.votes, grid.members, photos
        self.pairs_of = [np.flatnonzero((grid.members == photo).any(axis=1)) for photo in range(photos)]

    def starts(self, usual: int, other: int) -> tuple[IndexArray, IndexArray]:
        """Return two initial labelings (N,): all photos 0, and each as its pairs prefer if both photos change."""
        gains = self.votes[:, other, other] - self.votes[:, usual, usual]
        totals = np.array([np.sum(gains[rows]) for rows in self.pairs_of])
        return np.zeros(self.photos, np.int64), (totals > 0).astype(np.int64)

    def assign_photos(self, places: IndexArray, labels: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Give every photo in turn the camera for which its pairs vote most, until none changes."""
        labels = labels.copy()
        for _ in range(TWO_CAMERAS.rounds):
            changed = False
            for photo, rows in enumerate(self.pairs_of):
                scores = [self._score(photo, rows, camera, places, labels) for camera in (0, 1)]
                better = int(scores[1] > scores[0]) if scores[0] != scores[1] else labels[photo]
                changed |= better != labels[photo]
                labels[photo] = better
            if not changed:
                break
        return places, labels

    def _score(self, photo: int, rows: IndexArray, camera: int, places: IndexArray, labels: IndexArray) -> float:
        cameras = labels[self.members[rows]]
        cameras[self.members[rows] == photo] = camera
        return float(np.sum(self.votes[rows, places[cameras[:, 0]], places[cameras[:, 1]]]))

    def total(self, places: IndexArray, labels: IndexArray) -> float:
        return float(np.sum(self.grid.pair_votes(places[labels])))

    def refine(self, places: IndexArray, labels: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Move both focals to where they win most votes, and every photo to its camera, until nothing changes."""
        for _ in range(TWO_CAMERAS.rounds):
            reach, end = TWO_CAMERAS.refine_steps, GROUPS.focals
            near = [np.arange(max(0, place - reach), min(end, place + reach + 1)) for place in places]
            trials = [np.array([first, second]) for first in near[0] for second in near[1]]
            better = max(trials, key=lambda both: self.total(both, labels))
            stays = np.array_equal(better, places)
            places, labels = self.assign_photos(better, labels)
            if stays:
                break
        return places, labels


# One camera for each photo, decided by cross-validation over pairs.
#
# Photos from the web are brought to one size and cropped; equal sizes are no proof. A camera per photo fits any pairs,
# wrong ones too, better than one camera, because it has one more focal per photo. So both are fitted to four fifths of
# the pairs and compared on the rest. Neither predicts wrong pairs. The focal that a photo's other pairs give it
# predicts the held-out pair only where the photo has its own focal.


@dataclass(frozen=True, slots=True)
class CameraPerPhotoOptions:
    """Cross-validation.

    The limits were chosen on 120 random scenes of one camera (lens, crop, noise, up to 40 % wrong pairs, orbits) and on
    reichstag10 brought to one size (benchmarks/corpus/tuning_sets.py).
    """

    least_photos: int = 5
    """Photos below which the pairs that are not held out do not determine the focal of a photo; by hand."""
    folds: int = 5
    """Parts of the pairs that are held out in turn (docs/algorithms/zero-curves.md, 6); by hand."""
    explained_share: float = 0.88
    """Share of all votes from which on a camera explains the photos: one camera wins 0.94, ten 0.68."""
    least_gain: float = 0.05
    """Least gain on held-out pairs against one camera, as a share of all votes: one camera has 0.08 at most with six
    photos and 0.00 with ten, reichstag10 0.12 to 0.15."""
    least_gain_over_several: float = 0.02
    """The same against several cameras, where one camera is already excluded."""
    least_deviations: float = 2.5
    """Least gain in its standard deviations, pairs taken as independent: one camera has 3.0 at most with six photos,
    reichstag10 3.6."""
    few_pairs: float = 10.0
    """This over the number of pairs is needed in addition."""
    least_photos_each: float = 3.0
    """Least photos of several cameras on average: more cameras suggest a camera per photo; by hand."""


PER_PHOTO = CameraPerPhotoOptions()


class Prediction(NamedTuple):
    """Votes of the held-out pairs for two hypotheses."""

    shared: float
    """Share of the votes for one camera, or for few."""
    own: float
    """Share of the votes for a camera per photo."""
    deviations: float
    is_camera_per_photo: bool


def cross_validate(
    tables: VoteTables, photos: Sequence[PairId], starts: Sequence[FloatArray], labels: Mapping[int, int], seed: int
) -> Prediction:
    """Judge few cameras against a camera per photo on pairs held out from the fit.

    Arguments as `split_by_focal`; the starts give center and aspect, and the usual ones are another start. `labels` has
    the number of the camera by photo, all 0 for one camera; the seed divides the pairs into folds.
    """
    rows, everyone, members = _voting_pairs(photos)
    if len(everyone) < PER_PHOTO.least_photos:
        return Prediction(1.0, 1.0, 0.0, is_camera_per_photo=False)
    few = np.unique([labels.get(photo, 0) for photo in everyone], return_inverse=True)[1].astype(np.int64)
    if (np.max(few) + 1) * PER_PHOTO.least_photos_each > len(few):
        few = np.zeros_like(few)
    each = np.arange(len(everyone))
    least = PER_PHOTO.least_gain if np.max(few) == 0 else PER_PHOTO.least_gain_over_several
    weight = float(np.sum(tables.weights[rows]))
    grids = [FocalGrid(tables, rows, theta, members) for theta in (*starts, np.zeros(5))]
    best = max(grids, key=lambda grid: grid.fitted_votes(few))
    shared = best.fitted_votes(few) / weight
    candidates = [best] if best is grids[-1] else [best, grids[-1]]
    # a gain that is missing on the fitted pairs will not appear on those held out
    if (
        shared > PER_PHOTO.explained_share
        or max(grid.fitted_votes(each) for grid in candidates) / weight - shared <= least
    ):
        return Prediction(shared, shared, 0.0, is_camera_per_photo=False)
    fold = np.random.default_rng(seed).permutation(len(rows)) % PER_PHOTO.folds
    held = best.held_out_votes(few, fold)
    own = max((grid.held_out_votes(each, fold) for grid in candidates), key=lambda votes: float(np.sum(votes)))
    gain, noise = float(np.sum(own - held)), float(np.sqrt(np.sum((own - held) ** 2)))
    deviations = gain / noise if noise > 0.0 else 0.0
    clearly = gain > least * weight and deviations > PER_PHOTO.least_deviations + PER_PHOTO.few_pairs / len(rows)
    return Prediction(
        float(np.sum(held)) / weight, float(np.sum(own)) / weight, deviations, is_camera_per_photo=clearly
    )
