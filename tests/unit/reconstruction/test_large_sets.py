"""What changes with the number of photos: pairs that are mapped, and when all is mapped again."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.mapping import attempt as module
from sfm_app.mapping.attempt import are_many_unregistered, pairs_to_map
from sfm_app.posegraph.rotations import connected_groups
from sfm_app.types import PoseGraph, RelativePose


def pose_graph(photos, reach):
    """Photos in a row, each paired with those within reach."""
    pairs = [(a, b) for a in range(photos) for b in range(a + 1, min(a + reach + 1, photos))]
    poses = {
        (a, b): RelativePose(np.eye(3), np.array([1.0, 0.0, 0.0]), np.arange(100) < 100 - (b - a), 5.0, 1.0)
        for a, b in pairs
    }
    return PoseGraph(poses, {}, (tuple(range(photos)),))


def test_all_pairs_of_a_small_set_are_mapped():
    graph = pose_graph(100, 40)

    assert pairs_to_map(graph) is graph


def test_some_pairs_of_each_photo_of_a_large_set_are_mapped(monkeypatch):
    monkeypatch.setattr(module, "MAPPING", replace(module.MAPPING, fully_mapped_photos=90))
    graph = pose_graph(100, 40)

    found = pairs_to_map(graph)

    counts = np.bincount(np.array(list(found.poses)).ravel(), minlength=100)
    assert counts.min() >= module.MAPPING.mapped_partners
    assert len(found.poses) < 0.5 * len(graph.poses)
    assert len(connected_groups(found.poses)) == 1
    assert max(b - a for a, b in found.poses) > 20
    assert found.groups == graph.groups


@pytest.mark.parametrize(("lost", "photos", "again"), [
    (0, 20, False), (1, 20, True), (1, 59, True), (2, 60, False), (3, 60, True), (49, 1000, False), (50, 1000, True),
])  # fmt: skip
def test_a_few_lost_photos_of_many_are_no_reason_to_map_again(lost, photos, again):
    assert are_many_unregistered(lost, photos) is again
