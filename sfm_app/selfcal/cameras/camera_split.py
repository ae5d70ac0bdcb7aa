"""Divide photos of supposedly one camera by focal: a zoom, or mixed devices without EXIF.

Several cameras are several peaks of the consensus (thesis Figure 5.15, left undone there). The photos whose pairs agree
on a peak are the core. For each other photo, its pairs with the core vote on its focal. Where photos clearly have
another focal, every photo is assigned the camera with which its pairs agree best.
"""

from collections.abc import Sequence
from heapq import heapify, heappop, heappush

import numpy as np
from numpy.typing import NDArray

from sfm_app.selfcal.cameras.multi_camera import VoteTables
from sfm_app.selfcal.consensus import consensus_peak
from sfm_app.selfcal.consensus.consensus import Consensus
from sfm_app.selfcal.inputs import FloatArray
from sfm_app.selfcal.lens import LOG_FOCAL
from sfm_app.types import PairId

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
LEAST_GAIN = 0.25
"""Share of the votes of the photos of all other cameras together that a split must win. Chosen by hand; halved and
doubled by `benchmarks.sensitivity`."""
FOCAL_REACH, TRIALS = 1.1, 111
"""Range in log f and number of the focals that are tried for a photo: up to three times longer or shorter. Chosen by
hand; halved and doubled by `benchmarks.sensitivity`."""
MOST_PEAKS = 4
"""Peaks of the consensus that serve as starts. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
ROUNDS = 10
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
    if gain <= LEAST_GAIN * pairs.most_votes({photo for photo, label in labels.items() if label != 0}):
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
        for _ in range(ROUNDS):
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
