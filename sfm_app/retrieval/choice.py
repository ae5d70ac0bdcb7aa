"""Which of the similar photos are matched: the nearest ones, and of the others some at every distance.

In a video the most similar photos are the neighbors, which add no parallax. Photos that are less similar, but still
show the same place, are what holds a model together.
"""

import math
from collections.abc import Collection, Mapping, Sequence

from sfm_app.settings import MatchSettings
from sfm_app.types import PairId

NEAREST_SHARE = 0.4
"""Share of the partners of a photo that are its nearest; the others are spread evenly over what is left. Chosen by
hand on the video kitchen1000."""


def wants_all_pairs(photos: int, options: MatchSettings) -> bool:
    """Return whether all pairs are matched: as the user says, or because there is little to choose.

    Args:
        photos: number of photos.
        options: settings of matching.
    """
    if options.pairs == "all" or photos <= options.neighbors + 1:
        return True
    return options.pairs == "auto" and math.comb(photos, 2) <= expected_pairs(photos, options)


def expected_pairs(photos: int, options: MatchSettings) -> int:
    """Return about how many pairs are matched.

    Args:
        photos: number of photos.
        options: settings of matching.
    """
    every = math.comb(photos, 2)
    return every if options.pairs == "all" else min(every, photos * options.neighbors)


def spread(ranked: Sequence[int], count: int) -> list[int]:
    """Return at most `count` of some photos: the first ones, and others at even steps among the rest.

    Args:
        ranked: photos, the best first.
        count: most that are returned, > 0.
    """
    if len(ranked) <= count:
        return list(ranked)
    first = round(NEAREST_SHARE * count)
    rest, wanted = ranked[first:], count - first
    return [*ranked[:first], *(rest[(2 * k + 1) * len(rest) // (2 * wanted)] for k in range(wanted))]


def choose_by_rank(
    scores: Mapping[PairId, int], least: int, count: int, choosers: Collection[int] | None = None
) -> set[PairId]:
    """Return pairs so that each photo has some with its best and its fair partners.

    Args:
        scores: of candidate pairs.
        least: pairs with a lower score are left out.
        count: partners for each photo; it may get more that chose it.
        choosers: photos that need partners; None for all.
    """
    partners: dict[int, list[tuple[int, int]]] = {}
    for (a, b), score in scores.items():
        if score >= least:
            partners.setdefault(a, []).append((-score, b))
            partners.setdefault(b, []).append((-score, a))
    found = set()
    for photo, ranked in partners.items():
        if choosers is not None and photo not in choosers:
            continue
        chosen = spread([other for _, other in sorted(ranked)], count)
        found |= {(min(photo, other), max(photo, other)) for other in chosen}
    return found
