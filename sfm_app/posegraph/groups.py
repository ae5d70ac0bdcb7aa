"""Photos that hang together."""

from collections.abc import Iterable

from sfm_app.types import PairId


def connected_groups(pairs: Iterable[PairId], photos: Iterable[int] = ()) -> list[set[int]]:
    """Return photos that hang together through pairs, the largest group first.

    Args:
        pairs: what joins photos.
        photos: are groups of their own where no pair joins them.
    """
    groups = [{photo} for photo in photos]
    for pair in pairs:
        joined = set(pair).union(*(group for group in groups if not group.isdisjoint(pair)))
        groups = [*(group for group in groups if group.isdisjoint(pair)), joined]
    return sorted(groups, key=lambda group: (-len(group), min(group)))
