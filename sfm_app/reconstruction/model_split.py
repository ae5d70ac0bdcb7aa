"""Divide a model where its joins contradict the evidence.

Facades that look alike join places that are apart. Such a join rests on few matches and leaves many others
unexplained: those of pairs that see the true layout.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.models.model import posed_photo_ids, submodel
from sfm_app.posegraph.groups import DisjointGroups
from sfm_app.reconstruction.mapping_runs import MIN_PHOTOS, Attempt
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


def split_attempt(attempt: Attempt) -> list[Attempt]:
    """Divide a model where more matches contradict than support its joins; return it unchanged if it has one part.

    Single photos are left out, and so are small parts beside the largest one.
    """
    parts = sound_parts(attempt.explained, posed_photo_ids(attempt.model))
    if len(parts) == 1:
        return [attempt]
    kept = [part for number, part in enumerate(parts) if len(part) >= (2 if number == 0 else MIN_PHOTOS)]
    with translate_errors("dividing a model"):
        return [_part(attempt, part) for part in kept]


def _part(attempt: Attempt, photos: Sequence[int]) -> Attempt:
    members = set(photos)
    explained = {pair: found for pair, found in attempt.explained.items() if members.issuperset(pair)}
    return replace(attempt, model=submodel(attempt.model, photos), explained=explained)
