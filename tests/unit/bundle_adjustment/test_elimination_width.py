"""How many photos a photo is tied to."""

import numpy as np
import pytest

from sfm_app.bundle.normal_equations import elimination_width


def observations(tracks):
    pairs = [(photo, point) for point, photos in enumerate(tracks) for photo in photos]
    return np.array(pairs, np.int64).reshape(-1, 2).T


@pytest.mark.parametrize("reach", [2, 5, 9])
@pytest.mark.parametrize("seed", [None, 0, 1])
def test_photos_along_a_street_are_tied_to_their_neighbors_whatever_their_numbers(reach, seed):
    names = np.arange(200) if seed is None else np.random.default_rng(seed).permutation(200)

    width = elimination_width(*observations([names[k : k + reach] for k in range(201 - reach)]))

    assert 0.9 * reach <= width <= reach


def test_photos_of_a_room_are_tied_to_all():
    width = elimination_width(*observations([range(60)]))

    assert width == pytest.approx(np.sqrt(np.mean(np.arange(1, 61) ** 2)))


def test_a_street_that_ends_where_it_began_is_twice_as_wide():
    ring = [[k % 200, (k + 1) % 200, (k + 2) % 200] for k in range(200)]

    assert 4.0 <= elimination_width(*observations(ring)) <= 6.0


def test_photos_that_share_no_point_are_alone():
    assert elimination_width(*observations([[0], [1], [2]])) == 1.0
    assert elimination_width(np.zeros(0, np.int64), np.zeros(0, np.int64)) == 0.0
