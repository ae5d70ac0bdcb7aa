"""Divide a model where its joins contradict the evidence.

Facades that look alike join places that are apart. Such a join rests on few matches and leaves many others
unexplained: those of pairs that see the true layout.
"""

from collections.abc import Iterable, Mapping

from sfm_app.reconstruction.support import PairSupport
from sfm_app.types import PairId

LEAST_MATCHES = 16
"""Smallest number of matches with which a pair can join two parts."""


def sound_parts(explained: Mapping[PairId, PairSupport], photos: Iterable[int]) -> list[tuple[int, ...]]:
    """Return photos in parts whose joins more matches support than contradict, largest part first.

    Pairs are taken strongest first; two parts become one when the matches between them that the model explains
    outnumber the inliers of fundamental matrices between them that it does not.

    Args:
        explained: explained and contradicting matches of each pair.
        photos: ids of the photos to divide.
    """
    part = {photo: frozenset([photo]) for photo in photos}
    worth = {pair: found.matches - found.contradicted for pair, found in explained.items()}
    for pair in sorted(worth, key=lambda pair: (-worth[pair], pair)):
        first, second = part[pair[0]], part[pair[1]]
        if first == second or worth[pair] < LEAST_MATCHES:
            continue
        joins = (value for (a, b), value in worth.items() if _is_between(a, b, first, second))
        if sum(value for value in joins if _is_significant(value)) > 0:
            for photo in first | second:
                part[photo] = first | second
    parts = {tuple(sorted(members)) for members in part.values()}
    return sorted(parts, key=lambda members: (-len(members), members))


def _is_between(a: int, b: int, first: frozenset[int], second: frozenset[int]) -> bool:
    return (a in first and b in second) or (b in first and a in second)


def _is_significant(worth: int) -> bool:
    return abs(worth) >= LEAST_MATCHES
