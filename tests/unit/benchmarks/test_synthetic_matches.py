"""Matches without pictures: an object that moves by itself, and a walk through a town."""

import numpy as np
import pytest

from benchmarks.synthetic.matches import LEAST_DEPARTURE_PX, TownOptions, make_town_graph, make_two_motions
from sfm_app.errors import ConfigError
from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.synthetic.correspondences import PairOptions


@pytest.mark.parametrize("seed", range(8))
def test_each_motion_has_its_own_epipolar_geometry(seed):
    scene = make_two_motions(PairOptions(points=300, outliers=0.1), 0.3, seed)
    pair, moving = scene.pair, scene.is_moving
    to_scene = sampson_distance(pair.F, pair.exact_x1, pair.exact_x2)
    to_object = sampson_distance(scene.moving_F, pair.exact_x1, pair.exact_x2)

    assert to_scene[~moving].max() < 1e-8 and to_object[moving].max() < 1e-8
    assert np.median(to_scene[moving]) >= LEAST_DEPARTURE_PX
    assert np.median(to_object[~moving]) > 1.0
    assert np.linalg.norm(scene.moving_F) == pytest.approx(1.0)
    for x in (pair.exact_x1, pair.exact_x2):
        assert x.min() >= 0 and x.max() <= 512


@pytest.mark.parametrize(("moving", "outliers"), [(0.1, 0.0), (0.25, 0.2), (0.4, 0.1)])
def test_shares_are_those_asked_for_and_rows_are_mixed(moving, outliers):
    scene = make_two_motions(PairOptions(outliers=outliers), moving, seed=3)
    wrong = ~scene.pair.is_inlier & ~scene.is_moving

    assert len(scene.pair.x1) == 1200
    assert np.count_nonzero(scene.is_moving) == round(1200 * moving)
    assert np.count_nonzero(wrong) == round(1200 * outliers)
    assert not scene.pair.is_inlier[scene.is_moving].any()
    assert abs(scene.is_moving[:600].mean() - moving) < 0.06


def test_the_object_has_the_same_noise_and_is_a_cluster():
    scene = make_two_motions(PairOptions(sigma_px=0.8), 0.4, seed=5)
    pair, moving = scene.pair, scene.is_moving

    for noise in (pair.x1 - pair.exact_x1, pair.x2 - pair.exact_x2):
        assert 0.74 < noise[moving].std() < 0.86 and 0.74 < noise[~moving].std() < 0.86
    assert pair.exact_x1[moving].std(axis=0).max() < 0.8 * pair.exact_x1[~moving].std(axis=0).min()


def test_one_seed_one_scene():
    options = PairOptions(points=100, outliers=0.1)
    first, again, other = (make_two_motions(options, 0.2, seed) for seed in (7, 7, 8))

    assert first.pair.x2.tobytes() == again.pair.x2.tobytes()
    assert first.pair.x1.tobytes() != other.pair.x1.tobytes()


@pytest.mark.parametrize(("moving", "outliers"), [(0.0, 0.1), (0.5, 0.0), (0.4, 0.2), (1.0, 0.0)])
def test_the_still_scene_must_dominate(moving, outliers):
    with pytest.raises(ConfigError, match="share above 0 and below"):
        make_two_motions(PairOptions(outliers=outliers), moving, seed=0)


def test_no_keypoint_has_two_matches_in_a_photo_and_some_matches_are_wrong():
    town = make_town_graph(TownOptions(photos=40, neighbors=8, look_alikes=0.02), 0)

    assert all(len(np.unique(rows[:, side])) == len(rows) for rows in town.matches.matches.values() for side in (0, 1))
    right = np.concatenate([fit.inliers for pair, fit in town.views.fits.items() if pair not in town.look_alikes])
    assert 0.65 < right.mean() < 0.85
