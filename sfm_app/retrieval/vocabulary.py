"""A vocabulary of visual words, learned from the descriptors of the set itself.

Descriptors are whole numbers, and so are words: products of both are exact in 32 bits of a float, in any order of
summation, so that the same photos give the same words on every machine and with any number of threads.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DescriptorArray = NDArray[np.uint8]
IndexArray = NDArray[np.int64]

BRANCHES = 64
"""Words of the first level; each is divided again, so that learning takes the square root of the time."""
ROUNDS = 8
"""Rounds of k-means at each level; words only have to be dense where descriptors are. Chosen by hand."""
SAMPLES_PER_WORD = 16
"""Descriptors from which a word is learned, on average. Chosen by hand."""
BLOCK = 4096
"""Descriptors that are compared with all words at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Vocabulary:
    """Visual words: the centers of clusters of descriptors."""

    words: NDArray[np.float32]
    """(K, 128) whole numbers, 0 to 255."""

    def __len__(self) -> int:
        return len(self.words)

    def quantize(self, descriptors: DescriptorArray) -> IndexArray:
        """Return (N,) the nearest word of each descriptor.

        Args:
            descriptors: (N, 128).
        """
        return _nearest(descriptors.astype(np.float32), self.words)


def learn_vocabulary(descriptors: DescriptorArray, size: int, seed: int) -> Vocabulary:
    """Learn words by k-means in two levels.

    Args:
        descriptors: (N, 128) of photos of the whole set; N > 0.
        size: most words.
        seed: of the first centers.
    """
    rng = np.random.default_rng(seed)
    most = min(len(descriptors), SAMPLES_PER_WORD * size)
    data = descriptors[np.sort(rng.permutation(len(descriptors))[:most])].astype(np.float32)
    branches = _cluster(data, min(BRANCHES, max(1, size // 2)), rng)
    nearest = _nearest(data, branches)
    parts = [data[nearest == k] for k in range(len(branches))]
    shares = [max(1, round(size * len(part) / len(data))) for part in parts]
    leaves = [_cluster(part, share, rng) for part, share in zip(parts, shares, strict=True) if len(part)]
    return Vocabulary(np.unique(np.concatenate(leaves), axis=0))


def _cluster(data: NDArray[np.float32], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the centers of clusters, rounded to whole numbers; fewer where there are fewer data."""
    centers = np.unique(data[rng.permutation(len(data))[:count]], axis=0)
    for _ in range(ROUNDS):
        nearest = _nearest(data, centers)
        order = np.argsort(nearest, kind="stable")
        used, starts = np.unique(nearest[order], return_index=True)
        sums = np.add.reduceat(data[order].astype(np.int64), starts, axis=0)
        counts = np.diff(np.append(starts, len(data)))
        moved = np.rint(sums / counts[:, None]).astype(np.float32)
        if len(used) == len(centers) and np.array_equal(moved, centers):
            break
        centers = np.unique(moved, axis=0)
    return centers


def _nearest(data: NDArray[np.float32], centers: NDArray[np.float32]) -> IndexArray:
    """Return (N,) rows of the centers that are nearest to the data (N, 128); of equal ones the first."""
    half = 0.5 * np.einsum("kd,kd->k", centers, centers)
    found = np.empty(len(data), np.int64)
    for start in range(0, len(data), BLOCK):
        part = slice(start, start + BLOCK)
        found[part] = np.argmax(data[part] @ centers.T - half, axis=1)
    return found


def pool_descriptors(photos: Sequence[DescriptorArray], most: int) -> DescriptorArray:
    """Return descriptors of all photos, of each the first ones and about as many.

    Args:
        photos: (N, 128) of each photo, the largest features first.
        most: descriptors altogether.
    """
    each = max(1, most // max(len(photos), 1))
    return np.concatenate([np.zeros((0, 128), np.uint8), *(one[:each] for one in photos)])
