"""Cuts of a group into parts."""

import numpy as np
import pytest

from sfm_app.mapping.cuts import OPTIONS, cut_group, link_weights
from sfm_app.posegraph.rotations import connected_groups
from sfm_app.types import LookAlikes, PoseGraph, RelativePose


def pose(inliers):
    return RelativePose(np.eye(3), np.array([1.0, 0.0, 0.0]), np.arange(inliers) >= 0, 5.0, 1.0)


def graph_of(counts, doubtful=()):
    """Pairs with their inliers."""
    photos = sorted({photo for pair in counts for photo in pair})
    joins = (LookAlikes(tuple(doubtful), 0.5),) if doubtful else ()
    return PoseGraph({pair: pose(n) for pair, n in sorted(counts.items())}, {}, (tuple(photos),), (), joins)


def row(photos, reach, inliers=100, start=0):
    return {(start + a, start + b): inliers for a in range(photos) for b in range(a + 1, min(a + reach + 1, photos))}


def clusters(count, size, bridge=20):
    """Dense clusters in a ring, each joined to the next by a few weak pairs."""
    found = {}
    for k in range(count):
        found |= row(size, 12, start=k * size)
        after = (k + 1) % count * size
        for a, b in ((k * size + size - 1 - n, after + n) for n in range(4)):
            found[min(a, b), max(a, b)] = bridge
    return found


def is_connected(photos, graph):
    members = set(photos)
    return len(connected_groups([pair for pair in graph.poses if members.issuperset(pair)], photos)) == 1


@pytest.mark.parametrize(("photos", "reach", "size"), [(300, 10, 60), (1000, 5, 150), (130, 30, 40)])
def test_parts_hold_every_photo_once_are_connected_balanced_and_overlap(photos, reach, size):
    graph = graph_of(row(photos, reach))

    parts = cut_group(graph, range(photos), size)

    assert sorted(photo for part in parts for photo in part.own) == list(range(photos))
    assert all(OPTIONS.smallest * size <= len(part.own) <= OPTIONS.largest * size for part in parts)
    assert 0.75 * photos / size <= len(parts) <= 3.0 * photos / size
    assert all(is_connected(part.own, graph) and is_connected(part.photos, graph) for part in parts)
    for part in parts:
        assert set(part.own) < set(part.photos)
        others = [len(set(part.photos) & set(other.photos)) for other in parts if other is not part]
        assert max(others) >= min(2 * OPTIONS.shared_photos, 2 * reach)


def test_a_cut_passes_through_the_thin_places():
    graph = graph_of(clusters(6, 50))
    parts = cut_group(graph, range(300), 50)
    assert [part.own for part in parts] == [tuple(range(50 * k, 50 * k + 50)) for k in range(6)]
    assert all(len(part.photos) == 58 for part in parts)  # four from either side


def test_doubtful_pairs_hold_nothing_together():
    counts = row(80, 8) | row(80, 8, start=80) | {(k, 80 + k): 100 for k in range(0, 80, 2)}
    firm = {(k, 80 + k): 60 for k in range(76, 80)}
    graph = graph_of(counts | firm, doubtful=[pair for pair in counts if pair[1] - pair[0] == 80])
    parts = cut_group(graph, range(160), 80)
    assert [part.own for part in parts] == [tuple(range(80)), tuple(range(80, 160))]
    assert link_weights(graph, range(160))[0][80] == pytest.approx(0.1 * link_weights(graph, range(160))[0][1])


def test_a_small_group_is_one_part_and_the_same_graph_gives_the_same_parts():
    graph = graph_of(row(60, 10))
    assert [part.photos for part in cut_group(graph, range(60), 60)] == [tuple(range(60))]
    assert cut_group(graph, range(60), 20) == cut_group(graph_of(row(60, 10)), range(59, -1, -1), 20)


def test_a_photo_that_nothing_connects_is_a_part_of_its_own():
    parts = cut_group(graph_of(row(50, 10)), range(51), 60)
    assert [part.own for part in parts] == [tuple(range(50)), (50,)]
