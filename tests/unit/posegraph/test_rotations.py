from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sfm_app.posegraph import rotations as module
from sfm_app.posegraph.look_alikes import OPTIONS, backbone
from sfm_app.posegraph.rotations import (
    _residuals,
    average_rotations,
    check_loops,
    connected_groups,
    find_corrections,
    loop_support,
)

QUARTER = Rotation.from_euler("y", 90, degrees=True).as_matrix()


def truth(count, seed=0):
    return Rotation.random(count, random_state=seed).as_matrix()


def turned(rng, noise_deg):
    return Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=3) / np.sqrt(3)).as_matrix()


def relative(rotations, pairs, noise_deg=0.5, seed=0):
    rng = np.random.default_rng([seed, 3])
    return {(i, j): turned(rng, noise_deg) @ rotations[j] @ rotations[i].T for i, j in pairs}


def errors_deg(found, rotations, photos=None):
    """Of all rotations between two photos."""
    photos = sorted(found) if photos is None else photos
    off = [found[j] @ found[i].T @ (rotations[j] @ rotations[i].T).T for i, j in combinations(photos, 2)]
    return np.degrees(Rotation.from_matrix(off).magnitude())


def two_facades(seed):
    """Twelve photos of two facades; a third of all pairs takes one for the other, turned by a right angle.

    Where a pair joins the facades it is more often wrong than right, and wrong always in the same way: only that the
    right ones have more matches tells them apart.
    """
    rng, rotations = np.random.default_rng([seed, 8]), truth(12, seed)
    within = [pair for pair in combinations(range(12), 2) if (pair[0] < 6) == (pair[1] < 6)]
    across = [(i, j) for i in range(6) for j in range(6, 12)]
    kept = [within[k] for k in rng.permutation(30)[:20]]
    joins = [across[k] for k in rng.permutation(36)[:25]]
    wrong, right = joins[:15], joins[15:]
    found = relative(rotations, [*kept, *joins], seed=seed)
    for i, j in wrong:
        found[i, j] = turned(rng, 0.5) @ rotations[j] @ QUARTER @ rotations[i].T
    weights = {pair: rng.uniform(15, 35) if pair in wrong else rng.uniform(50, 90) for pair in found}
    return rotations, dict(sorted(found.items())), weights, wrong, right


@pytest.mark.parametrize("seed", range(10))
def test_a_third_of_all_pairs_may_take_one_facade_for_another(seed):
    rotations, pairs, weights, wrong, _ = two_facades(seed)
    found, angles = average_rotations(pairs, weights)
    assert 0.05 < errors_deg(found, rotations).max() < 1.5
    assert min(angles[pair] for pair in wrong) > 85
    assert max(angle for pair, angle in angles.items() if pair not in wrong) < 3


def test_pairs_that_are_wrong_each_in_its_own_way_may_weigh_as_much_as_others():
    rotations = truth(12)
    pairs = relative(rotations, combinations(range(12), 2))
    wrong = [pair for k, pair in enumerate(pairs) if k % 3 == 0]
    pairs |= dict(zip(wrong, truth(len(wrong), 5), strict=True))
    found, angles = average_rotations(pairs, dict.fromkeys(pairs, 1.0))
    assert 0.05 < errors_deg(found, rotations).max() < 1.0
    assert min(angles[pair] for pair in wrong) > 10 > 2 > max(angles[pair] for pair in pairs if pair not in wrong)


@pytest.mark.parametrize("seed", range(5))
def test_wrong_pairs_with_more_matches_than_others_are_seen_through_by_loops(seed):
    """The heaviest edges alone would lay the first rotations along the wrong pairs."""
    rng, rotations = np.random.default_rng([seed, 5]), truth(12, seed)
    pairs = relative(rotations, combinations(range(12), 2), seed=seed)
    wrong = [list(pairs)[k] for k in rng.permutation(len(pairs))[:22]]
    pairs |= dict(zip(wrong, truth(len(wrong), seed + 100), strict=True))
    weights = {pair: (75.0 if pair in wrong else 50.0) * rng.uniform(0.8, 1.2) for pair in pairs}
    found, _ = average_rotations(pairs, weights)
    assert 0.05 < errors_deg(found, rotations).max() < 1.5


