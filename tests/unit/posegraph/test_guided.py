from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.posegraph.graph import guided_pose, sample_direction

LEAST = 16


def off(views, degrees):
    return Rotation.from_euler("xyz", [0.4 * degrees, 0.9 * degrees, 0.1 * degrees], degrees=True).as_matrix() @ views.R


@pytest.mark.parametrize("seed", range(4))
def test_with_the_rotation_known_a_fifth_of_right_matches_is_enough(two_views, seed):
    views = two_views(seed, right=60, false=240)

    pose = guided_pose(views.pair(), off(views, 0.5), LEAST, seed)

    assert pose.guided and pose.kind == "calibrated"
    assert 0.001 < views.errors_deg(pose.R, pose.t).max() < 0.6
    assert pose.inliers[:60].mean() > 0.95 and pose.inliers[60:].mean() < 0.1


@pytest.mark.parametrize("seed", range(4))
def test_with_a_wrong_rotation_nothing_is_believed(two_views, seed):
    views = two_views(seed, right=60, false=240)

    assert guided_pose(views.pair(), off(views, 20.0), LEAST, seed) is None


@pytest.mark.parametrize(("degrees", "believed"), [(1.5, True), (2.5, False), (4.0, False)])
def test_a_pose_that_leaves_the_rotation_it_was_given_is_not_believed(two_views, degrees, believed):
    """All matches are right, and the fit finds the true pose each time."""
    views = two_views()

    assert (guided_pose(views.pair(), off(views, degrees), LEAST, 0) is not None) == believed


@pytest.mark.parametrize(("reversed_matches", "believed"), [(0, True), (6, True), (20, False)])
def test_a_pose_with_matches_behind_the_cameras_is_not_believed(two_views, reversed_matches, believed):
    """In a shift along x, a match the wrong way round lies on its epipolar line, behind the cameras."""
    views = two_views(R=np.eye(3), t=np.array([1.0, 0.0, 0.0]))
    x1, x2 = views.x1.copy(), views.x2.copy()
    x1[:reversed_matches], x2[:reversed_matches] = views.x2[:reversed_matches], views.x1[:reversed_matches]

    pose = guided_pose(replace(views, x1=x1, x2=x2).pair(), np.eye(3), LEAST, 0)

    assert (pose is not None) == believed


def test_a_step_too_short_to_be_seen_gives_no_direction(two_views):
    """Its points lie before both cameras, but a turn alone explains them, too."""
    short, long = (two_views(t=step * two_views().t, noise_px=0.05) for step in (0.01, 0.2))

    assert guided_pose(short.pair(), short.R, LEAST, 0) is None
    assert guided_pose(long.pair(), long.R, LEAST, 0) is not None


def test_matches_of_nothing_are_not_believed(two_views):
    views = two_views(right=0, false=200)

    assert [guided_pose(views.pair(), views.R, LEAST, seed) for seed in range(5)] == [None] * 5


def test_a_turn_has_no_direction_to_find(two_views):
    views = two_views(scene="turn", false=50)

    assert guided_pose(views.pair(), views.R, LEAST, 0) is None


def test_too_few_matches_are_not_looked_at(two_views):
    assert guided_pose(two_views(right=15).pair(), two_views().R, LEAST, 0) is None
    assert guided_pose(two_views(right=16).pair(), two_views().R, LEAST, 0).inlier_count == 16


def test_the_direction_points_to_where_the_matches_lie_before_both_cameras(two_views):
    for sign in (1.0, -1.0):
        t = sign * two_views().t * [1, 1, 0.2]
        views = two_views(t=t / np.linalg.norm(t), noise_px=0.1)

        found = sample_direction(views.pair(), views.R, np.random.default_rng(0))

        assert views.errors_deg(views.R, found)[1] < 3.0


def test_the_same_seed_finds_the_same_pose(two_views):
    views = two_views(right=60, false=240)
    first, second = (guided_pose(views.pair(), views.R, LEAST, 3) for _ in range(2))

    assert first.t.tobytes() == second.t.tobytes() and first.R.tobytes() == second.R.tobytes()


@pytest.mark.parametrize("seed", range(30))
def test_few_and_wild_matches_never_raise(two_views, seed):
    """Whatever is near the sampled direction may be gone once the pose is fitted."""
    views = two_views(seed, right=0, false=16, noise_px=0.0)

    guided_pose(views.pair(), views.R, 2, seed)
