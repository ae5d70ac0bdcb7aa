"""Divide a model where its joins contradict the evidence.

Facades that look alike join places that are apart. Such a join rests on few matches and leaves many others
unexplained: those of pairs that see the true layout.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping

from sfm_app.posegraph.groups import DisjointGroups
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
    groups = DisjointGroups(photos)
    worth = {pair: found.matches - found.contradicted for pair, found in explained.items()}
    between = _joins(worth)
    for a, b in sorted(worth, key=lambda pair: (-worth[pair], pair)):
        first, second = groups.name[a], groups.name[b]
        if first == second or worth[a, b] < LEAST_MATCHES or between[first][second] <= 0:
            continue
        groups.join(a, b)
        kept = groups.name[a]
        gone = second if kept == first else first
        _merge_joins(between, kept, gone)
    parts = [tuple(sorted(members)) for members in groups.members.values()]
    return sorted(parts, key=lambda members: (-len(members), members))


def _joins(worth: Mapping[PairId, int]) -> defaultdict[int, Counter[int]]:
    """Return for every photo the worth of its significant pairs by the other photo."""
    found: defaultdict[int, Counter[int]] = defaultdict(Counter)
    for (a, b), value in worth.items():
        if abs(value) >= LEAST_MATCHES:
            found[a][b] += value
            found[b][a] += value
    return found


def _merge_joins(between: defaultdict[int, Counter[int]], kept: int, gone: int) -> None:
    """Add the joins of a part that has become one with another."""
    for other, value in between.pop(gone).items():
        if other != kept:
            between[kept][other] += value
            between[other][kept] += value
        del between[other][gone]
