"""Streets that a few strong wrong pairs hold in a wrong place, against more right ones."""

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.posegraph.rotations import _residuals, average_rotations, find_turns

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

    (turn,) = find_turns(len(true), edges, _residuals(folded, edges, relative), strengths)

    street = np.arange(len(true)) >= CORNER
    assert np.array_equal(turn.photos, street) or np.array_equal(turn.photos, ~street)
    assert turn.gain == pytest.approx(10 - 3 * 2.5, abs=0.01)
    by = turn.by if turn.photos[-1] else turn.by.T
    assert np.degrees(Rotation.from_matrix(by @ fold).magnitude()) < 1.0


def test_nothing_turns_for_pairs_that_weigh_less_than_those_in_their_way(graph):
    true, turns, weights, _ = graph
    edges, relative, strengths = arrays(turns, weights)

    assert list(find_turns(len(true), edges, _residuals(true, edges, relative), strengths)) == []


def test_nothing_turns_where_nothing_contradicts(graph):
    true, turns, weights, wrong = graph
    right = {pair: turn for pair, turn in turns.items() if pair not in wrong}
    edges, relative, strengths = arrays(right, weights)

    assert list(find_turns(len(true), edges, _residuals(true, edges, relative), strengths)) == []


def test_pairs_without_others_do_not_end_in_an_error():
    true = Rotation.random(4, random_state=2).as_matrix()
    edges, relative = np.array([[0, 1], [0, 2], [0, 3]]), true[1:] @ true[0].T

    assert list(find_turns(4, edges, _residuals(np.tile(np.eye(3), (4, 1, 1)), edges, relative), np.ones(3))) == []
