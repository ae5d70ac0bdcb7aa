"""Find parts of a model whose scale depends on a few points.

Two photos do not determine the distance between them. The relative scale of a third photo comes from points that all
three see. Where a part shares hardly any of them with the rest, its points may fit well and its scale still be wrong.
"""

from heapq import heappop, heappush

import numpy as np
from scipy.sparse import csr_array, triu

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.models.model import posed_images
from sfm_app.colmap.types import Reconstruction, all_points

MIN_SHARED_POINTS = 5
"""Number of points seen by two placed photos and the next one, below which the scale between them is undetermined: a
pose takes three, two more contradict a wrong one. Of the photo sets only temple16 with every second photo (0; its
centers are a third off) and dinoSparseRing (2) have fewer; right models of castle-P19 and temple16 have 8."""


def weakly_joined_parts(model: Reconstruction) -> list[list[str]]:
    """Return the names of photos in parts whose scale against the first part depends on too few points.

    Photos join one by one: next is the one that sees most points which at least two joined photos see.
    """
    with translate_errors("reading points"):
        names = {image.image_id: image.name for image in posed_images(model)}
        tracks = [{element.image_id for element in point.track.elements} for _, point in all_points(model)]
    photos = sorted(names)
    seen = _visibility_matrix(tracks, photos)
    parts: list[list[str]] = [[]]
    for photo, known in _joining_order(seen):
        if known < MIN_SHARED_POINTS:
            parts.append([])
        parts[-1].append(names[photos[photo]])
    return [sorted(part) for part in parts[1:]]


def _visibility_matrix(tracks: list[set[int]], photos: list[int]) -> csr_array:
    """Return the matrix (N, P) with 1 where a point is seen by a photo."""
    place = {photo: k for k, photo in enumerate(photos)}
    columns = [place[photo] for track in tracks for photo in sorted(track)]
    ends = np.cumsum([0, *map(len, tracks)])
    return csr_array((np.ones(len(columns), np.int32), columns, ends), shape=(len(tracks), len(photos)))


def _joining_order(seen: csr_array) -> list[tuple[int, int]]:
    """Return the photos from the third on in joining order, each with its number of shared points."""
    points, photos = seen.shape
    if photos < 3 or points == 0:
        return []
    growth = _Growth(seen)
    for photo in growth.best_pair():
        growth.join(photo)
    joined = []
    while growth.left:
        count, photo = heappop(growth.waiting)
        if photo in growth.left and -count == growth.known[photo]:
            joined.append((photo, -count))
            growth.join(photo)
    return joined


class _Growth:
    """Photos that have joined a model, and what the others see of it.

    Args:
        seen: (P, N) with 1 where a point is seen by a photo.
    """

    def __init__(self, seen: csr_array) -> None:
        self.seen, self.by_photo = seen, seen.T.tocsr()
        points, photos = seen.shape
        self.views = np.zeros(points, np.int64)
        self.known = np.zeros(photos, np.int64)
        """Points seen by a photo and by two that have joined."""
        self.left = set(range(photos))
        self.waiting = [(0, photo) for photo in range(photos)]
        """Heap of photos by their number of known points; entries that have changed are out of date."""

    def best_pair(self) -> tuple[int, int]:
        """Return the two photos that share most points."""
        together = csr_array(triu(self.by_photo @ self.seen, k=1)).tocoo()
        i, j = together.coords
        best = np.lexsort((j, i, -together.data))[:1]
        return (int(i[best[0]]), int(j[best[0]])) if len(best) else (0, 1)

    def join(self, photo: int) -> None:
        """Add a photo."""
        own = self.by_photo.indices[self.by_photo.indptr[photo] : self.by_photo.indptr[photo + 1]]
        self.views[own] += 1
        now = self.seen[own[self.views[own] == 2]]  # the points that have just become known
        for other, more in zip(*np.unique(now.indices, return_counts=True), strict=True):
            self.known[other] += more
            heappush(self.waiting, (-int(self.known[other]), int(other)))
        self.left.discard(photo)
