"""Put pairs of photos into chunks that have few photos each, since every chunk makes its own indexes of features.

A chunk grows photo by photo: the next is the one with most pairs among its photos, as in the growth of parts.
"""

from collections.abc import Sequence

import numpy as np

from sfm_app.types import PairId


def cut_pairs(pairs: Sequence[PairId], size: int) -> list[list[PairId]]:
    """Return all pairs in chunks of `size`, the last of which may be smaller.

    Args:
        pairs: ids of photos, each pair once; their order and that within a pair do not change the chunks.
        size: of a chunk, > 0.
    """
    names = sorted({photo for pair in pairs for photo in pair})
    number = {name: k for k, name in enumerate(names)}
    left: list[dict[int, PairId]] = [{} for _ in names]
    for pair in sorted(pairs, key=sorted):
        a, b = (number[photo] for photo in pair)
        left[a][b] = left[b][a] = pair
    found = list[list[PairId]]()
    while any(left):
        found.append(_grow_chunk(left, size))
    return found


def _grow_chunk(left: list[dict[int, PairId]], size: int) -> list[PairId]:
    """Take the pairs of one chunk out of those that are left, by photo and partner, and return them."""
    count = len(left)
    links, degree = np.zeros(count, np.int64), np.array([len(partners) for partners in left])
    outside, chunk = degree > 0, list[PairId]()
    while len(chunk) < size and outside.any():
        # of the photos with most links, the one that leaves fewest pairs to others: scraps are dear
        best = int(np.argmax(np.where(outside, links * (count + 1) + count - degree, -1)))
        inside = [other for other in left[best] if not outside[other]][: size - len(chunk)]
        for other in inside:
            chunk.append(left[best].pop(other))
            del left[other][best]
        degree[best] -= len(inside)
        outside[best] = False
        links[list(left[best])] += 1
    return chunk
