"""Other divisions of the photos into cameras: split groups, two cameras, one camera for each photo."""

from collections.abc import Mapping, Sequence
from heapq import heapify, heappop, heappush
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfm_app.selfcal import consensus as consensus_peak
from sfm_app.selfcal.consensus import Consensus
from sfm_app.selfcal.groups import FOCALS, FocalGrid, VoteTables, subsample_pairs
from sfm_app.selfcal.pairs import LOG_FOCAL
from sfm_app.types import PairId
from sfm_app.types.arrays import FloatArray, IndexArray

# Divide photos of supposedly one camera by focal: a zoom, or mixed devices without EXIF.
#
# Several cameras are several peaks of the consensus (thesis Figure 5.15, left undone there). The photos whose pairs
# agree on a peak are the core. For each other photo, its pairs with the core vote on its focal. Where photos
# clearly have another focal, every photo is assigned the camera with which its pairs agree best.

SIGMA = 0.03
"""Width of the votes, in units of r: focals 3 % apart still agree, those 10 % apart do not. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
FAIR_SHARE = 0.5
"""Share of its possible votes that a photo needs to belong to a peak, or to have another focal. Chosen by hand; halved
and doubled by `benchmarks.sensitivity`."""
OTHER_FOCAL = 0.05
"""Difference in log f from which on it is another camera. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
LEAST_FOCAL_GAIN = 0.25
"""Share of a photo's votes by which another focal must beat that of the peak. docs/algorithms.md, Self-calibration, 6.
Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
LEAST_SPLIT_GAIN = 0.25
"""Share of the votes of the photos of all other cameras together that a split must win. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
FOCAL_REACH, TRIALS = 1.1, 111
"""Range in log f and number of the focals that are tried for a photo: up to three times longer or shorter. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
MOST_PEAKS = 4
"""Peaks of the consensus that serve as starts. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
SPLIT_ROUNDS = 10
"""Most rounds of assigning photos to cameras. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""


def split_by_focal(
    tables: VoteTables, photos: Sequence[PairId], starts: Sequence[FloatArray]
) -> tuple[FloatArray, dict[int, int]]:
    """Find cameras that share all but the focal, and which photo is of which.

    Args:
        tables: undistorted pairs, in longer sides from the middle of the photos; its members are not used.
        photos: the two photos of each pair.
        starts: (5,) each, candidate cameras.

    Returns:
        (C, 5) cameras, and the number of the camera by photo; one camera where the photos agree.
    """
    everyone = sorted({photo for pair in photos for photo in pair})
    pairs = _PairVotes(tables, photos)
    _, theta, core = max((pairs.find_core(theta, everyone) for theta in starts), key=lambda found: found[0])
    one = theta[None]
    named = [focal for photo in everyone if photo not in core for focal in pairs.find_other_focal(photo, theta, core)]
    focals = _cluster_medians(named)
    if not focals:
        return one, dict.fromkeys(everyone, 0)
    cameras = np.repeat(one, 1 + len(focals), axis=0)
    cameras[1:, LOG_FOCAL] += focals
    labels = pairs.assign_cameras(cameras, everyone, core)
    gain = pairs.total(cameras, labels) - max(
        pairs.total(cameras, dict.fromkeys(everyone, k)) for k in range(len(cameras))
    )
    if gain <= LEAST_SPLIT_GAIN * pairs.most_votes({photo for photo, label in labels.items() if label != 0}):
        return one, dict.fromkeys(everyone, 0)
    used = sorted(set(labels.values()))
    return cameras[used], {photo: used.index(label) for photo, label in labels.items()}


def peak_cameras(consensus: Consensus) -> list[FloatArray]:
    """Return the peaks of the consensus as cameras (5,) without distortion, highest first."""
    answer = consensus_peak.find_peak(consensus)
    return [np.append(theta, 0.0) for theta in (answer.theta, *answer.others)][:MOST_PEAKS]


class _PairVotes:
    """Votes of pairs of photos for cameras."""

    def __init__(self, tables: VoteTables, photos: Sequence[PairId]) -> None:
        self.tables, self.photos = tables, photos
        self.pairs_of: dict[int, list[int]] = {}
        for k, pair in enumerate(photos):
            for photo in pair:
                self.pairs_of.setdefault(photo, []).append(k)

    def find_core(self, theta: FloatArray, everyone: Sequence[int]) -> tuple[float, FloatArray, set[int]]:
        """Find the photos that agree on a camera; return their votes beyond the fair share, the camera, and them."""
        beyond = [
            float(self.tables.votes(k, theta[None], theta[None], SIGMA)[0, 0] - FAIR_SHARE * self.tables.weights[k])
            for k in range(len(self.photos))
        ]
        core = set(everyone)

        def worth(photo: int) -> float:
            return sum((beyond[k] for k in self.pairs_of[photo] if core.issuperset(self.photos[k])), 0.0)

        known = {photo: worth(photo) for photo in everyone}
        waiting = [(value, photo) for photo, value in known.items()]
        heapify(waiting)
        while len(core) > 2 and waiting:
            value, worst = heappop(waiting)
            if worst not in core or value != known[worst]:  # it has changed since
                continue
            if value >= 0:
                break
            core.remove(worst)
            for other in {photo for k in self.pairs_of[worst] for photo in self.photos[k]} & core:
                known[other] = worth(other)
                heappush(waiting, (known[other], other))
        inside = [value for pair, value in zip(self.photos, beyond, strict=True) if core.issuperset(pair)]
        return float(sum(inside)), theta, core

    def find_other_focal(self, photo: int, theta: FloatArray, core: set[int]) -> list[float]:
        """Return the step in log f to the focal that a photo's pairs with the core clearly prefer; empty for none."""
        steps = np.linspace(-FOCAL_REACH, FOCAL_REACH, TRIALS)
        trials = np.repeat(theta[None], TRIALS, axis=0)
        trials[:, LOG_FOCAL] += steps
        votes, most = np.zeros(TRIALS), 0.0
        for k in self.pairs_of[photo]:
            first, second = self.photos[k]
            if first == photo and second in core:
                votes += self.tables.votes(k, trials, theta[None], SIGMA)[:, 0]
            elif second == photo and first in core:
                votes += self.tables.votes(k, theta[None], trials, SIGMA)[0]
            else:
                continue
            most += self.tables.weights[k]
        best = int(np.argmax(votes))
        clear = votes[best] - votes[TRIALS // 2] > LEAST_FOCAL_GAIN * most and votes[best] >= FAIR_SHARE * most
        return [float(steps[best])] if clear and abs(steps[best]) > OTHER_FOCAL else []

    def assign_cameras(self, cameras: FloatArray, everyone: Sequence[int], core: set[int]) -> dict[int, int]:
        """Give every photo in turn the camera for which its pairs vote most, until none changes."""
        labels = {photo: 0 if photo in core else -1 for photo in everyone}
        for _ in range(SPLIT_ROUNDS):
            before = dict(labels)
            for photo in everyone:
                votes = np.zeros(len(cameras))
                for k in self.pairs_of[photo]:
                    first, second = self.photos[k]
                    if first == photo and labels[second] >= 0:
                        votes += self.tables.votes(k, cameras, cameras[labels[second]][None], SIGMA)[:, 0]
                    elif second == photo and labels[first] >= 0:
                        votes += self.tables.votes(k, cameras[labels[first]][None], cameras, SIGMA)[0]
                labels[photo] = int(np.argmax(votes))
            if labels == before:
                break
        return labels

    def most_votes(self, asked: set[int]) -> float:
        """Return the most votes that the pairs of the given photos can give."""
        touched = [bool(asked.intersection(pair)) for pair in self.photos]
        return float(np.sum(self.tables.weights[touched]))

    def total(self, cameras: FloatArray, labels: dict[int, int]) -> float:
        """Return the sum of the votes of all pairs."""
        return float(
            sum(
                self.tables.votes(k, cameras[labels[first]][None], cameras[labels[second]][None], SIGMA)[0, 0]
                for k, (first, second) in enumerate(self.photos)
            )
        )


def _cluster_medians(steps: Sequence[float]) -> list[float]:
    """Return the medians of clusters of values; gaps above `OTHER_FOCAL` separate clusters."""
    ordered: NDArray[np.float64] = np.sort(np.array(steps))
    cuts = np.flatnonzero(np.diff(ordered) > OTHER_FOCAL) + 1
    return [float(np.median(run)) for run in np.split(ordered, cuts) if len(run)]


# Decide from all pairs jointly whether photos of one size are of two cameras.
#
# Ours, on the constraint of thesis 5.2.4.
#
# A minority that agrees on another focal cannot be found one photo at a time: its pairs give some votes to any
# focal, and a single photo moved to another camera disagrees with the rest of its group. So for each second focal
# on a grid every photo in turn takes the camera for which its pairs vote, until none changes. At the start, a photo
# takes the camera that its pairs prefer if both of their photos change.

LEAST_STEPS_APART = 2
"""Least distance of two cameras, in steps of 7 % on the grid of focals. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
REFINE_STEPS = 4
"""Steps that both focals may move in each round of the final refinement. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
TWO_CAMERA_ROUNDS = 20
"""Most rounds of assigning photos to cameras. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
LEAST_GAIN_OF_TWO = 0.15
"""Share of the smaller camera's votes that two cameras must win against one. Chosen on 120 random scenes of one camera
(as for `camera_per_photo`; at most 0.02), and on rendered folders of `python -m benchmarks.trouble`, seeds 0 to 64: two
cameras and zooms have 0.22 to 0.70. Of the photo sets of one camera, none of which was looked at before, 0.05 at most,
but for a single photo of kitchen25."""
LEAST_DEVIATIONS_OF_TWO, LEAST_PHOTOS_OF_SMALLER = 2.5, 2
"""Least gain in its standard deviations for two cameras to be certain, and least photos of the smaller one. The folders
have 2.8 to 7.9. One photo alone is left to `camera_split`. Chosen on them, `python -m benchmarks.trouble`, seeds 0 to
64."""


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
    """Photos of the smaller camera."""

    @property
    def is_possible(self) -> bool:
        """Whether there may be two cameras."""
        return self.smaller_count >= LEAST_PHOTOS_OF_SMALLER and self.gain >= LEAST_GAIN_OF_TWO * self.most_votes

    @property
    def is_certain(self) -> bool:
        """Whether there are certainly two cameras."""
        return self.is_possible and self.deviations >= LEAST_DEVIATIONS_OF_TWO


def divide_photos(tables: VoteTables, photos: Sequence[PairId], starts: Sequence[FloatArray]) -> TwoCameras | None:
    """Divide photos among two cameras that share all but the focal, by the votes of their pairs; None for no gain.

    Args:
        tables: undistorted pairs, in longer sides from the middle of the photos; its members are not used.
        photos: the two photos of each pair.
        starts: (5,) each, candidates for the center and aspect of the photos.
    """
    rows = subsample_pairs(len(photos))
    everyone = sorted({photo for pair in photos for photo in pair})
    number = {photo: k for k, photo in enumerate(everyone)}
    members = np.array([[number[first], number[second]] for first, second in photos])[rows]
    grids = [FocalGrid(tables, rows, theta, members) for theta in starts]
    shared = [np.einsum("pgg->g", grid.votes) for grid in grids]
    best = int(np.argmax([np.max(votes) for votes in shared]))
    grid, priors = grids[best], int(np.argmax(shared[best]))
    division = _Division(grid, len(everyone))
    tried = [
        division.assign_photos(np.array([priors, other]), start)
        for other in range(FOCALS)
        if abs(other - priors) >= LEAST_STEPS_APART
        for start in division.starts(priors, other)
    ]
    places, labels = max(tried, key=lambda found: division.total(*found))
    places, labels = division.refine(places, labels)
    if len(set(labels.tolist())) == 1 or abs(places[0] - places[1]) < LEAST_STEPS_APART:
        return None
    if np.count_nonzero(labels) > len(labels) / 2:
        places, labels = places[::-1], 1 - labels
    gains = division.pair_votes(places, labels) - grid.votes[:, priors, priors]
    smaller = labels[members].astype(bool)
    theta = np.repeat(np.asarray(starts[best], np.float64)[None], 2, axis=0)
    theta[:, LOG_FOCAL] = grid.grid[places]
    noise = float(np.sqrt(np.sum(gains**2)))
    return TwoCameras(
        theta,
        {photo: int(labels[k]) for photo, k in number.items()},
        gain=float(np.sum(gains)),
        most_votes=float(np.sum(tables.weights[rows][smaller.any(axis=1)])),
        deviations=float(np.sum(gains)) / noise if noise > 0.0 else 0.0,
        smaller_count=int(np.count_nonzero(labels)),
    )


class _Division:
    """Assignment of photos to two cameras.

    Args:
        grid: votes of the pairs.
        photos: number of photos.
    """

    def __init__(self, grid: FocalGrid, photos: int) -> None:
        self.votes, self.members, self.photos = grid.votes, grid.members, photos
        self.rows = np.arange(len(grid.votes))
        self.of = [np.flatnonzero((grid.members == photo).any(axis=1)) for photo in range(photos)]

    def starts(self, priors: int, other: int) -> tuple[IndexArray, IndexArray]:
        """Return two initial labelings (N,): all photos 0, and each photo as its pairs prefer.

        The preference of a pair assumes that both of its photos change.
        """
        wants = self.votes[:, other, other] - self.votes[:, priors, priors]
        wanted = np.array([np.sum(wants[rows]) for rows in self.of])
        return np.zeros(self.photos, np.int64), (wanted > 0).astype(np.int64)

    def assign_photos(self, places: IndexArray, labels: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Give every photo in turn the camera for which its pairs vote most, until none changes."""
        labels = labels.copy()
        for _ in range(TWO_CAMERA_ROUNDS):
            changed = False
            for photo, rows in enumerate(self.of):
                worth = [self._worth(photo, rows, camera, places, labels) for camera in (0, 1)]
                better = int(worth[1] > worth[0]) if worth[0] != worth[1] else labels[photo]
                changed |= better != labels[photo]
                labels[photo] = better
            if not changed:
                break
        return places, labels

    def _worth(self, photo: int, rows: IndexArray, camera: int, places: IndexArray, labels: IndexArray) -> float:
        mine = labels[self.members[rows]]
        mine[self.members[rows] == photo] = camera
        return float(np.sum(self.votes[rows, places[mine[:, 0]], places[mine[:, 1]]]))

    def pair_votes(self, places: IndexArray, labels: IndexArray) -> FloatArray:
        """Return (P,) votes of the pairs for a division."""
        first, second = places[labels][self.members].T
        return np.asarray(self.votes[self.rows, first, second], np.float64)

    def total(self, places: IndexArray, labels: IndexArray) -> float:
        """Return the sum of the votes for a division."""
        return float(np.sum(self.pair_votes(places, labels)))

    def refine(self, places: IndexArray, labels: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Move both focals to where they win most votes, and every photo to its camera, until nothing changes."""
        for _ in range(TWO_CAMERA_ROUNDS):
            near = [np.arange(max(0, place - REFINE_STEPS), min(FOCALS, place + REFINE_STEPS + 1)) for place in places]
            tried = [np.array([first, second]) for first in near[0] for second in near[1]]
            better = max(tried, key=lambda both: self.total(both, labels))
            stays = np.array_equal(better, places)
            places, labels = self.assign_photos(better, labels)
            if stays:
                break
        return places, labels


# Decide by cross-validation over pairs whether photos of one size are of one camera.
#
# Ours, on the constraint of thesis 5.2.4.
#
# Photos from the web are brought to one size and cropped; equal sizes are no proof. A camera per photo fits any
# pairs, wrong ones too, better than one camera, because it has one more focal per photo. So both are fitted to four
# fifths of the pairs and compared on the rest. Neither predicts wrong pairs. The focal that a photo's other pairs
# give it predicts the held-out pair only where the photo has its own focal.

LEAST_PHOTOS_PER_PHOTO = 5
"""With fewer photos, the pairs that are not held out do not determine the focal of a photo. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
FOLDS = 5
"""Parts of the pairs that are held out in turn (docs/algorithms.md, Self-calibration, 6). Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
EXPLAINED_SHARE = 0.88
"""A camera that wins this share of all votes explains the photos: of fountain-P11 and Herz-Jesus-P8 it wins 0.94, of
ten cameras brought to one size 0.68, of one camera with four pairs in ten wrong 0.5 to 0.7. What it was chosen on:
benchmarks/corpus/tuning_sets.py."""
LEAST_GAIN_PER_PHOTO, LEAST_GAIN_OVER_SEVERAL = 0.05, 0.02
"""Share of all votes that a camera per photo must win on held-out pairs: against one camera, and against several, where
it is already certain that the photos are not of one. Chosen on 120 random scenes of one camera (lens, crop, up to two
pixels of noise, up to 40 % wrong pairs, orbits; at most 0.08 with six photos, 0.00 with ten and sixteen) and on
reichstag10 brought to one size (0.12 to 0.15); without that set, ten random cameras give the same (0.17). Of the other
photo sets, none of which was looked at before, 0.01 at most. All sets: benchmarks/corpus/tuning_sets.py."""
LEAST_DEVIATIONS_PER_PHOTO, FEW_PAIRS = 2.5, 10.0
"""Least gain in its standard deviations, with pairs taken as independent; few pairs need the second number, divided by
their number, in addition. The same scenes: at most 3.0 with six photos; reichstag10 3.6 to 3.7. Chosen with them. All
sets: benchmarks/corpus/tuning_sets.py."""
LEAST_PHOTOS_EACH = 3.0
"""Photos that each of several cameras must have on average: more cameras suggest a camera per photo. Chosen by hand;
halved and doubled by `benchmarks.sensitivity`."""


class Prediction(NamedTuple):
    """Votes of the held-out pairs for two hypotheses."""

    shared: float
    """Share of the votes for one camera, or for few."""
    own: float
    """Share of the votes for a camera per photo."""
    deviations: float
    """Difference of the votes in its standard deviations."""
    is_camera_per_photo: bool
    """Whether every photo counts as one of its own camera."""


def cross_validate(
    tables: VoteTables, photos: Sequence[PairId], starts: Sequence[FloatArray], labels: Mapping[int, int], seed: int
) -> Prediction:
    """Judge few cameras against a camera per photo on pairs held out from the fit.

    Args:
        tables: undistorted pairs, in longer sides from the middle of the photos; its members are not used.
        photos: the two photos of each pair.
        starts: (5,) each, candidates for the center and aspect of the photos; square pixels and the middle are also
            tried.
        labels: number of the camera by photo; all 0 for one camera.
        seed: of the division of the pairs into folds.
    """
    rows = subsample_pairs(len(photos))
    everyone = sorted({photo for pair in photos for photo in pair})
    if len(everyone) < LEAST_PHOTOS_PER_PHOTO:
        return Prediction(1.0, 1.0, 0.0, is_camera_per_photo=False)
    number = {photo: k for k, photo in enumerate(everyone)}
    members = np.array([[number[first], number[second]] for first, second in photos])[rows]
    few, each = _number_cameras([labels.get(photo, 0) for photo in everyone]), np.arange(len(everyone))
    least = LEAST_GAIN_PER_PHOTO if np.max(few) == 0 else LEAST_GAIN_OVER_SEVERAL
    weight = float(np.sum(tables.weights[rows]))
    grids = [FocalGrid(tables, rows, theta, members) for theta in (*starts, np.zeros(5))]
    best = max(grids, key=lambda grid: grid.fitted_votes(few))
    shared = best.fitted_votes(few) / weight
    tried = [best] if best is grids[-1] else [best, grids[-1]]
    # a gain that is missing on the fitted pairs will not appear on those held out
    if shared > EXPLAINED_SHARE or max(grid.fitted_votes(each) for grid in tried) / weight - shared <= least:
        return Prediction(shared, shared, 0.0, is_camera_per_photo=False)
    fold = np.random.default_rng(seed).permutation(len(rows)) % FOLDS
    held = best.held_out_votes(few, fold)
    own = max((grid.held_out_votes(each, fold) for grid in tried), key=lambda votes: float(np.sum(votes)))
    gain, noise = float(np.sum(own - held)), float(np.sqrt(np.sum((own - held) ** 2)))
    deviations = gain / noise if noise > 0.0 else 0.0
    clearly = gain > least * weight and deviations > LEAST_DEVIATIONS_PER_PHOTO + FEW_PAIRS / len(rows)
    return Prediction(
        float(np.sum(held)) / weight, float(np.sum(own)) / weight, deviations, is_camera_per_photo=clearly
    )


def _number_cameras(labels: Sequence[int]) -> IndexArray:
    """Return (N,) cameras counted from 0; one for all where each would have too few photos."""
    cameras = np.unique(labels, return_inverse=True)[1].astype(np.int64)
    return cameras if (np.max(cameras) + 1) * LEAST_PHOTOS_EACH <= len(cameras) else np.zeros_like(cameras)
