"""View graphs of many photos: the same answers as on small ones, in time that grows with the pairs."""

import numpy as np
import pytest

from sfm_app.posegraph import rotations as module
from sfm_app.posegraph.look_alikes import BACKBONE_SHARE, backbone
from sfm_app.posegraph.rotations import average_rotations, check_loops, connected_groups
from tests.unit.posegraph.test_rotations import errors_deg, relative, truth


def random_pairs(photos, count, seed):
    rng = np.random.default_rng(seed)
    return sorted({(min(a, b), max(a, b)) for a, b in rng.integers(photos, size=(count, 2)).tolist() if a != b})


def bottleneck(covered, a, b):
    """Return the weakest coverage on the best path, by raising the limit until the path breaks."""
    limits = sorted(set(covered.values()))
    return max(
        limit
        for limit in limits
        if any({a, b} <= group for group in connected_groups(pair for pair in covered if covered[pair] >= limit))
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_backbone_has_the_pairs_near_the_weakest_one_on_the_best_path(seed):
    pairs = random_pairs(12, 30, seed)
    values = np.random.default_rng(seed).permutation(len(pairs)) / len(pairs) + 0.1
    covered = dict(zip(pairs, values.tolist(), strict=True))

    expected = {pair for pair in pairs if covered[pair] >= BACKBONE_SHARE * bottleneck(covered, *pair)}

    assert backbone(covered) == expected
    assert 11 <= len(expected) < len(pairs)


def test_all_loops_of_three_are_found():
    rotations, pairs = truth(30), random_pairs(30, 150, 0)
    known = set(pairs)
    expected = {(a, b, c) for a, b in pairs for c in range(b + 1, 30) if (b, c) in known and (a, c) in known}
    turns = relative(rotations, pairs)

    loops, agree = check_loops(np.array(pairs), np.array([turns[pair] for pair in pairs]))

    found = [(pairs[k][0], pairs[k][1], pairs[j][1]) for k, j, _ in loops]
    assert sorted(found) == sorted(expected) and len(set(found)) == len(found) > 20
    assert all(pairs[i] == (a, c) for (a, _, c), (_, _, i) in zip(found, loops, strict=True))
    assert agree.all()


def test_conjugate_gradients_give_the_rotations_of_the_dense_solution(monkeypatch):
    steps = [(k, k + step) for step in (1, 2, 5) for k in range(120 - step)]
    turns = relative(truth(120), steps)
    weights = dict.fromkeys(steps, 1.0)
    dense, _ = average_rotations(turns, weights)

    monkeypatch.setattr(module, "DENSE_PHOTOS", 0)
    found, _ = average_rotations(turns, weights)

    assert errors_deg(found, dense).max() < 1e-4


def test_the_photos_of_a_long_walk_agree():
    photos = 1500
    steps = [(k, k + step) for step in (1, 2, 4, 8) for k in range(photos - step)]
    rotations = truth(photos)

    found, angles = average_rotations(relative(rotations, steps), dict.fromkeys(steps, 1.0))

    near = errors_deg(found, rotations, range(0, photos, 50))
    assert 0.1 < np.median(near) < 4.0
    assert np.median(list(angles.values())) < 0.6
