"""Lines, planes and pure rotations are named; scenes with depth are not."""

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.fundamental import ESTIMATORS
from sfm_app.fundamental.degeneracy import is_rotation, off_line_mask
from sfm_app.fundamental.estimate import count_matches_off_plane, judge
from sfm_app.geometry.epipolar import fundamental_from_pose
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import EpipolarFit

SIZE, FOCAL = np.array([1000.0, 750.0]), 900.0
K = camera_matrix(FOCAL, FOCAL, *(SIZE / 2))
TURN = axis_rotation(np.array([0.2, 1.0, 0.1]) / np.linalg.norm([0.2, 1.0, 0.1]), 12.0)
STEP = np.array([-0.9, 0.1, 0.3])
TRUTH = fundamental_from_pose(K, K, TURN, STEP)


def views(scene, seed, *, sigma_px=0.3, outliers=60, off_plane=0):
    """Matches of a plane, a pure rotation, or a plane with some points in front of it, and outliers."""
    rng = np.random.default_rng(seed)
    x1 = rng.uniform(size=(900, 2)) * SIZE
    rays = np.column_stack([x1, np.ones(900)]) @ np.linalg.inv(K).T
    normal = np.array([0.3, -0.2, 1.0])
    X = rays * (5.0 / (rays @ normal))[:, None]
    X[:off_plane] *= rng.uniform(0.5, 0.9, (off_plane, 1))
    return seen(rng, x1, X, np.zeros(3) if scene == "rotation" else STEP, sigma_px, outliers)


def seen(rng, x1, X, step, sigma_px, outliers):
    """What both views see of points X, with noise, and outliers after it."""
    x2 = (X @ TURN.T + step) @ K.T
    x2 = x2[:, :2] / x2[:, 2:]
    inside = ((x2 > 0) & (x2 < SIZE)).all(axis=1)
    x1, x2 = (x[inside] + rng.normal(scale=sigma_px, size=x[inside].shape) for x in (x1, x2))
    wrong = rng.uniform(size=(2, outliers, 2)) * SIZE
    return np.vstack([x1, wrong[0]]), np.vstack([x2, wrong[1]])


def views_of_a_line(seed, *, half_width_px=0.0, off_line=0, sigma_px=0.3, outliers=60):
    """Matches at all depths, 300 of them near one line of the first view, the others anywhere; and outliers."""
    rng = np.random.default_rng([seed, 5])
    x1 = rng.uniform(size=(300 + off_line, 2)) * SIZE
    x1[off_line:, 1] = 0.3 * x1[off_line:, 0] + 200 + rng.uniform(-half_width_px, half_width_px, 300)
    rays = np.column_stack([x1, np.ones(len(x1))]) @ np.linalg.inv(K).T
    return seen(rng, x1, rays * rng.uniform(3, 7, (len(x1), 1)), STEP, sigma_px, outliers)


@pytest.mark.parametrize("scene", ["planar", "rotation"])
@pytest.mark.parametrize("seed", range(5))
def test_degenerate_pairs_are_named(scene, seed):
    fit = ESTIMATORS["lev-ransac"][0](*views(scene, seed), EpipolarSettings(), seed)
    assert isinstance(fit, EpipolarFit)
    assert fit.degeneracy == scene


@pytest.mark.parametrize(("rows", "name"), [(20, "rotation"), (200, "")])
@pytest.mark.parametrize("seed", range(5))
def test_a_rotation_stays_one_although_rows_of_bricks_are_mismatched(seed, rows, name):
    """Off by whole bricks, matches agree with an epipole at the vanishing point of the rows."""
    x1, x2 = views("rotation", seed, outliers=0)
    epipole = np.array([2500.0, 300.0])
    x2[:rows] += np.random.default_rng(seed).uniform(-0.2, 0.2, (rows, 1)) * (epipole - x2[:rows])

    H = K @ TURN @ np.linalg.inv(K)
    fit = judge(x1, x2, np.cross([*epipole, 1.0], H.T).T, EpipolarSettings())

    assert fit.inliers[:rows].all()
    assert fit.degeneracy == name


