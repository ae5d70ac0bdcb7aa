"""Choose pairs of photos that may show the same things, by a vocabulary of their features."""

import math
import re
from collections.abc import Collection, Mapping, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sfm_app.settings import MatchSettings
from sfm_app.types import MatchedImage, PairId
from sfm_app.types.arrays import ByteArray, Float32Array, IndexArray

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Choice among similar photos: the nearest ones, and of the others some at every distance. In a video the most similar
# photos are the neighbors, which add no parallax; less similar photos of the same place hold a model together.


class OPTIONS:
    """Choice of partners, previews and vocabulary."""

    nearest_share: float = 0.4
    """Share of the partners of a photo that are its nearest; the others are spread evenly. Chosen by hand on the video
    kitchen1000."""
    longer_side_px: int = 1000
    """Longer side of pictures with SIFT descriptors: large features are visible in small pictures. Chosen by hand."""
    max_ratio: float = 0.8
    """Largest ratio of the distances to the nearest and the second nearest descriptor (Lowe 2004)."""
    branches: int = 64
    """Words of the first level; each is divided again, so that learning takes the square root of the time."""
    rounds: int = 8
    """Rounds of k-means at each level; words only have to be dense where descriptors are. Chosen by hand."""
    samples_per_word: int = 16
    """Descriptors from which a word is learned, on average. Chosen by hand."""


BLOCK = 256
"""Photos whose keypoints or similarities are in memory at once; no result depends on it. Chosen by hand."""


def wants_all_pairs(photos: int, options: MatchSettings) -> bool:
    """Return whether all pairs are matched: as the user says, or because there is little to choose."""
    if options.pairs == "all" or photos <= options.neighbors + 1:
        return True
    return options.pairs == "auto" and math.comb(photos, 2) <= expected_pairs(photos, options)


def expected_pairs(photos: int, options: MatchSettings) -> int:
    """Return about how many pairs are matched."""
    every = math.comb(photos, 2)
    return every if options.pairs == "all" else min(every, photos * options.neighbors)


