"""Matches that an earlier run has."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import photo_names, read_features
from sfm_app.runtime.context import Earlier
from sfm_app.types import MatchedImage, MatchGraph, PairId


@dataclass(frozen=True, slots=True)
class SameMatches:
    """What is the same as in an earlier run, byte for byte."""

    photos: frozenset[int]
    """Known photos with the same ids and keypoints."""
    pairs: frozenset[PairId]
    """Pairs of such photos with the same matches."""


def find_same_matches(matches: MatchGraph, earlier: Earlier) -> SameMatches:
    """Find photos and pairs with the keypoints and matches that are in the database of an earlier run.

    Args:
        matches: of this run.
        earlier: what the earlier run left behind.
    """
    with translate_errors("reading the earlier database"):
        names, (keypoints, rows) = photo_names(earlier.place.database), read_features(earlier.place.database)
    photos = frozenset(
        photo
        for photo, image in matches.images.items()
        if image.name in earlier.known
        and names.get(photo) == image.name
        and np.array_equal(keypoints.get(photo, np.zeros((0, 2))), matches.keypoints[photo])
    )
    pairs = frozenset(
        pair
        for pair, found in matches.matches.items()
        if photos.issuperset(pair) and pair in rows and np.array_equal(rows[pair], found)
    )
    return SameMatches(photos, pairs)


def pairs_with_news(
    pairs: Iterable[PairId], images: Mapping[int, MatchedImage], known: Collection[str]
) -> list[PairId]:
    """Return the pairs with a photo that is not known.

    Args:
        pairs: ids of two photos each.
        images: all photos by id.
        known: names of the photos whose pairs were chosen before.
    """
    return [pair for pair in pairs if not all(images[photo].name in known for photo in pair)]