@pytest.mark.parametrize(("scene", "off_plane"), [("rotation", 0), ("planar", 0), ("planar", 50), ("planar", 300)])
def test_matches_off_the_plane_are_counted(scene, off_plane):
    x1, x2 = views(scene, 1, off_plane=off_plane, outliers=0)

    count = count_matches_off_plane(x1 + 3000.0, x2 + 3000.0, moved_by(TRUTH, 3000.0), EpipolarSettings())

    assert 0.7 * off_plane <= count <= off_plane


def moved_by(F, px):
    """F of pixels that are moved right and down."""
    back = np.array([[1.0, 0.0, -px], [0.0, 1.0, -px], [0.0, 0.0, 1.0]])
    return back.T @ F @ back


@pytest.mark.parametrize("seed", range(5))
def test_a_plane_with_enough_in_front_of_it_is_no_plane(seed):
    fit = ESTIMATORS["lev-ransac"][0](*views("planar", seed, off_plane=200), EpipolarSettings(), seed)
    assert fit.degeneracy == ""


@pytest.mark.parametrize("seed", range(10))
def test_scenes_with_depth_are_not_degenerate(seed):
    pair = make_pair(PairOptions(points=400, outliers=0.3, sigma_px=0.5, width=1000, height=750, focal_px=900), seed)
    fit = ESTIMATORS["lev-ransac"][0](pair.x1, pair.x2, EpipolarSettings(), seed)
    assert fit.degeneracy == ""


@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize("off_line", [0, 2, 4])
def test_a_line_is_named_though_a_few_matches_off_it_fix_the_matrix(exchanged, off_line):
    found = []
    for seed in range(6):
        x1, x2 = views_of_a_line(seed, off_line=off_line)
        if exchanged:
            x1, x2 = x2, x1
        found.append(ESTIMATORS["lev-ransac"][0](x1, x2, EpipolarSettings(), seed))
        judged = judge(x1, x2, TRUTH.T if exchanged else TRUTH, EpipolarSettings())
        # that a random F does as well along a line is the other thing to say
        assert judged.degeneracy == "collinear" if judged else judged.reason == "inliers no better than chance"
    named = [fit.degeneracy for fit in found if fit]
    assert set(named) <= {"collinear"}
    assert {fit.reason for fit in found if not fit} <= {"inliers no better than chance"}


@pytest.mark.parametrize("seed", range(5))
def test_a_broad_line_or_one_with_many_matches_off_it_is_no_line(seed):
    broad = ESTIMATORS["lev-ransac"][0](*views_of_a_line(seed, half_width_px=40.0), EpipolarSettings(), seed)
    assert broad.degeneracy == ""
    assert judge(*views_of_a_line(seed, off_line=60), TRUTH, EpipolarSettings()).degeneracy == ""


@pytest.mark.parametrize("seed", range(10))
def test_twenty_matches_of_a_scene_are_not_degenerate(seed):
    pair = make_pair(PairOptions(points=20, sigma_px=0.5, width=1000, height=750, focal_px=900), seed)
    assert judge(pair.x1, pair.x2, pair.F, EpipolarSettings()).degeneracy == ""


@pytest.mark.parametrize("view", [0, 1])
def test_the_line_with_most_inliers_is_found(view):
    rng = np.random.default_rng(view)
    points = np.asfortranarray(rng.uniform(-1, 1, (400, 4)))
    on_line = rng.permutation(400) < 160
    points[on_line, 2 * view + 1] = 0.5 - 0.8 * points[on_line, 2 * view]
    inliers = on_line | (rng.random(400) < 0.3)

    off = off_line_mask(points, inliers, view, 1e-6)

    np.testing.assert_array_equal(off, ~on_line)
    assert np.mean(off_line_mask(points, inliers, 1 - view, 1e-6)) > 0.99


def test_points_in_one_place_lie_on_a_line():
    points = np.asfortranarray(np.random.default_rng(0).normal(size=(50, 4)))
    points[:, :2] = 3.0
    assert not off_line_mask(points, np.ones(50, dtype=bool), 0, 1e-9).any()


def test_an_absurd_match_does_not_hide_a_rotation():
    points = np.hstack(views("rotation", 0, outliers=0))
    points[0] = 1e9
    H = K @ TURN @ np.linalg.inv(K)
    assert is_rotation(H, points, np.zeros(4))
    assert not is_rotation(np.diag([1.3, 1.0, 1.0]) @ H, points, np.zeros(4))
