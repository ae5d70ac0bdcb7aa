"""Joins between models of parts: similarities from photos and points that both hold, and matches across them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.geometry.poses import Similarity
from sfm_app.mapping.joins import AcrossJoins, Fragment, find_join


def off(found, true):
    """Errors of the angle in degrees, of the scale, and of where a point 10 units away ends."""
    angle = np.degrees(Rotation.from_matrix(found.R @ true.R.T).magnitude())
    at = true.inverse()(np.array([[10.0, 0.0, 3.0]]))
    return angle, abs(found.scale / true.scale - 1.0), float(np.linalg.norm(found(at) - true(at)))


def test_a_join_recovers_the_similarity(two_parts):
    join = find_join(0, 1, two_parts.fragments)

    assert (join.first, join.second, join.photos, join.shared) == (0, 1, 8, 8)
    angle, scale, place = off(join.similarity, two_parts.true)
    assert angle < 0.3 and scale < 0.01 and 0.0 < place < 0.05
    assert 100 < join.points <= 600
    assert 0.01 < join.off_deg < 0.5 and 0.0005 < join.off < 0.01
    assert np.allclose(two_parts.true(join.middle)[0, 0], 9.75, atol=0.2)


def test_photos_that_one_part_has_misplaced_do_not_count(two_parts):
    first, second = two_parts.fragments
    centers = second.placed.centers.copy()
    centers[:3] += np.array([0.0, 3.0, 1.0])  # of eight shared photos
    moved = replace(second, placed=replace(second.placed, centers=centers))

    join = find_join(0, 1, [first, moved])

    assert (join.photos, join.shared) == (5, 8)
    angle, scale, place = off(join.similarity, two_parts.true)
    assert angle < 0.3 and scale < 0.01 and place < 0.05


@pytest.mark.parametrize("shared", [0, 2, 3])
def test_three_shared_photos_join_two_do_not(street, shared):
    first = Fragment(0, frozenset(range(1, 21)), street.placed(range(1, 21)))
    second = Fragment(1, frozenset(range(21, 41)), street.placed(range(21 - shared, 41)))

    assert (find_join(0, 1, [first, second]) is not None) is (shared == 3)


def test_matches_across_bear_out_a_right_join_and_contradict_a_wrong_one(street, two_parts):
    across = AcrossJoins(*street.graphs(), 1.5)
    join = find_join(0, 1, two_parts.fragments)

    explained, contradicted = across.count(join, two_parts.fragments)
    assert explained > 800 and contradicted < 0.01 * explained

    aside = Similarity(join.similarity.scale, join.similarity.R, join.similarity.t + np.array([0.0, 3.0, 0.0]))
    explained, contradicted = across.count(replace(join, similarity=aside), two_parts.fragments)
    assert contradicted > 3 * explained
