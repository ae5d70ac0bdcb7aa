"""Photos that see the same place, and what they have in common."""

import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.mapping.look_alikes import find_expected_overlaps

AWAY = 5.0

pytestmark = pytest.mark.slow


def test_photos_of_one_wall_share_what_they_should(walls):
    wall = walls.add_points(0, 12, seed=1)
    walls.add_walk(range(1, 13), np.linspace(3, 9, 12), wall)

    found = find_expected_overlaps(walls.finish()[0])

    assert {(1, 2), (5, 6), (11, 12)} <= found.keys()
    assert all(meeting.shared == meeting.expected for meeting in found.values())
    assert 2 * 12 * 6 < found[5, 6].expected <= 2 * 12 * 9


def test_photos_of_two_walls_in_one_place_share_nothing(walls):
    walls.add_walk(range(1, 7), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=1))
    walls.add_walk(range(11, 17), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=2))

    found = find_expected_overlaps(walls.finish()[0])

    across = [meeting for (a, b), meeting in found.items() if (a < 10) != (b < 10)]
    assert len(across) >= 6
    assert all(meeting.shared == 0 < meeting.expected for meeting in across)


@pytest.mark.parametrize(("behind", "sides"), [(0.3, 2), (1.5, 1)])
def test_a_photo_expects_nothing_behind_what_it_sees(walls, behind, sides):
    """Those who see the far wall should see the near one, too, and not the other way round."""
    walls.add_walk(range(1, 7), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=1))
    walls.add_walk(range(11, 17), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=2, away=AWAY + behind))

    found = find_expected_overlaps(walls.finish()[0])

    assert (sides - 1) * 12 * 9 < found[3, 13].expected <= sides * 12 * 9


def test_a_photo_with_another_focal_length_need_not_match(walls):
    walls.add_walk(range(1, 7), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=1))
    walls.add_walk(range(11, 17), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=2), zoom=1.6)

    assert all((a < 10) == (b < 10) for a, b in find_expected_overlaps(walls.finish()[0]))


def test_points_of_two_photos_prove_nothing(walls):
    walls.add_walk((1, 2), (3, 3.5), walls.add_points(0, 9, seed=1))
    walls.add_walk((11, 12), (3, 3.5), walls.add_points(0, 9, seed=2))

    assert find_expected_overlaps(walls.finish()[0]) == {}


def test_photos_far_apart_do_not_meet(walls):
    walls.add_walk(range(1, 7), np.linspace(3, 6, 6), walls.add_points(0, 9, seed=1))
    walls.add_walk(range(11, 17), np.linspace(30, 33, 6), walls.add_points(27, 36, seed=2))

    assert all((a < 10) == (b < 10) for a, b in find_expected_overlaps(walls.finish()[0]))


def test_a_model_without_points_has_no_meetings():
    assert find_expected_overlaps(pycolmap.Reconstruction()) == {}
