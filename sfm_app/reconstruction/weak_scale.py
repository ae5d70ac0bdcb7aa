"""Parts of a model whose scale hangs on a few points.

Of two photos nobody knows how far apart they are. A photo finds its distance from two others by points that all three
see; where a part shares hardly one with the rest, its rays may meet well and its size still be anybody's guess.
"""

import numpy as np
from scipy.sparse import csr_array

from sfm_app.colmap.backend import backend
from sfm_app.colmap.model import posed_images
from sfm_app.colmap.types import Reconstruction, all_points

LEAST = 5
"""Points that two placed photos and the next one see, below which the scale between them is open: a pose takes three,
two more contradict a wrong one. Of the photo sets only temple16 with every second photo (0; its centers are a third
off) and dinoSparseRing (2) have less; right models of castle-P19 and temple16 have 8."""


def weakly_joined(model: Reconstruction) -> list[list[str]]:
    """Give names of photos, part by part, whose distance from first part of a model hangs on fewer than `LEAST` points.

    Photos join one after the other, each time the one that sees most points which two of those before it see.
    """
    with backend("reading points"):
        names = {image.image_id: image.name for image in posed_images(model)}
        tracks = [{element.image_id for element in point.track.elements} for _, point in all_points(model)]
    photos = sorted(names)
    seen = _seen(tracks, photos)
    parts: list[list[str]] = [[]]
    for photo, known in _joining(seen):
        if known < LEAST:
            parts.append([])
        parts[-1].append(names[photos[photo]])
    return [sorted(part) for part in parts[1:]]


def _seen(tracks: list[set[int]], photos: list[int]) -> csr_array:
    """Return (N, P) 1 where a point is seen by a photo."""
    place = {photo: k for k, photo in enumerate(photos)}
    columns = [place[photo] for track in tracks for photo in sorted(track)]
    ends = np.cumsum([0, *map(len, tracks)])
    return csr_array((np.ones(len(columns), np.int32), columns, ends), shape=(len(tracks), len(photos)))


def _joining(seen: csr_array) -> list[tuple[int, int]]:
    """Return photos from the third on as they join, each with the points by which it does."""
    points, photos = seen.shape
    if photos < 3 or points == 0:
        return []
    by_photo = seen.T.tocsr()
    together = (by_photo @ seen).toarray()
    np.fill_diagonal(together, -1)
    first = np.unravel_index(np.argmax(together), together.shape)
    left = np.ones(photos, np.bool_)
    left[list(first)] = False
    views = seen @ (~left).astype(np.int32)
    joined = []
    while left.any():
        known = np.where(left, by_photo @ (views >= 2).astype(np.int32), -1)
        photo = int(np.argmax(known))
        joined.append((photo, int(known[photo])))
        left[photo] = False
        views = seen @ (~left).astype(np.int32)
    return joined
