"""Which pairs of photos are matched: all, or those that retrieval, order and matches propose."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from sfm_app import retrieval
from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.database import largest_descriptors, photo_names, read_features
from sfm_app.matching.features import match_pairs, read_pixels
from sfm_app.plugins import FeatureMethod
from sfm_app.runtime.context import Earlier, RunContext
from sfm_app.settings import MatchSettings
from sfm_app.types import MatchedImage, MatchGraph, PairId
from sfm_app.types.arrays import ByteArray

# The largest features of all photos become visual words. Photos with common words are compared in previews, and
# matched where they seem to overlap, with neighbors in name, time and GPS. A second round follows the matches.

ReadDescriptors = Callable[[int], retrieval.DescriptorArray]
"""Returns (N, 128) descriptors of a photo, the largest features first."""


class OPTIONS:
    """How pairs are chosen."""

    largest_features: int = 1024
    """Largest features of a photo, which become words. Chosen by hand."""
    preview_features: int = 256
    """Largest features of a photo that are compared in a preview; Wu (2013) takes 100. Chosen by hand."""
    words_per_photo: int = 4
    """Size of the vocabulary over the number of photos. Chosen by hand."""
    fewest_words: int = 512
    """Smallest vocabulary. Chosen by hand."""
    most_words: int = 16384
    """Largest vocabulary. Chosen by hand."""
    pooled: int = 300_000
    """Most descriptors from which the vocabulary is learned. Chosen by hand."""
    ranked: int = 10
    """Similar photos among which a photo looks for partners, over its number of partners. Chosen by hand."""
    previewed: int = 2
    """Photos that it is compared with in previews, over its number of partners. Chosen by hand."""
    sure_share: float = 0.25
    """Share of its partners that a photo gets whatever their preview: plain photos have few large features. Chosen by
    hand."""
    preview_share: float = 0.04
    """Least share of the compared features that match in a preview. Photos of different sets reach 0.03 in 19 of 20
    pairs (fountain-P11, castle-P19, temple16, kitchen1000)."""
    fewest_compared: int = 64
    """Features to which the share of a plainer photo refers, so that one chance match is not many. Chosen by hand."""
    steps: tuple[int, ...] = (1, 2, 4, 8)
    """Photos so many steps before and after a photo by time or name are matched with it. Chosen by hand."""
    sequence_share: float = 0.5
    """Share of the partners that are neighbors in a sequence. Chosen by hand."""
    nearest_by_gps: int = 8
    """Photos nearest by GPS that a photo is matched with. Chosen by hand."""
    second_share: float = 0.25
    """Share of its partners that a photo gets in the second round. Chosen by hand."""
    fewest_shared: int = 30
    """Fewest keypoints of third photos that match in both photos of a pair of the second round. Chosen by hand."""


def first_pairs(
    images: Mapping[int, MatchedImage], read: ReadDescriptors, run: RunContext, choosers: Collection[int] | None = None
) -> list[PairId]:
    """Choose pairs by content, name, time and GPS; `read` is called in threads. Only `choosers` need partners."""
    options = run.settings.matching
    photos, count = sorted(images), options.neighbors
    steps: Sequence[int] = OPTIONS.steps
    if options.pairs == "sequence":
        # half of the neighbors are adjacent, the others at doubling distances
        near = max(2, round(OPTIONS.sequence_share * count / 2))
        steps = (*range(1, near + 1), *(near * 2**k for k in range(1, 4)))
        count = max(1, round((1 - OPTIONS.sequence_share) * count))
    chosen = retrieval.pairs_in_order(list(images.values()), steps) | retrieval.pairs_nearby(
        list(images.values()), OPTIONS.nearest_by_gps
    )
    return sorted(chosen | _similar_pairs(photos, read, count, run, choosers))


def _similar_pairs(
    photos: Sequence[int], read: ReadDescriptors, count: int, run: RunContext, choosers: Collection[int] | None
) -> set[PairId]:
    largest = run.map(read, photos, "largest features")
    pooled = retrieval.pool_descriptors(largest, OPTIONS.pooled)
    if not len(pooled):
        return set()
    with run.step("visual words"):
        size = min(OPTIONS.most_words, max(OPTIONS.fewest_words, OPTIONS.words_per_photo * len(photos)))
        vocabulary = retrieval.learn_vocabulary(pooled, size, run.seed)
    words = run.map(partial(retrieval.nearest_words, vocabulary), largest, "words of photos")
    ranked = retrieval.rank_similar(words, len(vocabulary), OPTIONS.ranked * count)
    candidates = _candidates([[photos[k] for k in row] for row in ranked], photos, count, choosers)
    previews = {photo: one[: OPTIONS.preview_features] for photo, one in zip(photos, largest, strict=True)}
    parts = run.map(partial(_preview, previews), list(candidates.items()), "previews")
    scores = {pair: count for part in parts for pair, count in part.items()}
    sure = retrieval.choose_by_rank(scores, 1, max(1, round(OPTIONS.sure_share * count)), choosers)
    return sure | retrieval.choose_by_rank(
        scores, round(OPTIONS.preview_share * OPTIONS.preview_features), count, choosers
    )


def second_pairs(
    keypoints: Mapping[int, int],
    matches: Mapping[PairId, NDArray[np.uint32]],
    matched: Collection[PairId],
    options: MatchSettings,
    choosers: Collection[int] | None = None,
) -> list[PairId]:
    """Choose pairs, not `matched` yet, whose photos match the same keypoints (numbers by photo) of third photos."""
    shared = retrieval.count_shared_keypoints(keypoints, matches)
    unmatched = {pair: count for pair, count in shared.items() if pair not in matched}
    return sorted(
        retrieval.choose_by_rank(
            unmatched, OPTIONS.fewest_shared, max(1, round(OPTIONS.second_share * options.neighbors)), choosers
        )
    )


def _candidates(
    ranked: Sequence[Sequence[int]], photos: Sequence[int], count: int, choosers: Collection[int] | None
) -> dict[int, list[int]]:
    """Return by photo the later photos that it is compared with in previews."""
    pairs = (
        (min(photo, other), max(photo, other))
        for photo, others in zip(photos, ranked, strict=True)
        if choosers is None or photo in choosers
        for other in retrieval.spread(others, OPTIONS.previewed * count)
    )
    later: dict[int, list[int]] = {}
    for first, second in sorted(set(pairs)):
        later.setdefault(first, []).append(second)
    return later


def _preview(
    descriptors: Mapping[int, retrieval.DescriptorArray], candidates: tuple[int, Sequence[int]]
) -> dict[PairId, int]:
    """Return for pairs of a photo how many of their largest features match, as if all had `preview_features`."""
    photo, others = candidates
    counts = retrieval.count_preview_matches(descriptors[photo], [descriptors[other] for other in others])
    fewest = [max(min(len(descriptors[photo]), len(descriptors[other])), OPTIONS.fewest_compared) for other in others]
    scaled = (round(count * OPTIONS.preview_features / few) for count, few in zip(counts, fewest, strict=True))
    return dict(zip(((photo, other) for other in others), scaled, strict=True))


def match_probable_pairs(method: FeatureMethod, load: Callable[[], MatchGraph], run: RunContext) -> None:
    """Match pairs of photos that look alike or lie beside each other, then pairs that these suggest."""
    initial = load()
    known = run.earlier.known if run.earlier is not None else frozenset[str]()
    new = {photo for photo, image in initial.images.items() if image.name not in known}
    if not new:  # photos were only removed
        run.record(matched_pairs=0, rounds=[0, 0])
        return
    first = first_pairs(initial.images, lambda photo: _descriptors(method, initial.images[photo], run), run, new)
    first = pairs_with_new_photos(first, initial.images, known)
    match_pairs(method, run, first)
    graph, matched = load(), set(first)
    matched |= graph.matches.keys() - set(pairs_with_new_photos(graph.matches, initial.images, known))
    matches = {pair: rows for pair, rows in graph.matches.items() if pair in matched}
    counts = {photo: len(points) for photo, points in graph.keypoints.items()}
    second = second_pairs(counts, matches, matched, run.settings.matching, new)
    match_pairs(method, run, second)
    run.record(matched_pairs=len(first) + len(second), rounds=[len(first), len(second)])


def _descriptors(method: FeatureMethod, image: MatchedImage, run: RunContext) -> ByteArray:
    """Return descriptors of the largest features of a photo: its own where they are SIFT, else those of its picture."""
    if method.sift is None:
        return retrieval.describe_picture(read_pixels(run.workspace.photos / image.name), OPTIONS.largest_features)
    with translate_errors("reading features"):
        return largest_descriptors(run.workspace.database, image.id, OPTIONS.largest_features)


@dataclass(frozen=True, slots=True)
class SameMatches:
    """Photos and pairs that equal those of an earlier run, byte for byte."""

    photos: frozenset[int]
    """Known photos with the same ids and keypoints."""
    pairs: frozenset[PairId]
    """Pairs of such photos with the same matches."""


def find_same_matches(matches: MatchGraph, earlier: Earlier) -> SameMatches:
    """Find photos and pairs with the keypoints and matches of an earlier run's database."""
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
        for pair, own in matches.matches.items()
        if photos.issuperset(pair) and pair in rows and np.array_equal(rows[pair], own)
    )
    return SameMatches(photos, pairs)


def pairs_with_new_photos(
    pairs: Iterable[PairId], images: Mapping[int, MatchedImage], known: Collection[str]
) -> list[PairId]:
    """Return the pairs with a photo that is not among the known names."""
    return [pair for pair in pairs if not all(images[photo].name in known for photo in pair)]
