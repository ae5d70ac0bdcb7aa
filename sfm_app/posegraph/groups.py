"""Groups of photos that pairs connect."""

from collections.abc import Iterable

from sfm_app.types import PairId


class DisjointGroups:
    """Photos in groups that are joined one by one; the smaller of two groups is added to the larger.

    Args:
        photos: each starts as a group of its own.
    """

    def __init__(self, photos: Iterable[int]) -> None:
        self.members = {photo: [photo] for photo in photos}
        self.name = {photo: photo for photo in self.members}

    def join(self, a: int, b: int) -> list[int]:
        """Join the groups of two photos, and return the photos that changed their group; none if it was the same.

        Args:
            a, b: photos.
        """
        kept, gone = self.name[a], self.name[b]
        if kept == gone:
            return []
        if len(self.members[kept]) < len(self.members[gone]):
            kept, gone = gone, kept
        moved = self.members.pop(gone)
        self.members[kept] += moved
        self.name |= dict.fromkeys(moved, kept)
        return moved


def connected_groups(pairs: Iterable[PairId], photos: Iterable[int] = ()) -> list[set[int]]:
    """Group the photos that pairs connect, the largest group first.

    Args:
        pairs: connections between two photos.
        photos: form groups of their own if no pair connects them.
    """
    known = list(pairs)
    groups = DisjointGroups([*photos, *(photo for pair in known for photo in pair)])
    for a, b in known:
        groups.join(a, b)
    return sorted(map(set, groups.members.values()), key=lambda group: (-len(group), min(group)))
