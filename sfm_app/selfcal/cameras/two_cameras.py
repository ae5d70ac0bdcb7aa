"""Decide from all pairs jointly whether photos of one size are of two cameras.

Ours, on the constraint of thesis 5.2.4.

A minority that agrees on another focal cannot be found one photo at a time: its pairs give some votes to any focal, and
a single photo moved to another camera disagrees with the rest of its group. So for each second focal on a grid every
photo in turn takes the camera for which its pairs vote, until none changes. At the start, a photo takes the camera that
its pairs prefer if both of their photos change.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sfm_app.selfcal.cameras.focal_grid import FocalGrid, subsample_pairs
from sfm_app.selfcal.cameras.multi_camera import FOCALS, IndexArray, VoteTables
from sfm_app.selfcal.inputs import FloatArray
from sfm_app.selfcal.lens import LOG_FOCAL
from sfm_app.types import PairId

LEAST_STEPS_APART = 2
"""Least distance of two cameras, in steps of 7 % on the grid of focals. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
REFINE_STEPS = 4
"""Steps that both focals may move in each round of the final refinement. Chosen by hand; halved and doubled by
`benchmarks.sensitivity`."""
ROUNDS = 20
"""Most rounds of assigning photos to cameras. Chosen by hand; halved and doubled by `benchmarks.sensitivity`."""
LEAST_GAIN = 0.15
"""Share of the smaller camera's votes that two cameras must win against one. Chosen on 120 random scenes of one camera
(as for `camera_per_photo`; at most 0.02), and on rendered folders of `python -m benchmarks.trouble`, seeds 0 to 64: two
cameras and zooms have 0.22 to 0.70. Of the photo sets of one camera, none of which was looked at before, 0.05 at most,
but for a single photo of kitchen25."""
LEAST_DEVIATIONS, LEAST_PHOTOS = 2.5, 2
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
        return self.smaller_count >= LEAST_PHOTOS and self.gain >= LEAST_GAIN * self.most_votes

    @property
    def is_certain(self) -> bool:
        """Whether there are certainly two cameras."""
        return self.is_possible and self.deviations >= LEAST_DEVIATIONS


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
        for _ in range(ROUNDS):
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
        for _ in range(ROUNDS):
            near = [np.arange(max(0, place - REFINE_STEPS), min(FOCALS, place + REFINE_STEPS + 1)) for place in places]
            tried = [np.array([first, second]) for first in near[0] for second in near[1]]
            better = max(tried, key=lambda both: self.total(both, labels))
            stays = np.array_equal(better, places)
            places, labels = self.assign_photos(better, labels)
            if stays:
                break
        return places, labels
