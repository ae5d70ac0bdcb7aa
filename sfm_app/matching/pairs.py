"""Which pairs of photos are matched: all, or those that retrieval, order and matches propose."""

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import largest_descriptors
from sfm_app.matching.features import match_pairs, read_pixels
from sfm_app.matching.known import pairs_with_news
from sfm_app.numerical import Json
from sfm_app.plugins import FeatureMethod
from sfm_app.retrieval import (
    choose_by_rank,
    count_preview_matches,
    count_shared_keypoints,
    describe_picture,
    learn_vocabulary,
    pairs_in_order,
    pairs_nearby,
    pool_descriptors,
    rank_similar,
    spread,
)
from sfm_app.runtime.context import RunContext
from sfm_app.settings import MatchSettings
from sfm_app.types import MatchedImage, MatchGraph, PairId

# Which pairs of photos are matched: all, or those that probably show the same place.
#
# The largest features of all photos are turned into visual words, photos that share words are looked at more
# closely, and where they seem to overlap they are matched, with neighbors in name, time and GPS. A second round
# follows the matches.

DescriptorArray = NDArray[np.uint8]
ReadDescriptors = Callable[[int], DescriptorArray]
"""Returns (N, 128) descriptors of a photo, the largest features first."""

LARGEST_FEATURES, PREVIEW_FEATURES = 1024, 256
"""Features of a photo, the largest, that become words, and that are compared in a preview (Wu 2013 takes 100)."""
WORDS_PER_PHOTO, FEWEST_WORDS, MOST_WORDS = 4, 512, 16384
"""Size of the vocabulary. Chosen by hand."""
POOLED = 300_000
"""Most descriptors from which the vocabulary is learned. Chosen by hand."""
RANKED, PREVIEWED = 10, 2
"""Similar photos among which a photo looks for partners, and those that it looks at, as multiples of the partners."""
SURE_SHARE = 0.25
"""Share of its partners that a photo gets whatever their preview says: plain photos have few large features."""
PREVIEW_SHARE = 0.04
"""Least share of the compared features that match in the preview of a pair. Photos of different sets reach 0.03 in 19
of 20 pairs (fountain-P11, castle-P19, temple16, kitchen1000)."""
FEWEST_COMPARED = 64
"""Features to which the share of a plainer photo refers, so that one chance match is not many."""
STEPS = (1, 2, 4, 8)
"""Photos so many steps before and after a photo by time or name are matched with it."""
SEQUENCE_SHARE = 0.5
"""Share of the partners that are neighbors in a sequence."""
NEAREST_BY_GPS = 8
"""Photos nearest by GPS that a photo is matched with."""
FRIENDS_SHARE = 0.25
"""Share of its partners that a photo gets in the second round."""
FEWEST_SHARED = 30
"""Least number of keypoints of other photos that match in both photos of a pair of the second round."""


def first_pairs(
    images: Mapping[int, MatchedImage], read: ReadDescriptors, run: RunContext, choosers: Collection[int] | None = None
) -> list[PairId]:
    """Choose pairs by what the photos show, and by name, time and GPS.

    Args:
        images: all photos by id.
        read: called in several threads.
        run: the run.
        choosers: photos that need partners; None for all.
    """
    options = run.settings.matching
    photos, count = sorted(images), options.neighbors
    steps: Sequence[int] = STEPS
    if options.pairs == "sequence":
        count, steps = max(1, round((1 - SEQUENCE_SHARE) * count)), sequence_steps(count)
    chosen = pairs_in_order(list(images.values()), steps) | pairs_nearby(list(images.values()), NEAREST_BY_GPS)
    return sorted(chosen | _similar_pairs(photos, read, count, run, choosers))


def _similar_pairs(
    photos: Sequence[int], read: ReadDescriptors, count: int, run: RunContext, choosers: Collection[int] | None
) -> set[PairId]:
    """Return pairs of photos that show the same, some for each photo."""
    largest = run.map(read, photos, "largest features")
    pooled = pool_descriptors(largest, POOLED)
    if not len(pooled):
        return set()
    with run.step("visual words"):
        size = min(MOST_WORDS, max(FEWEST_WORDS, WORDS_PER_PHOTO * len(photos)))
        vocabulary = learn_vocabulary(pooled, size, run.seed)
    words = run.map(vocabulary.quantize, largest, "words of photos")
    ranked = rank_similar(words, len(vocabulary), RANKED * count)
    looks = _candidates([[photos[k] for k in row] for row in ranked], photos, count, choosers)
    small = {photo: one[:PREVIEW_FEATURES] for photo, one in zip(photos, largest, strict=True)}
    scores = _merge(run.map(partial(_preview, small), list(looks.items()), "previews"))
    sure = choose_by_rank(scores, 1, max(1, round(SURE_SHARE * count)), choosers)
    return sure | choose_by_rank(scores, round(PREVIEW_SHARE * PREVIEW_FEATURES), count, choosers)


