import numpy as np
import pytest

from sfm_app.geometry.epipolar import decompose_essential, eight_point, nearest_essential, sampson_distance
from sfm_app.geometry.poses import retract
from sfm_app.posegraph.pair_pose import SIGMAS_PX, pose_distances, refine_pose


def started(views, used):
    """The pose that eight points give, of the four the one nearest to the truth."""
    E = eight_point(views.rays[used, :2], views.rays[used, 2:])
    return min(decompose_essential(nearest_essential(E)), key=lambda pose: views.errors_deg(*pose).sum())


def test_distances_are_those_of_sampson_in_pixels(two_views):
    views = two_views(false=50)

    found = pose_distances(views.lines, views.R, views.t)

    np.testing.assert_allclose(found, sampson_distance(views.F, views.x1, views.x2), rtol=1e-6)


def test_the_pose_of_exact_matches_is_exact(two_views):
    views = two_views(noise_px=0.0)
    start = started(two_views(noise_px=1.0), np.arange(30))
    assert views.errors_deg(*start).max() > 0.1

    R, t = refine_pose(views.lines, start[0], 7.0 * start[1])

    assert views.errors_deg(R, t).max() < 1e-5
    assert np.linalg.norm(t) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def test_false_matches_and_a_second_structure_hardly_move_the_pose(two_views):
    """Of 300 matches a quarter are wrong by chance and a tenth fit another pose."""
    starts, ends, clean = [], [], []
    for seed in range(8):
        views = two_views(seed, right=195, second=30, false=75)
        start = started(views, np.arange(40))
        starts.append(views.errors_deg(*start))
        ends.append(views.errors_deg(*refine_pose(views.lines, *start)))
        clean.append(views.errors_deg(*refine_pose(views.lines[:195], *start)))
    starts, ends, clean = (np.median(errors, axis=0) for errors in (starts, ends, clean))

    assert np.all(ends < [0.05, 0.2]) and np.all(ends > [0.001, 0.005])
    assert np.all(ends < 0.5 * starts)
    assert np.all(ends < 1.5 * clean)


def test_no_pose_nearby_explains_the_matches_better(two_views):
    """The end is a minimum of Cauchy's loss at its last, narrow scale."""
    views, rng = two_views(false=60, second=20), np.random.default_rng(0)
    R, t = refine_pose(views.lines, *started(views, np.arange(40)))

    def cost(pose):
        squared = pose_distances(views.lines, pose[:9].reshape(3, 3), pose[9:]) ** 2
        return np.log1p(squared / SIGMAS_PX[-1] ** 2).sum()

    end = np.concatenate([R.ravel(), t])
    nearby = [cost(retract(end, 2e-4 * rng.normal(size=5))) for _ in range(100)]
    assert cost(end) < min(nearby) + 1e-4
    assert cost(end) < 0.98 * cost(np.concatenate([np.ravel(part) for part in started(views, np.arange(40))]))


def test_matches_that_say_nothing_leave_the_pose_as_it_is(two_views):
    views = two_views()

    R, t = refine_pose(np.empty((0, 18)), views.R, views.t)

    np.testing.assert_allclose(R, views.R)
    np.testing.assert_allclose(t, views.t)
