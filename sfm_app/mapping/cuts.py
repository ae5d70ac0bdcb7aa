"""Cuts of a group of photos into overlapping parts (ours).

A group is repeatedly divided in two. From a photo at its rim, one side grows by the photo with most links into it; the
smallest normalized cut on the way is taken (Shi and Malik 2000; growth as in METIS, Karypis and Kumar 1998). Photos
change sides where that lowers its weight. Neighboring parts then share the photos with most inliers across the cut.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush

from sfm_app.posegraph.rotations import connected_groups
from sfm_app.types import PairId, PoseGraph

Links = Mapping[int, Mapping[int, float]]
"""Weight of the pairs of each photo, by the other photo."""


class OPTIONS:
    """How a group is cut into parts. Chosen by hand."""

    saturation_inliers: float = 100.0
    """Number of inliers above which the weight of a pair hardly grows."""
    doubtful_weight: float = 0.1
    """Weight factor of pairs that may be look-alikes: a cut may well pass there."""
    largest: float = 1.3
    """Largest part, as a share of the chosen size."""
    smallest: float = 0.25
    """Smallest part, as a share of the chosen size."""
    min_side: float = 1.0 / 3.0
    """Smallest side of a cut, as a share of the photos."""
    max_swaps: int = 8
    """Most rounds in which photos change sides."""
    shared_photos: int = 10
    """Photos that each of two neighboring parts gets from the other one."""
    min_across: int = 3
    """Least pairs between two parts that makes them neighbors."""


@dataclass(frozen=True, slots=True)
class Part:
    """Photos that are mapped together."""

    own: tuple[int, ...]
    """Photos of no other part."""
    photos: tuple[int, ...]
    """These, and those that it shares with its neighbors."""


def cut_group(graph: PoseGraph, photos: Sequence[int], size: int) -> tuple[Part, ...]:
    """Divide connected photos into overlapping parts of about `size` photos, each connected."""
    links = link_weights(graph, photos)
    waiting, parts = _components(set(links), links), []
    while waiting:
        part = waiting.pop()
        if len(part) <= OPTIONS.largest * size:
            parts.append(part)
        else:
            waiting += _bisect(part, links)
    owned = [sorted(part) for part in _join_small(parts, links, OPTIONS.smallest * size)]
    owned.sort(key=lambda part: part[0])
    return tuple(
        Part(tuple(own), tuple(sorted((*own, *more))))
        for own, more in zip(owned, _shared_photos(owned, links), strict=True)
    )


def link_weights(graph: PoseGraph, photos: Collection[int]) -> dict[int, dict[int, float]]:
    """Return the weight of every pair within some photos, by both of them."""
    doubtful = {pair for join in graph.doubtful for pair in join.pairs}
    links: dict[int, dict[int, float]] = {photo: {} for photo in sorted(photos)}
    for pair, pose in graph.poses.items():
        a, b = pair
        if a in links and b in links:
            weight = pose.inlier_count / (1.0 + pose.inlier_count / OPTIONS.saturation_inliers)
            links[a][b] = links[b][a] = weight * (OPTIONS.doubtful_weight if pair in doubtful else 1.0)
    return links


def _bisect(photos: set[int], links: Links) -> tuple[set[int], set[int]]:
    end = _farthest_photo(min(photos), photos, links)
    starts = (_farthest_photo(end, photos, links), end)
    cuts = [_best_growth(start, photos, links) for start in starts]
    side = min(cuts, key=lambda cut: cut[0])[1]
    side = _swap_sides(side, photos, links)
    # islands go over to the other side, to which they are linked
    side = max(_components(side, links), key=_rank)
    rest = max(_components(photos - side, links), key=_rank)
    return photos - rest, rest


def _rank(photos: set[int]) -> tuple[int, int]:
    return len(photos), -min(photos)


def _components(photos: set[int], links: Links) -> list[set[int]]:
    pairs = ((a, b) for a in sorted(photos) for b in links[a] if a < b and b in photos)
    return connected_groups(pairs, sorted(photos))


def _farthest_photo(start: int, photos: set[int], links: Links) -> int:
    """Return the photo that takes most links to reach; of several, the one with the smallest id."""
    reached, rim = {start}, [start]
    while True:
        beyond = sorted({b for a in rim for b in links[a] if b in photos} - reached)
        if not beyond:
            return min(rim)
        reached.update(beyond)
        rim = beyond


def _best_growth(start: int, photos: set[int], links: Links) -> tuple[float, set[int]]:
    """Return the least normalized cut that a side passes through as it grows from a photo, and the side there."""
    degree = {photo: sum(w for b, w in sorted(links[photo].items()) if b in photos) for photo in sorted(photos)}
    total, inside = sum(degree.values()), dict.fromkeys(degree, 0.0)
    waiting, order, grown = [(0.0, start)], list[int](), set[int]()
    cut = volume = 0.0
    best = float("inf"), 0
    least = max(1, int(OPTIONS.min_side * len(photos)))
    while len(order) < len(photos) - least:
        _, photo = heappop(waiting)
        if photo in grown:
            continue
        grown.add(photo)
        order.append(photo)
        cut += degree[photo] - 2.0 * inside[photo]
        volume += degree[photo]
        if len(order) >= least:
            best = min(best, (cut / max(min(volume, total - volume), 1e-300), len(order)))
        for other, weight in links[photo].items():
            if other in photos and other not in grown:
                inside[other] += weight
                heappush(waiting, (-inside[other] / degree[other], other))
    return best[0], set(order[: best[1]])


def _swap_sides(side: set[int], photos: set[int], links: Links) -> set[int]:
    """Return a side after photos of both sides have moved to where most of their links lead."""
    side, least = set(side), int(OPTIONS.min_side * len(photos))
    for _ in range(OPTIONS.max_swaps):
        swaps = 0
        for photo in sorted(photos):
            here = photo in side
            across = sum(w for b, w in links[photo].items() if b in photos and (b in side) != here)
            within = sum(w for b, w in links[photo].items() if b in photos and (b in side) == here)
            size = len(side) if here else len(photos) - len(side)
            if across > within and size > least:
                side ^= {photo}
                swaps += 1
        if not swaps:
            break
    return side


def _join_small(parts: list[set[int]], links: Links, least: float) -> list[set[int]]:
    """Add parts that are too small to the neighbors to which most links lead."""
    parts = sorted(parts, key=_rank)
    while len(parts) > 1 and len(parts[0]) < least:
        small, *others = parts
        weights = [sum(w for a in sorted(small) for b, w in links[a].items() if b in other) for other in others]
        best = max(range(len(others)), key=lambda k: weights[k])
        if weights[best] == 0.0:  # a component of its own
            return parts
        others[best] = others[best] | small
        parts = sorted(others, key=_rank)
    return parts


def _shared_photos(parts: Sequence[Sequence[int]], links: Links) -> list[set[int]]:
    """Return the photos that each part gets from its neighbors."""
    owner = {photo: number for number, part in enumerate(parts) for photo in part}
    across: dict[tuple[int, int], list[PairId]] = {}
    for a in sorted(links):
        for b in links[a]:
            if owner[a] != owner[b]:
                across.setdefault((owner[a], owner[b]), []).append((a, b))
    shared: list[set[int]] = [set() for _ in parts]
    for (here, _), pairs in sorted(across.items()):
        if len(pairs) >= OPTIONS.min_across:
            shared[here] |= _best_across(pairs, links)
    return shared


def _best_across(pairs: Sequence[PairId], links: Links) -> set[int]:
    """Return other photos with most links to this part, spread over its photos, which come first in `pairs`."""
    partners: dict[int, list[int]] = {}
    for a, b in pairs:
        partners.setdefault(b, []).append(a)
    chosen, linked = set[int](), dict.fromkeys([a for a, _ in pairs], 0.0)

    def gain(photo: int) -> float:
        return sum(links[photo][a] / (1.0 + linked[a] / OPTIONS.saturation_inliers) for a in partners[photo])

    while len(chosen) < OPTIONS.shared_photos and len(chosen) < len(partners):
        best = max((photo for photo in sorted(partners) if photo not in chosen), key=gain)
        chosen.add(best)
        for a in partners[best]:
            linked[a] += links[best][a]
    return chosen
