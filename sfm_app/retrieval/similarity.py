"""Which photos share visual words: inverted files with weights by frequency (Sivic and Zisserman 2003)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

IndexArray = NDArray[np.int64]

BLOCK = 256
"""Photos whose similarities to all others are held at once."""


def rank_similar(words: Sequence[IndexArray], size: int, most: int) -> list[IndexArray]:
    """Rank for each photo the photos that share most with it, the most similar first.

    Photos that share no word are left out. A word counts with the root of its frequency in the photo, since patterns
    repeat within photos (Jegou 2009), and less if it is in many photos.

    Args:
        words: of each photo (N,) numbers of words.
        size: number of words in the vocabulary.
        most: photos returned for each.
    """
    vectors = _weigh(words, size)
    turned, found = vectors.T.tocsc(), []
    for start in range(0, len(words), BLOCK):
        scores = (vectors[start : start + BLOCK] @ turned).toarray()
        for row, values in enumerate(scores):
            values[start + row] = 0.0
            order = np.argsort(-values, kind="stable")[:most]
            found.append(order[values[order] > 0.0].astype(np.int64))
    return found


def _weigh(words: Sequence[IndexArray], size: int) -> sparse.csr_array:
    """Return (photos, words) the weights of words in photos, with rows of length 1."""
    photos = np.repeat(np.arange(len(words)), [len(one) for one in words])
    columns = np.concatenate([np.zeros(0, np.int64), *words])
    counts = sparse.coo_array((np.ones(len(columns)), (photos, columns)), shape=(len(words), size)).tocsr()
    counts.sum_duplicates()
    seen = np.bincount(counts.indices, minlength=size)
    rarity = np.log(len(words) / np.maximum(seen, 1))
    counts.data = np.sqrt(counts.data) * rarity[counts.indices]
    lengths = np.sqrt(np.asarray(counts.multiply(counts).sum(axis=1)).ravel())
    return sparse.csr_array(sparse.diags_array(1.0 / np.maximum(lengths, 1e-12)) @ counts)
