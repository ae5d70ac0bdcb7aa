"""View graphs of a walk through a town: matches as a matcher gives them."""

import numpy as np

from benchmarks.synthetic.matches import TownOptions, make_town_graph


def test_no_keypoint_has_two_matches_in_a_photo_and_some_matches_are_wrong():
    town = make_town_graph(TownOptions(photos=40, neighbors=8, look_alikes=0.02), 0)

    assert all(len(np.unique(rows[:, side])) == len(rows) for rows in town.matches.matches.values() for side in (0, 1))
    right = np.concatenate([fit.inliers for pair, fit in town.views.fits.items() if pair not in town.look_alikes])
    assert 0.65 < right.mean() < 0.85
