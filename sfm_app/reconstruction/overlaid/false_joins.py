"""Pairs of look-alikes that hold one place of a model on top of another.

Photos of two places that a model has in one are strangers: they should share most of what they see, and share nothing.
Strangers belong on different sides. The pairs that hold the sides together, the least cut between them, are wrong.
"""

import logging
from collections.abc import Collection, Iterable, Mapping, Sequence
from heapq import heapify, heappop, heappush
from itertools import chain

import numpy as np

from sfm_app.errors import BackendError
from sfm_app.numerical import FAILURES
from sfm_app.posegraph.folds import find_cut
from sfm_app.posegraph.look_alikes import group_doubted_pairs
from sfm_app.reconstruction.mapping_runs import Attempt
from sfm_app.reconstruction.model_split import LEAST_MATCHES
from sfm_app.reconstruction.overlaid.meetings import Meeting, find_meetings
from sfm_app.reconstruction.support import PairSupport, saturate
from sfm_app.types import LookAlikes, PairId

logger = logging.getLogger("sfm_app")

STRANGE_SHARE = 0.1
"""Photos that meet are strangers if they share at most this part of the cells that they should. docs/algorithms.md,
Overlaid places."""
PULLING_SHARE = 0.7
"""Share of the cells that they should share from which photos that meet are on one side. Chosen by hand: photos of one
place share more in 9 of 10 pairs of a video and in nearly all others, those of a house in two streets 0 to 0.65."""
LEAST_STRANGERS, LEAST_PHOTOS = 10, 3
"""Pairs of strangers, and photos on either side, that prove a wrong join. Chosen by hand."""
MOST_FALSE_JOINS = 3
"""Times that photos are mapped again without more look-alikes. Chosen by hand."""
LEAST_MISSING = 0.5
"""Least share of the cells that photos on either side of a false join should share, but do not. Chosen by hand: 0.88
for a house in two streets of a rendered town. Of 17 right models, no meeting of two photos misses more than 0.75."""


def judge_places(models: Iterable[Attempt]) -> tuple[list[LookAlikes], int]:
    """Return the false joins of models, and how many pairs of photos are strangers in them.

    Args:
        models: with the matches that they explain.
    """
    joins, strangers = list[LookAlikes](), 0
    for attempt in models:
        try:
            meetings = find_meetings(attempt.model)
            joins += find_false_joins(meetings, attempt.explained)
        except (*FAILURES, BackendError) as err:  # the model itself is there
            logger.info("places of the model %s were not judged", attempt.note, exc_info=err)
            continue
        strangers += len(find_strangers(meetings, attempt.explained))
    return joins, strangers


def find_strangers(
    meetings: Mapping[PairId, Meeting], explained: Mapping[PairId, PairSupport]
) -> dict[PairId, Meeting]:
    """Return the pairs of photos that should share most of what they see, and share next to nothing.

    Args:
        meetings: pairs of photos that see the same place in the model.
        explained: matches of each pair that the model explains.
    """
    return {
        pair: one for pair, one in meetings.items()
        if one.shared <= STRANGE_SHARE * one.expected and not _holds(explained.get(pair))
    }  # fmt: skip


def find_false_joins(meetings: Mapping[PairId, Meeting], explained: Mapping[PairId, PairSupport]) -> list[LookAlikes]:
    """Return the pairs that hold strangers together, those of each false join for themselves.

    Args:
        meetings, explained: as in `find_strangers`.
    """
    strangers, found = find_strangers(meetings, explained), list[LookAlikes]()
    holding = {pair: one.matches for pair, one in explained.items() if _holds(one)}
    strengths = dict(zip(holding, saturate(list(holding.values())).tolist(), strict=True))
    photos, left = sorted(set(chain(*holding, *meetings))), dict(strangers)
    while len(left) >= LEAST_STRANGERS:
        sides = _take_sides(left, meetings)
        apart = {pair for pair, one in meetings.items() if sides[pair[0]] != sides[pair[1]] and _pull(one) < 0}
        here = _divide({photo: sides[photo] for photo in chain(*apart)}, photos, strengths)
        across = {pair: one for pair, one in meetings.items() if {here.get(photo) for photo in pair} == {True, False}}
        missing = _missing_share(across.values())
        if len(across.keys() & strangers.keys()) >= LEAST_STRANGERS and missing >= LEAST_MISSING:
            pairs = {pair for pair in strengths if here[pair[0]] != here[pair[1]]}
            strengths = {pair: strength for pair, strength in strengths.items() if pair not in pairs}
            found += [LookAlikes(join, missing) for join in group_doubted_pairs(pairs, strengths)]
        left = {(a, b): one for (a, b), one in left.items() if sides[a] == sides[b]}
    return found


def _missing_share(meetings: Collection[Meeting]) -> float:
    expected = sum(one.expected for one in meetings)
    return 1.0 - sum(one.shared for one in meetings) / max(expected, 1)


def _holds(found: PairSupport | None) -> bool:
    return found is not None and found.matches >= LEAST_MATCHES


def _pull(meeting: Meeting) -> float:
    """Return how many cells speak for one place, less those that speak for two."""
    return meeting.shared - PULLING_SHARE * meeting.expected


def _take_sides(strangers: Mapping[PairId, Meeting], meetings: Mapping[PairId, Meeting]) -> dict[int, int]:
    """Return the side, 1 or -1, of all photos that meet others: the strangest pair first, then what is most certain.

    Those who share what they should pull a photo to their side, the others push it to the other one.
    """
    pulls: dict[int, dict[int, float]] = {photo: {} for photo in chain(*meetings)}
    for (a, b), one in meetings.items():
        pulls[a][b] = pulls[b][a] = _pull(one)
    seed = min(strangers, key=lambda pair: (-strangers[pair].expected, pair))
    sides, votes = dict[int, int](), dict.fromkeys(sorted(pulls), 0.0)
    waiting = [(-np.inf, seed[0], np.inf), (-np.inf, seed[1], -np.inf), *((0.0, photo, 0.0) for photo in votes)]
    heapify(waiting)
    while waiting:
        _, photo, vote = heappop(waiting)
        if photo in sides or (np.isfinite(vote) and vote != votes[photo]):
            continue
        sides[photo] = 1 if vote >= 0 else -1
        for other, pull in pulls[photo].items():
            if other not in sides:
                votes[other] += sides[photo] * pull
                heappush(waiting, (-abs(votes[other]), other, votes[other]))
    return sides


def _divide(sides: Mapping[int, int], photos: Sequence[int], strengths: Mapping[PairId, float]) -> dict[int, bool]:
    """Return for each photo on which side of the least cut it is; empty where there is nothing to cut."""
    number = {photo: k for k, photo in enumerate(photos)}
    ends = [np.array([number[one] for one, side in sides.items() if side == which], np.int64) for which in (1, -1)]
    if min(map(len, ends)) < LEAST_PHOTOS:
        return {}
    edges = np.array([[number[photo] for photo in pair] for pair in strengths], np.int64).reshape(-1, 2)
    here, weight = find_cut(len(photos), edges, np.array(list(strengths.values())), (ends[0], ends[1]))
    return dict(zip(photos, here.tolist(), strict=True)) if 0.0 < weight < np.inf else {}