def spread(ranked: Sequence[int], count: int) -> list[int]:
    """Return at most `count` > 0 of ranked photos: the best, and others at even steps among the rest."""
    if len(ranked) <= count:
        return list(ranked)
    first = round(OPTIONS.nearest_share * count)
    rest, others = ranked[first:], count - first
    return [*ranked[:first], *(rest[(2 * k + 1) * len(rest) // (2 * others)] for k in range(others))]


def choose_by_rank(
    scores: Mapping[PairId, int], least: int, count: int, choosers: Collection[int] | None = None
) -> set[PairId]:
    """Return pairs so that each photo has some with its best and its fair partners.

    Pairs with a score below `least` are left out. Each of the `choosers` (None: all photos) gets `count` partners, and
    those that chose it.
    """
    partners: dict[int, list[tuple[int, int]]] = {}
    for (a, b), score in scores.items():
        if score >= least:
            partners.setdefault(a, []).append((-score, b))
            partners.setdefault(b, []).append((-score, a))
    pairs = set[PairId]()
    for photo, ranked in partners.items():
        if choosers is not None and photo not in choosers:
            continue
        chosen = spread([other for _, other in sorted(ranked)], count)
        pairs |= {(min(photo, other), max(photo, other)) for other in chosen}
    return pairs


# Pairs along the graph of matches: photos that match the same keypoints of a third one. The second round closes
# loops: where one pair joins two places, their neighbors are compared, too.


def count_shared_keypoints(
    keypoints: Mapping[int, int], matches: Mapping[PairId, NDArray[np.uint32]], block: int = BLOCK
) -> dict[PairId, int]:
    """Count, for pairs without matches, the keypoints of third photos that match in both, a block at a time."""
    from scipy import sparse

    photos = sorted(keypoints)
    place = {photo: k for k, photo in enumerate(photos)}
    partners: list[list[tuple[int, IndexArray]]] = [[] for _ in photos]
    for (a, b), rows in sorted(matches.items()):
        partners[place[a]].append((place[b], rows[:, 0].astype(np.int64)))
        partners[place[b]].append((place[a], rows[:, 1].astype(np.int64)))
    total = sparse.csr_array((len(photos), len(photos)), dtype=np.int64)
    for start in range(0, len(photos), block):
        part = range(start, min(start + block, len(photos)))
        incidence = _points_in_others([partners[k] for k in part], [keypoints[photos[k]] for k in part], len(photos))
        total = sparse.csr_array(total + incidence @ incidence.T)
    shared = sparse.triu(total, k=1).tocoo()
    named = ((photos[i], photos[j]) for i, j in zip(*(axis.tolist() for axis in shared.coords), strict=True))
    return {pair: count for pair, count in zip(named, shared.data.tolist(), strict=True) if pair not in matches}


def _points_in_others(partners: list[list[tuple[int, IndexArray]]], keypoints: list[int], photos: int) -> "csr_array":
    """Return (photos, keypoints of some photos): in which other photos each keypoint has a match."""
    from scipy import sparse

    starts = np.cumsum([0, *keypoints])
    ends = [(other, rows + starts[k]) for k, others in enumerate(partners) for other, rows in others]
    owners = np.repeat(np.array([other for other, _ in ends], np.int64), [len(rows) for _, rows in ends])
    points = np.concatenate([np.zeros(0, np.int64), *(rows for _, rows in ends)])
    return sparse.coo_array((np.ones(len(points), np.int64), (owners, points)), shape=(photos, starts[-1])).tocsr()


# Photos that were taken beside each other: by name, by time and by GPS.


def pairs_in_order(images: Sequence[MatchedImage], steps: Sequence[int]) -> set[PairId]:
    """Return pairs of photos that are some steps > 0 apart in time, or in the order of their names within a folder."""
    rows: dict[str, list[MatchedImage]] = {}
    for image in images:
        rows.setdefault(image.name.rpartition("/")[0], []).append(image)
    pairs = set[PairId]()
    for row in rows.values():
        ordered = [image.id for image in sorted(row, key=_order_key)]
        pairs |= {_pair(a, b) for step in steps for a, b in zip(ordered, ordered[step:], strict=False)}
    return pairs


def pairs_nearby(images: Sequence[MatchedImage], count: int) -> set[PairId]:
    """Return pairs of photos with the `count` photos whose GPS positions are nearest."""
    from scipy.spatial import cKDTree

    located = [(image.id, image.gps) for image in images if image.gps is not None]
    if len(located) < 2:
        return set()
    north, east = np.radians([(gps.latitude_deg, gps.longitude_deg) for _, gps in located]).T
    positions = np.column_stack([np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)])
    nearest = np.atleast_2d(cKDTree(positions).query(positions, k=min(count + 1, len(located)))[1]).tolist()
    ids = [photo for photo, _ in located]
    return {_pair(ids[row], ids[k]) for row, others in enumerate(nearest) for k in others if k != row}


def _order_key(image: MatchedImage) -> tuple[float, list[tuple[int, str]], int]:
    parts = [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", image.name)]
    return (image.time_s if image.time_s is not None else 0.0), parts, image.id


def _pair(a: int, b: int) -> PairId:
    return (a, b) if a < b else (b, a)


def describe_picture(pixels: ByteArray, most: int) -> ByteArray:
    """Return at most `most` SIFT descriptors (N, 128) of an (H, W, 3) RGB picture, the largest features first."""
    import cv2  # an estimate of the cost needs none of these libraries

    gray = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    scale = OPTIONS.longer_side_px / max(gray.shape)
    if scale < 1.0:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = cv2.SIFT.create().detectAndCompute(gray, None)
    if descriptors is None:
        return np.zeros((0, 128), np.uint8)
    order = np.argsort([-point.size for point in keypoints], kind="stable")[:most]
    return np.asarray(np.clip(np.rint(descriptors[order]), 0, 255), np.uint8)


# Previews: a few of the largest features show whether two photos overlap, at a hundredth of the cost (Wu 2013).

DescriptorArray = NDArray[np.uint8]


def count_preview_matches(first: DescriptorArray, others: Sequence[DescriptorArray]) -> list[int]:
    """Count the descriptors (N, 128) of a photo and of others that are each other's nearest, and clearly so."""
    if not others or not len(first):
        return [0] * len(others)
    a, b = first.astype(np.float32), np.concatenate(others).astype(np.float32)
    squares = a @ b.T  # whole numbers below 2^24: exact, whatever the order of summation
    squares *= -2.0
    squares += np.einsum("nd,nd->n", a, a)[:, None]
    squares += np.einsum("md,md->m", b, b)
    ends = np.cumsum([0, *map(len, others)])
    return [_count_mutual(squares[:, start:end]) for start, end in pairwise(ends)]


def _count_mutual(squares: Float32Array) -> int:
    """Count the rows of squared distances (N, M) whose clear minimum is also that of its column; changes them."""
    if min(squares.shape) < 2:
        return 0
    rows, owners = np.arange(len(squares)), squares.argmin(axis=0)
    nearest = squares.argmin(axis=1)
    least = squares[rows, nearest]
    squares[rows, nearest] = np.inf
    return int(np.count_nonzero((least < OPTIONS.max_ratio**2 * squares.min(axis=1)) & (owners[nearest] == rows)))


# Similar photos: inverted files with weights by frequency (Sivic and Zisserman 2003).


def rank_similar(words: Sequence[IndexArray], size: int, most: int) -> list[IndexArray]:
    """Rank for each photo at most `most` photos with common words (N,), the most similar first.

    A word counts with the root of its frequency in the photo, since patterns repeat within photos (Jegou 2009), and
    less if it is in many photos. `size` is that of the vocabulary.
    """
    vectors = _weigh(words, size)
    transposed, rows = vectors.T.tocsc(), []
    for start in range(0, len(words), BLOCK):
        scores = (vectors[start : start + BLOCK] @ transposed).toarray()
        for row, values in enumerate(scores):
            values[start + row] = 0.0
            order = np.argsort(-values, kind="stable")[:most]
            rows.append(order[values[order] > 0.0].astype(np.int64))
    return rows


def _weigh(words: Sequence[IndexArray], size: int) -> "csr_array":
    """Return (photos, words) the weights of words in photos, with rows of length 1."""
    from scipy import sparse

    photos = np.repeat(np.arange(len(words)), [len(one) for one in words])
    columns = np.concatenate([np.zeros(0, np.int64), *words])
    counts = sparse.coo_array((np.ones(len(columns)), (photos, columns)), shape=(len(words), size)).tocsr()
    counts.sum_duplicates()
    photos_with = np.bincount(counts.indices, minlength=size)
    rarity = np.log(len(words) / np.maximum(photos_with, 1))
    counts.data = np.sqrt(counts.data) * rarity[counts.indices]
    lengths = np.sqrt(np.asarray(counts.multiply(counts).sum(axis=1)).ravel())
    return sparse.csr_array(sparse.diags_array(1.0 / np.maximum(lengths, 1e-12)) @ counts)


# Vocabulary of visual words, learned from the photos themselves. Descriptors and words are whole numbers: products of
# both are exact in 32-bit floats, in any order of summation. So the same photos give the same words on every machine
# and with any number of threads.


def learn_vocabulary(descriptors: DescriptorArray, size: int, seed: int) -> Float32Array:
    """Learn visual words by k-means in two levels from descriptors (N, 128), N > 0, of all photos.

    Returns (K, 128), K <= `size`, the centers of clusters: whole numbers, 0 to 255.
    """
    rng = np.random.default_rng(seed)
    most = min(len(descriptors), OPTIONS.samples_per_word * size)
    data = descriptors[np.sort(rng.permutation(len(descriptors))[:most])].astype(np.float32)
    branches = _cluster(data, min(OPTIONS.branches, max(1, size // 2)), rng)
    nearest = nearest_words(branches, data)
    parts = [data[nearest == k] for k in range(len(branches))]
    shares = [max(1, round(size * len(part) / len(data))) for part in parts]
    leaves = [_cluster(part, share, rng) for part, share in zip(parts, shares, strict=True) if len(part)]
    return np.unique(np.concatenate(leaves), axis=0)


def _cluster(data: Float32Array, count: int, rng: np.random.Generator) -> Float32Array:
    """Return the centers of clusters, rounded to whole numbers; fewer where there are fewer data."""
    centers = np.unique(data[rng.permutation(len(data))[:count]], axis=0)
    for _ in range(OPTIONS.rounds):
        nearest = nearest_words(centers, data)
        order = np.argsort(nearest, kind="stable")
        used, starts = np.unique(nearest[order], return_index=True)
        sums = np.add.reduceat(data[order].astype(np.int64), starts, axis=0)
        counts = np.diff(np.append(starts, len(data)))
        means = np.rint(sums / counts[:, None]).astype(np.float32)
        if len(used) == len(centers) and np.array_equal(means, centers):
            break
        centers = np.unique(means, axis=0)
    return centers


def nearest_words(words: Float32Array, descriptors: NDArray[np.uint8 | np.float32]) -> IndexArray:
    """Return (N,) rows of the words that are nearest to the descriptors (N, 128); of equal ones the first."""
    half = 0.5 * np.einsum("kd,kd->k", words, words)
    nearest = np.empty(len(descriptors), np.int64)
    for start in range(0, len(descriptors), 4096):
        part = slice(start, start + 4096)
        nearest[part] = np.argmax(descriptors[part].astype(np.float32) @ words.T - half, axis=1)
    return nearest


def pool_descriptors(photos: Sequence[DescriptorArray], most: int) -> DescriptorArray:
    """Return at most `most` descriptors, the first ones of each photo and about equally many of each."""
    each = max(1, most // max(len(photos), 1))
    return np.concatenate([np.zeros((0, 128), np.uint8), *(one[:each] for one in photos)])
