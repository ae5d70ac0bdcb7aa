import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.mapping.feature_retry import add_matches
from sfm_app.types import MatchGraph

GRID = np.array([[10.0 * k, 5.0] for k in range(4)])


def graph(known=()):
    rows = {(1, 2): np.array(known, np.uint32)} if len(known) else {}
    return MatchGraph({}, {1: GRID, 2: GRID + 1.0, 3: np.zeros((0, 2))}, rows)


def test_keypoints_in_one_place_are_one_and_others_are_appended():
    found = {1: np.array([[10.3, 5.0], [14.0, 5.0]]), 2: np.array([[1.0, 6.0], [90.0, 9.0]])}

    merged, changed = add_matches(graph(known=[[0, 3]]), found, {(1, 2): np.array([[0, 0], [1, 1]], np.uint32)})

    np.testing.assert_array_equal(merged.keypoints[1], np.vstack([GRID, found[1]]))
    np.testing.assert_array_equal(merged.matches[1, 2], [[0, 3], [1, 0], [5, 5]])
    assert changed == ((1, 2),)


def test_a_keypoint_that_has_a_match_gets_no_other():
    found = {1: GRID, 2: GRID + 1.0}
    merged, changed = add_matches(graph(known=[[0, 3]]), found, {(1, 2): np.array([[0, 1], [2, 3]], np.uint32)})

    np.testing.assert_array_equal(merged.matches[1, 2], [[0, 3]])
    assert changed == ()


def test_a_pair_and_a_photo_without_anything_get_what_was_found():
    found = {1: GRID, 3: GRID}
    merged, changed = add_matches(graph(), found, {(1, 3): np.array([[3, 1]], np.uint32)})

    np.testing.assert_array_equal(merged.matches[1, 3], [[3, 1]])
    assert changed == ((1, 3),) and len(merged.keypoints[3]) == 4


@given(st.integers(0, 2**32 - 1))
def test_matches_stay_one_to_one_and_lie_where_they_were_found(seed):
    rng = np.random.default_rng(seed)
    known = np.column_stack([rng.permutation(4)[:2], rng.permutation(4)[:2]])
    found = {photo: rng.uniform(0, 40, (6, 2)) for photo in (1, 2)}
    found[1][:2] = GRID[:2] + 0.2
    added = np.column_stack([rng.permutation(6), rng.permutation(6)]).astype(np.uint32)

    merged, _ = add_matches(graph(known=known), found, {(1, 2): added})
    rows = merged.matches[1, 2]

    np.testing.assert_array_equal(rows[:2], known)
    assert all(len(np.unique(column)) == len(rows) for column in rows.T)
    every = np.hstack([found[1][added[:, 0]], found[2][added[:, 1]]])
    for row in np.hstack(merged.points((1, 2)))[2:]:
        assert np.abs(every - row).max(axis=1).min() <= 0.5
