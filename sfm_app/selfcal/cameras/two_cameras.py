"""Whether photos of one size are of two cameras: asked of all pairs at once.

Ours, on the constraint of thesis 5.2.4.

Photos that agree with each other on another focal hide behind a majority: their pairs have a vote or two for any focal,
and one of them alone, taken for another camera, disagrees with its own. So for each second focal on a grid every photo
takes the camera that its pairs want, beginning with what they want when both photos change, until none changes.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sfm_app.selfcal.cameras.focal_grid import FocalGrid, chosen_pairs
from sfm_app.selfcal.cameras.multi_camera import FOCALS, IndexArray, Tables
from sfm_app.selfcal.inputs import FloatArray
from sfm_app.selfcal.lens import LOG_FOCAL
from sfm_app.types import PairId

APART = 2
"""Steps on the grid of focals, 7 % each, that two cameras are apart. Chosen by hand; not measured on its own."""
NEAR = 4
"""Steps that both focals may move in the end. Chosen by hand; not measured on its own."""
ROUNDS = 20
"""Most times all photos are asked for their camera. Chosen by hand; not measured on its own."""
LEAST_GAIN = 0.15
"""Share of the smaller camera's votes that two must win against one. Chosen on 120 random scenes of one camera (as for
`camera_per_photo`; at most 0.02), and on rendered folders of `python -m benchmarks.trouble`, seeds 0 to 64: two
cameras and zooms have 0.22 to 0.70. Of the photo sets of one camera, none of which was looked at before, 0.05 at most,
but for a single photo of kitchen25."""
CLEARLY, LEAST_PHOTOS = 2.5, 2
"""The gain in its standard deviations from which on the photos are of two cameras; below, they may be. The folders have
2.8 to 7.9. One photo alone is left to `camera_split`. Chosen on them, `python -m benchmarks.trouble`, seeds 0 to
64."""


class TwoCameras(NamedTuple):
    """The best division of photos among two cameras."""

    cameras: FloatArray
    """(2, 5), the one of most photos first."""
    labels: dict[int, int]
    """Number of the camera, of the photos that have pairs."""
    gain: float
    """Votes that it wins against one camera."""
    stake: float
    """Most votes that the pairs of the smaller camera's photos can give."""
    deviations: float
    """The gain in its standard deviations, pairs taken as independent."""
    fewest: int
    """Photos of the smaller camera."""

    @property
    def perhaps(self) -> bool:
        """Whether it is worth a doubt that there is one camera."""
        return self.fewest >= LEAST_PHOTOS and self.gain >= LEAST_GAIN * self.stake

    @property
    def clearly(self) -> bool:
        """Whether there are two."""
        return self.perhaps and self.deviations >= CLEARLY


def two_cameras(tables: Tables, photos: Sequence[PairId], starts: Sequence[FloatArray]) -> TwoCameras | None:
    """Divide photos among two cameras that share all but the focal, as most pairs want; None where nothing is gained.

    Args:
        tables: the pairs, without lens, in longer sides about the middle; its members are not used.
        photos: per pair its two photos.
        starts: (5,) each, cameras whose center and pixels may be those of the photos.
    """
    rows = chosen_pairs(len(photos))
    everyone = sorted({photo for pair in photos for photo in pair})
    number = {photo: k for k, photo in enumerate(everyone)}
    members = np.array([[number[first], number[second]] for first, second in photos])[rows]
    grids = [FocalGrid(tables, rows, theta, members) for theta in starts]
    shared = [np.einsum("pgg->g", grid.votes) for grid in grids]
    best = int(np.argmax([np.max(votes) for votes in shared]))
    grid, priors = grids[best], int(np.argmax(shared[best]))
    division = _Division(grid, len(everyone))
    tried = [
        division.settled(np.array([priors, other]), start)
        for other in range(FOCALS)
        if abs(other - priors) >= APART
        for start in division.starts(priors, other)
    ]
    places, labels = max(tried, key=lambda found: division.total(*found))
    places, labels = division.refined(places, labels)
    if len(set(labels.tolist())) == 1 or abs(places[0] - places[1]) < APART:
        return None
    if np.count_nonzero(labels) > len(labels) / 2:
        places, labels = places[::-1], 1 - labels
    gains = division.each(places, labels) - grid.votes[:, priors, priors]
    smaller = labels[members].astype(bool)
    theta = np.repeat(np.asarray(starts[best], np.float64)[None], 2, axis=0)
    theta[:, LOG_FOCAL] = grid.grid[places]
    noise = float(np.sqrt(np.sum(gains**2)))
    return TwoCameras(
        theta,
        {photo: int(labels[k]) for photo, k in number.items()},
        gain=float(np.sum(gains)),
        stake=float(np.sum(tables.weights[rows][smaller.any(axis=1)])),
        deviations=float(np.sum(gains)) / noise if noise > 0.0 else 0.0,
        fewest=int(np.count_nonzero(labels)),
    )


class _Division:
    """Photos, each with one of two cameras.

    Args:
        grid: votes of the pairs.
        photos: how many.
    """

    def __init__(self, grid: FocalGrid, photos: int) -> None:
        self.votes, self.members, self.photos = grid.votes, grid.members, photos
        self.rows = np.arange(len(grid.votes))
        self.of = [np.flatnonzero((grid.members == photo).any(axis=1)) for photo in range(photos)]

    def starts(self, priors: int, other: int) -> tuple[IndexArray, IndexArray]:
        """Return (N,) all with the usual focal.

        And each with what its pairs want, when both photos of a pair take it.
        """
        wants = self.votes[:, other, other] - self.votes[:, priors, priors]
        wanted = np.array([np.sum(wants[rows]) for rows in self.of])
        return np.zeros(self.photos, np.int64), (wanted > 0).astype(np.int64)

    def settled(self, places: IndexArray, labels: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Return every photo in turn takes the camera for which its pairs vote most, until none changes."""
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

    def each(self, places: IndexArray, labels: IndexArray) -> FloatArray:
        """Return (P,) votes of the pairs."""
        first, second = places[labels][self.members].T
        return np.asarray(self.votes[self.rows, first, second], np.float64)

    def total(self, places: IndexArray, labels: IndexArray) -> float:
        """Return the sum of the votes."""
        return float(np.sum(self.each(places, labels)))

    def refined(self, places: IndexArray, labels: IndexArray) -> tuple[IndexArray, IndexArray]:
        """Move both focals where the pairs want them, and every photo to its camera, until none changes."""
        for _ in range(ROUNDS):
            near = [np.arange(max(0, place - NEAR), min(FOCALS, place + NEAR + 1)) for place in places]
            tried = [np.array([first, second]) for first in near[0] for second in near[1]]
            better = max(tried, key=lambda both: self.total(both, labels))
            stays = np.array_equal(better, places)
            places, labels = self.settled(better, labels)
            if stays:
                break
        return places, labels