def sequence_steps(count: int) -> tuple[int, ...]:
    """Return the steps to the neighbors in a sequence: half of them next to each other, the others twice as far each.

    Args:
        count: partners of each photo.
    """
    near = max(2, round(SEQUENCE_SHARE * count / 2))
    return (*range(1, near + 1), *(near * 2**k for k in range(1, 4)))


def second_pairs(
    keypoints: Mapping[int, int],
    matches: Mapping[PairId, NDArray[np.uint32]],
    asked: Collection[PairId],
    options: MatchSettings,
    choosers: Collection[int] | None = None,
) -> list[PairId]:
    """Choose pairs whose photos match the same keypoints of others.

    Args:
        keypoints: number of keypoints of each photo.
        matches: of the pairs so far.
        asked: pairs that were matched already, with or without success.
        options: settings of matching.
        choosers: photos that need partners; None for all.
    """
    shared = count_shared_keypoints(keypoints, matches)
    left = {pair: count for pair, count in shared.items() if pair not in asked}
    return sorted(choose_by_rank(left, FEWEST_SHARED, max(1, round(FRIENDS_SHARE * options.neighbors)), choosers))


def _candidates(
    ranked: Sequence[Sequence[int]], photos: Sequence[int], count: int, choosers: Collection[int] | None
) -> dict[int, list[int]]:
    """Return by photo the later photos with which it is looked at more closely."""
    looks = (
        (min(photo, other), max(photo, other))
        for photo, others in zip(photos, ranked, strict=True)
        if choosers is None or photo in choosers
        for other in spread(others, PREVIEWED * count)
    )
    found: dict[int, list[int]] = {}
    for first, second in sorted(set(looks)):
        found.setdefault(first, []).append(second)
    return found


def _preview(small: Mapping[int, DescriptorArray], look: tuple[int, Sequence[int]]) -> dict[PairId, int]:
    """Return for some pairs of a photo how many of their largest features match, as if all had `PREVIEW_FEATURES`."""
    photo, others = look
    counts = count_preview_matches(small[photo], [small[other] for other in others])
    fewest = [max(min(len(small[photo]), len(small[other])), FEWEST_COMPARED) for other in others]
    scaled = (round(count * PREVIEW_FEATURES / few) for count, few in zip(counts, fewest, strict=True))
    return dict(zip(((photo, other) for other in others), scaled, strict=True))


def _merge(parts: Sequence[Mapping[PairId, int]]) -> dict[PairId, int]:
    return {pair: count for part in parts for pair, count in part.items()}


# Match the pairs that probably show the same place, in two rounds.


def match_probable_pairs(method: FeatureMethod, load: Callable[[], MatchGraph], run: RunContext) -> dict[str, Json]:
    """Match pairs of photos that look alike or lie beside each other, then pairs that these suggest.

    Pairs of photos that an earlier run has seen keep the matches that they have.

    Args:
        method: of matching; features are known.
        load: reads the match graph as it is now.
        run: the run.

    Returns:
        The options in force, for the manifest.

    Raises:
        PluginError: the method raises, or returns invalid results.
        BackendError: COLMAP failed.
    """
    before = load()
    known = run.earlier.known if run.earlier is not None else frozenset[str]()
    news = {photo for photo, image in before.images.items() if image.name not in known}
    if not news:  # photos were only taken away
        run.record(matched_pairs=0, rounds=[0, 0])
        return {}
    first = first_pairs(before.images, lambda photo: _descriptors(method, before.images[photo], run), run, news)
    first = pairs_with_news(first, before.images, known)
    in_force = match_pairs(method, run, first)
    seen, asked = load(), set(first)
    asked |= seen.matches.keys() - set(pairs_with_news(seen.matches, before.images, known))
    matches = {pair: rows for pair, rows in seen.matches.items() if pair in asked}
    counts = {photo: len(points) for photo, points in seen.keypoints.items()}
    second = second_pairs(counts, matches, asked, run.settings.matching, news)
    in_force |= match_pairs(method, run, second)
    run.record(matched_pairs=len(first) + len(second), rounds=[len(first), len(second)])
    return in_force


def _descriptors(method: FeatureMethod, image: MatchedImage, run: RunContext) -> NDArray[np.uint8]:
    """Return descriptors of the largest features of a photo: its own where they are SIFT, else those of its picture."""
    if method.sift is None:
        return describe_picture(read_pixels(run.workspace.photos / image.name), LARGEST_FEATURES)
    with translate_errors("reading features"):
        return largest_descriptors(run.workspace.database, image.id, LARGEST_FEATURES)
