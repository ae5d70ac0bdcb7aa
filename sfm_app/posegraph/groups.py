"""Groups of photos that pairs connect."""

from collections.abc import Iterable

from sfm_app.types import PairId


def connected_groups(pairs: Iterable[PairId], photos: Iterable[int] = ()) -> list[set[int]]:
    """Group the photos that pairs connect, the largest group first.

    Args:
        pairs: connections between two photos.
        photos: form groups of their own if no pair connects them.
    """
    groups = [{photo} for photo in photos]
    for pair in pairs:
        joined = set(pair).union(*(group for group in groups if not group.isdisjoint(pair)))
        groups = [*(group for group in groups if group.isdisjoint(pair)), joined]
    return sorted(groups, key=lambda group: (-len(group), min(group)))