def test_averaging_makes_the_noise_of_pairs_smaller():
    rotations = truth(12)
    pairs = relative(rotations, combinations(range(12), 2), noise_deg=2.0)
    found, angles = average_rotations(pairs, dict.fromkeys(pairs, 1.0))
    before = np.degrees(
        [Rotation.from_matrix(turn @ (rotations[j] @ rotations[i].T).T).magnitude() for (i, j), turn in pairs.items()]
    )
    assert 0.1 * np.mean(before) < errors_deg(found, rotations).mean() < 0.7 * np.mean(before)
    assert np.median(list(angles.values())) == pytest.approx(np.median(before), rel=0.3)


def test_every_group_stands_straight_in_a_world_of_its_own():
    rotations = truth(9)
    first, second = [(2, 4), (4, 8), (2, 8)], [(1, 3), (3, 5)]

    found, angles = average_rotations(relative(rotations, [*first, *second]), dict.fromkeys([*first, *second], 20.0))

    assert sorted(found) == [1, 2, 3, 4, 5, 8]
    for photo in (1, 2):
        np.testing.assert_allclose(found[photo], np.eye(3), atol=0.02)
    for photos in ((2, 4, 8), (1, 3, 5)):
        assert errors_deg(found, rotations, photos).max() < 1.5
    assert max(angles[pair] for pair in second) < 1e-5  # nothing contradicts what is in no loop
    assert 0.01 < max(angles[pair] for pair in first) < 1.5


def test_a_chain_without_loops_is_multiplied_out():
    rotations, chain = truth(5), [(0, 1), (1, 3), (2, 3), (2, 4)]
    pairs = relative(rotations, chain, noise_deg=0.0)
    found, angles = average_rotations(pairs, dict.fromkeys(chain, 30.0))
    assert errors_deg(found, rotations).max() < 1e-4
    assert max(angles.values()) < 1e-5


@settings(deadline=None, max_examples=8)
@given(seed=st.integers(0, 1000), axis=st.tuples(*[st.floats(-3, 3)] * 3), order=st.randoms(use_true_random=False))
def test_neither_the_world_nor_the_order_of_pairs_matters(seed, axis, order):
    """Photo i of another world and of another camera frame: R_ij becomes G_j R_ij G_i'."""
    _, pairs, weights, _, _ = two_facades(seed)
    gauge = Rotation.from_rotvec(np.array(axis)[None] * np.linspace(0.1, 1, 12)[:, None]).as_matrix()
    names = list(pairs)
    order.shuffle(names)

    first, angles = average_rotations(pairs, weights)
    second, same = average_rotations(
        {(i, j): gauge[j] @ pairs[i, j] @ gauge[i].T for i, j in names}, {pair: weights[pair] for pair in names}
    )

    back = {photo: gauge[photo].T @ turn for photo, turn in second.items()}
    assert errors_deg(back, first).max() < np.degrees(1e-6)
    assert list(same) == names
    np.testing.assert_allclose([same[pair] for pair in pairs], list(angles.values()), atol=np.degrees(1e-6))


def supported(pairs, weights):
    edges = np.array(list(pairs))
    found = loop_support(edges, np.array(list(pairs.values())), np.array([weights[pair] for pair in pairs]))
    return dict(zip(pairs, found, strict=True))


def test_loops_support_the_pairs_in_them():
    rotations = truth(5)
    pairs = relative(rotations, [(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (3, 4)], noise_deg=0.2)
    pairs[1, 3] = QUARTER @ pairs[1, 3]
    found = supported(pairs, dict.fromkeys(pairs, 10.0))
    assert found[0, 1] == found[0, 2] == 1.0  # their only loop agrees
    assert found[1, 3] == found[2, 3] == pytest.approx(1 / 11)  # their only one does not
    assert found[1, 2] == pytest.approx(11 / 21)  # one of two
    assert found[3, 4] == 1.0  # none


def test_a_loop_counts_by_its_weaker_other_pair():
    rotations = truth(4)
    pairs = relative(rotations, [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3)], noise_deg=0.0)
    pairs[1, 3] = QUARTER @ pairs[1, 3]
    weights = {(0, 1): 10.0, (0, 2): 40.0, (1, 2): 8.0, (0, 3): 6.0, (1, 3): 90.0}
    found = supported(pairs, weights)
    assert found[0, 1] == pytest.approx((8 + 1) / (8 + 6 + 1))


def test_pairs_in_no_loop_are_all_alike():
    rotations = truth(4)
    assert set(
        supported(relative(rotations, [(0, 1), (1, 2), (2, 3)]), dict.fromkeys(combinations(range(4), 2), 5.0)).values()
    ) == {1.0}


TOWN, STREET, WINDOW = 30, 20, 9
CORNER = TOWN
"""The only photo of the street that sees the town."""


