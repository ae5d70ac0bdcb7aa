import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.posegraph.guided import guided_pose, sampled_direction

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

        found = sampled_direction(views.pair(), views.R, np.random.default_rng(0))

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