@pytest.fixture
def graph():
    """True rotations; pairs of a town, of a street, and of its corner with the town; and three strong wrong pairs."""
    rng = np.random.default_rng(0)
    true = Rotation.random(TOWN + STREET, random_state=1).as_matrix()
    near = [(a, b) for a, b in combinations(range(TOWN + STREET), 2) if b - a <= WINDOW and (a < TOWN) == (b < TOWN)]
    corner = [(photo, CORNER) for photo in range(5, 15)]
    turns = {(a, b): true[b] @ true[a].T for a, b in near + corner}
    noise = Rotation.from_rotvec(np.radians(0.1) * rng.normal(size=(len(turns), 3))).as_matrix()
    turns = {pair: turn @ off for (pair, turn), off in zip(turns.items(), noise, strict=True)}
    fold = Rotation.from_rotvec([0.0, np.radians(80.0), 0.0]).as_matrix()
    wrong = [(20, CORNER + 10), (21, CORNER + 10), (22, CORNER + 11)]
    turns |= {(a, b): true[b] @ fold @ true[a].T for a, b in wrong}
    weights = dict.fromkeys(turns, 1.0) | dict.fromkeys(wrong, 2.5)
    return true, turns, weights, wrong


def arrays(turns, weights):
    return np.array(list(turns)), np.array(list(turns.values())), np.array([weights[pair] for pair in turns])


def test_the_street_comes_to_where_most_pairs_want_it(graph):
    true, turns, weights, wrong = graph
    found, angles = average_rotations(turns, weights)
    off = np.array([true[k].T @ found[k] for k in range(len(true))])
    assert np.degrees(Rotation.from_matrix(off @ off[0].T).magnitude()).max() < 0.5
    assert {pair for pair, angle in angles.items() if angle > 5} == set(wrong)


def test_a_folded_street_turns_as_a_whole(graph):
    true, turns, weights, _ = graph
    edges, relative, strengths = arrays(turns, weights)
    fold = Rotation.from_rotvec([0.0, np.radians(80.0), 0.0]).as_matrix()
    folded = np.where(np.arange(len(true))[:, None, None] >= CORNER, true @ fold, true)

    (correction,) = find_corrections(len(true), edges, _residuals(folded, edges, relative), strengths)

    street = np.arange(len(true)) >= CORNER
    assert np.array_equal(correction.photos, street) or np.array_equal(correction.photos, ~street)
    assert correction.gain == pytest.approx(10 - 3 * 2.5, abs=0.01)
    R = correction.R if correction.photos[-1] else correction.R.T
    assert np.degrees(Rotation.from_matrix(R @ fold).magnitude()) < 1.0


def test_nothing_turns_for_pairs_that_weigh_less_than_those_in_their_way(graph):
    true, turns, weights, _ = graph
    edges, relative, strengths = arrays(turns, weights)
    assert list(find_corrections(len(true), edges, _residuals(true, edges, relative), strengths)) == []


def test_nothing_turns_where_nothing_contradicts(graph):
    true, turns, weights, wrong = graph
    right = {pair: turn for pair, turn in turns.items() if pair not in wrong}
    edges, relative, strengths = arrays(right, weights)
    assert list(find_corrections(len(true), edges, _residuals(true, edges, relative), strengths)) == []


def test_pairs_without_others_do_not_end_in_an_error():
    true = Rotation.random(4, random_state=2).as_matrix()
    edges, relative = np.array([[0, 1], [0, 2], [0, 3]]), true[1:] @ true[0].T
    assert (
        list(find_corrections(4, edges, _residuals(np.tile(np.eye(3), (4, 1, 1)), edges, relative), np.ones(3))) == []
    )


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
    expected = {pair for pair in pairs if covered[pair] >= OPTIONS.backbone_share * bottleneck(covered, *pair)}
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
    monkeypatch.setattr(module.AVERAGING, "dense_photos", 0)
    found, _ = average_rotations(turns, weights)
    assert errors_deg(found, dense).max() < 1e-4


@pytest.mark.slow
def test_the_photos_of_a_long_walk_agree():
    photos = 1500
    steps = [(k, k + step) for step in (1, 2, 4, 8) for k in range(photos - step)]
    rotations = truth(photos)
    found, angles = average_rotations(relative(rotations, steps), dict.fromkeys(steps, 1.0))
    near = errors_deg(found, rotations, range(0, photos, 50))
    assert 0.1 < np.median(near) < 4.0
    assert np.median(list(angles.values())) < 0.6
