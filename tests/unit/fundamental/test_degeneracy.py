"""Dominant planes, lines, rotations and watermarks."""

from functools import partial

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.fundamental import ESTIMATORS
from sfm_app.fundamental.degeneracy import (
    ONLY_A_LOGO,
    SAME_PHOTO,
    dominant_homography,
    find_stationary,
    fit_moving,
    is_rotation,
    is_widespread,
    off_line_mask,
    one_per_cell,
    recover_epipole,
    transfer_distance,
)
from sfm_app.fundamental.estimate import assess_fundamental, count_matches_off_plane
from sfm_app.fundamental.lev_ransac import fit_lev_ransac
from sfm_app.fundamental.pretests import NO_PRETEST
from sfm_app.fundamental.samples import random_state
from sfm_app.fundamental.scores import geman_mcclure, penalty, squared_distances
from sfm_app.geometry.epipolar import fundamental_from_pose
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.synthetic.correspondences import PairOptions, make_pair, random_rotation
from sfm_app.types import EpipolarFit, Rejected
from tests.unit.fundamental.conftest import UNIT, mapped, plane_scene

FOCAL_PX, FRAME = 900.0, np.array([1024.0, 768.0])
CAMERA = camera_matrix(FOCAL_PX, FOCAL_PX, *(FRAME / 2))
THRESHOLD = 1.5 / UNIT


@pytest.mark.parametrize(("on_plane", "off_plane"), [(100, 0), (100, 60), (300, 280), (10, 4)])
@pytest.mark.parametrize("seed", range(4))
def test_the_plane_is_found_among_other_structure(seed, on_plane, off_plane):
    points, H, F, off = plane_scene(seed, on_plane=on_plane, off_plane=off_plane)
    found = dominant_homography(points, F, THRESHOLD)
    np.testing.assert_allclose(found / found[2, 2], H / H[2, 2], atol=1e-7)
    on = transfer_distance(found, points) < THRESHOLD
    assert on[~off].all()
    assert on[off].mean() < 0.1 if off_plane else True


@pytest.mark.parametrize("seed", range(6))
def test_noise_moves_the_plane_by_less_than_itself(seed):
    points, H, F, off = plane_scene(seed, on_plane=200, off_plane=100, sigma_px=0.5)
    exact = np.column_stack([points[~off, :2], mapped(H, points[~off, :2])])
    assert 0 < np.median(transfer_distance(dominant_homography(points, F, THRESHOLD), exact)) * UNIT < 0.5


def test_an_epipole_among_the_matches_does_not_spoil_the_plane():
    """The equations of matches beside the epipole are all noise: unweighted, the error would be 1.6 px here."""
    errors = []
    for seed in range(30):
        points, H, _, _ = plane_scene(seed, on_plane=200, sigma_px=0.5)
        rng = np.random.default_rng(seed)
        e2 = np.append(points[rng.integers(200), 2:] + rng.normal(0, 2 / UNIT, 2), 1.0)
        found = dominant_homography(points, np.cross(np.eye(3), e2) @ H, THRESHOLD)
        exact = np.column_stack([points[:, :2], mapped(H, points[:, :2])])
        errors.append(transfer_distance(found, exact).max() * UNIT)
    assert 0.05 < np.median(errors) < 0.4
    assert max(errors) < 2


def test_transfer_distance_by_hand():
    H = np.array([[1.0, 0, 3], [0, 1, 4], [0, 0, 1]])
    points = np.asfortranarray([[0, 0, 3, 4.0], [0, 0, 0, 0], [5, 5, 8, 10]])
    np.testing.assert_allclose(transfer_distance(H, points), [0, 5 / np.sqrt(2), 1 / np.sqrt(2)])
    to_infinity = np.array([[1.0, 0, 0], [0, 1, 0], [1, 0, 0]])
    assert transfer_distance(to_infinity, points)[0] == np.inf


def test_matches_on_one_line_have_no_single_plane_and_still_get_an_answer():
    t = np.linspace(-1, 1, 40)
    points = np.asfortranarray(np.column_stack([t, 0.3 * t, 0.5 * t + 0.1, 0.2 * t]))
    F = plane_scene(0, on_plane=8)[2]
    assert np.isfinite(dominant_homography(points, F, 0.01)).all()


@pytest.mark.parametrize("kind", ["rotation", "planar"])
def test_every_wrong_epipole_on_a_homography_is_seen_through(kind):
    """F = [e]x H for any e, also one among the points, where the plane's equations are all noise."""
    silent, judged = [], 0
    for seed in range(100):
        rng = np.random.default_rng([seed, 77])
        x1 = rng.uniform((0, 0), FRAME, (2000, 2))
        R, t, n = random_rotation(rng, 25.0), rng.normal(0, 0.3, 3), rng.normal((0, 0, -1), 0.3)
        H = CAMERA @ (R if kind == "rotation" else R - np.outer(t, n)) @ np.linalg.inv(CAMERA)
        x2 = mapped(H, x1)
        seen = ((x2 > 0) & (x2 < FRAME)).all(axis=1)
        if np.count_nonzero(seen) < 100:
            continue
        x1, x2 = (x[seen][:400] + rng.normal(0, 0.5, x[seen][:400].shape) for x in (x1, x2))
        e2 = rng.uniform(-0.5, 1.5, 2) * FRAME if seed % 2 else x2[rng.integers(len(x2))] + rng.normal(0, 2.0, 2)
        F = np.cross(np.eye(3), np.append(e2, 1.0)) @ H
        fit = assess_fundamental(x1, x2, F, EpipolarSettings(max_error_px=2.0))
        judged += bool(fit)
        if fit and not fit.degeneracy:
            silent.append(seed)
    assert judged > 90
    assert silent == []


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


@pytest.mark.parametrize(("scene", "off_plane", "name"), [
    ("planar", 0, "planar"), ("rotation", 0, "rotation"), ("planar", 200, ""),
])  # fmt: skip
@pytest.mark.parametrize("seed", range(5))
def test_degenerate_pairs_are_named(scene, off_plane, name, seed):
    fit = ESTIMATORS["lev-ransac"][0](*views(scene, seed, off_plane=off_plane), EpipolarSettings(), seed)
    assert isinstance(fit, EpipolarFit) and fit.degeneracy == name


@pytest.mark.parametrize(("rows", "name"), [(20, "rotation"), (200, "")])
@pytest.mark.parametrize("seed", range(5))
def test_a_rotation_stays_one_although_rows_of_bricks_are_mismatched(seed, rows, name):
    """Off by whole bricks, matches agree with an epipole at the vanishing point of the rows."""
    x1, x2 = views("rotation", seed, outliers=0)
    epipole = np.array([2500.0, 300.0])
    x2[:rows] += np.random.default_rng(seed).uniform(-0.2, 0.2, (rows, 1)) * (epipole - x2[:rows])
    H = K @ TURN @ np.linalg.inv(K)
    fit = assess_fundamental(x1, x2, np.cross([*epipole, 1.0], H.T).T, EpipolarSettings())
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


@pytest.mark.parametrize("seed", range(10))
def test_scenes_with_depth_are_not_degenerate(seed):
    pair = make_pair(PairOptions(points=400, outliers=0.3, sigma_px=0.5, width=1000, height=750, focal_px=900), seed)
    assert ESTIMATORS["lev-ransac"][0](pair.x1, pair.x2, EpipolarSettings(), seed).degeneracy == ""
    few = make_pair(PairOptions(points=20, sigma_px=0.5, width=1000, height=750, focal_px=900), seed)
    assert assess_fundamental(few.x1, few.x2, few.F, EpipolarSettings()).degeneracy == ""


@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize("off_line", [0, 2, 4])
def test_a_line_is_named_though_a_few_matches_off_it_fix_the_matrix(exchanged, off_line):
    found = []
    for seed in range(6):
        x1, x2 = views_of_a_line(seed, off_line=off_line)
        if exchanged:
            x1, x2 = x2, x1
        found.append(ESTIMATORS["lev-ransac"][0](x1, x2, EpipolarSettings(), seed))
        judged = assess_fundamental(x1, x2, TRUTH.T if exchanged else TRUTH, EpipolarSettings())
        # that a random F does as well along a line is the other thing to say
        assert judged.degeneracy == "collinear" if judged else judged.reason == "inliers no better than chance"
    named = [fit.degeneracy for fit in found if fit]
    assert set(named) <= {"collinear"}
    assert {fit.reason for fit in found if not fit} <= {"inliers no better than chance"}


@pytest.mark.parametrize("seed", range(5))
def test_a_broad_line_or_one_with_many_matches_off_it_is_no_line(seed):
    broad = ESTIMATORS["lev-ransac"][0](*views_of_a_line(seed, half_width_px=40.0), EpipolarSettings(), seed)
    assert broad.degeneracy == ""
    assert assess_fundamental(*views_of_a_line(seed, off_line=60), TRUTH, EpipolarSettings()).degeneracy == ""


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
    points[:, :2] = 3.0  # all in one place
    assert not off_line_mask(points, np.ones(400, dtype=bool), 0, 1e-9).any()


def test_an_absurd_match_does_not_hide_a_rotation():
    points = np.hstack(views("rotation", 0, outliers=0))
    points[0] = 1e9
    H = K @ TURN @ np.linalg.inv(K)
    assert is_rotation(H, points, np.zeros(4))
    assert not is_rotation(np.diag([1.3, 1.0, 1.0]) @ H, points, np.zeros(4))


SCORE = partial(geman_mcclure, scale=0.25)


def wrong_epipole(H, seed):
    F = np.cross(np.eye(3), np.append(np.random.default_rng(seed).uniform(-1, 1, 2), 1.0)) @ H
    return F / np.linalg.norm(F)


def found_from(points, F, seed=0):
    return recover_epipole(points, F, THRESHOLD, SCORE(points, THRESHOLD, None), random_state(seed))


@pytest.mark.parametrize("seed", range(10))
def test_the_right_epipole_is_found(seed):
    points, H, _, off = plane_scene(seed, on_plane=255, off_plane=45, outliers=60, sigma_px=0.3)
    start = wrong_epipole(H, seed)
    assert np.mean(np.sqrt(squared_distances(points, start.reshape(9)))[off] < THRESHOLD) < 0.4
    found = found_from(points, start)
    residuals = np.sqrt(squared_distances(points, found.reshape(9)))
    assert np.mean(residuals[off] < THRESHOLD) > 0.8
    loss = SCORE(points, THRESHOLD, None)
    scores = [penalty(points, 0, F.reshape(9), loss, np.inf, NO_PRETEST) for F in (found, start)]
    assert scores[0] < scores[1] - 0.5 * off.sum()
    assert np.linalg.norm(found) == pytest.approx(1)
    assert np.linalg.svd(found, compute_uv=False)[2] < 1e-12


@pytest.mark.parametrize("seed", range(10))
def test_few_right_matches_off_a_facade_are_found_among_many_wrong_ones(seed):
    points, H, _, off = plane_scene(seed, on_plane=600, off_plane=20, outliers=300, sigma_px=0.2)
    found = found_from(points, wrong_epipole(H, seed))
    residuals = np.sqrt(squared_distances(points, found.reshape(9)))
    assert np.mean(residuals[off] < THRESHOLD) > 0.7


def test_too_few_inliers_or_none_off_the_plane_give_no_epipole():
    points, H, _, _ = plane_scene(1, on_plane=300, sigma_px=0.3)
    assert found_from(points, wrong_epipole(H, 1)) is None
    points, _, truth, _ = plane_scene(2, on_plane=255, off_plane=45, sigma_px=0.3)
    assert found_from(points[:7].copy(order="F"), truth) is None
    assert found_from(points[:60].copy(order="F"), truth) is not None


def test_the_seed_decides_and_the_input_is_left_alone():
    points, H, _, _ = plane_scene(3, on_plane=255, off_plane=45, outliers=60, sigma_px=0.3)
    before, start = points.copy(), wrong_epipole(H, 3)
    first, again, other = (found_from(points, start, seed=seed).tobytes() for seed in (1, 1, 2))
    assert first == again != other
    np.testing.assert_array_equal(points, before)


STILL_SIZE, STILL_FOCAL = (640, 480), 700.0
OPTIONS = EpipolarSettings()


def project(X):
    return X[:, :2] / X[:, 2:] * STILL_FOCAL + [320, 240]


def moving_views(count=400, moved=(0.6, 0.0, 0.0), turn_deg=(0.0, 5.0, 0.0), near=4.0, noise=0.3, seed=1):
    """Matches of a scene of random depth, 4 to 9 units away, seen before and after a motion of the camera."""
    rng = np.random.default_rng(seed)
    Z = rng.uniform(near, 9.0, count)
    x1 = rng.uniform([0, 0], STILL_SIZE, (count, 2))
    X = np.column_stack([(x1 - [320, 240]) / STILL_FOCAL * Z[:, None], Z])
    R = axis_rotation(np.array([1.0, 0, 0]), turn_deg[0]) @ axis_rotation(np.array([0, 1.0, 0]), turn_deg[1])
    R = R @ axis_rotation(np.array([0, 0, 1.0]), turn_deg[2])
    return [x + rng.normal(scale=noise, size=x.shape) for x in (x1, project((X - moved) @ R.T))]


def still(count, box, noise=0.25, seed=2):
    """Matches that stay in place, within a box (left, top, right, bottom)."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(box[:2], box[2:], (count, 2))
    return [x + rng.normal(scale=noise, size=x.shape) for _ in range(2)]


STAMP, EVERYWHERE = (470, 440, 620, 465), (0, 0, 640, 480)


def together(*parts):
    return tuple(np.vstack(side) for side in zip(*parts, strict=True))


def fitted(points):
    mask = find_stationary(*points)
    return mask, fit_moving(
        fit_lev_ransac, points, mask, is_widespread(points[0][mask], points[0], STILL_SIZE), OPTIONS, seed=3
    )


@pytest.mark.parametrize("noise", [0.0, 0.25, 0.4])
@pytest.mark.parametrize(
    ("count", "turn_deg"), [*((count, (2.0, 3.0, 0.0)) for count in (20, 60, 300)), (100, (0.0, 5.0, 0.0))]
)
def test_a_time_stamp_is_found_and_hardly_anything_else(count, turn_deg, noise):
    mask = find_stationary(*together(moving_views(turn_deg=turn_deg), still(count, STAMP, noise)))
    assert mask[400:].mean() > 0.95
    assert mask[:400].mean() < (0.02 if turn_deg[0] else 0.04)  # the camera keeps a thing in place


@pytest.mark.parametrize(
    "motion",
    [
        {},
        {"moved": (0.02, 0, 0), "turn_deg": (0, 0, 0)},  # frames of a video: all move by 1 to 4 px
        {"moved": (0.012, 0, 0), "turn_deg": (0, 0, 0)},
        {"moved": (0.03, 0, 0), "turn_deg": (0, -0.3, 0)},
        {"moved": (0.6, 0, 0), "turn_deg": (0, -5.7, 0)},  # a thing 6 units away is kept in the middle
        {"moved": (0.15, 0, 0), "turn_deg": (0, -1.4, 0)},
        {"moved": (0, 0, 0.5), "turn_deg": (0, 0, 0)},  # forward: the middle stays where it is
        {"moved": (0, 0, 0), "turn_deg": (0, 0, 8.0)},  # about the optical axis
        {"moved": (0, 0, 0), "turn_deg": (0, 0, 1.0)},
    ],
)
def test_a_scene_of_which_parts_stay_in_place_is_left_alone(motion):
    assert not find_stationary(*moving_views(count=3000, **motion)).any()


@pytest.mark.parametrize("noise", [0.0, 0.2, 0.4])
def test_copies_of_a_photo_stay_in_place_as_a_whole(noise):
    assert find_stationary(*still(500, EVERYWHERE, noise)).all()


def test_a_few_matches_are_left_to_the_estimator():
    assert not find_stationary(*together(moving_views(), still(7, STAMP))).any()
    assert not find_stationary(np.zeros((0, 2)), np.zeros((0, 2))).any()


def test_keypoints_of_a_smaller_image_are_less_exact():
    stamp = still(60, STAMP, noise=1.2)
    assert not find_stationary(*stamp).any()
    assert find_stationary(*stamp, unit_px=3.0).all()


def test_a_logo_is_no_inlier_and_does_not_change_the_geometry():
    scene = moving_views()
    alone = fit_lev_ransac(*scene, OPTIONS, 3)
    mask, fit = fitted(together(scene, still(300, STAMP)))
    assert len(fit.inliers) == len(fit.priors) == 700
    assert not fit.inliers[mask].any() and fit.priors[mask].max() == 0
    assert fit.inliers[:400].mean() > 0.95 and fit.priors[:400].max() == 1
    assert min(np.abs(fit.F - alone.F).max(), np.abs(fit.F + alone.F).max()) < 0.02


def test_a_still_background_belongs_to_the_scene_unless_the_camera_turned():
    for turn_deg, of_scene in (((0.0, 5.0, 0.0), False), ((0.0, 0.0, 0.0), True)):
        mask, fit = fitted(together(moving_views(turn_deg=turn_deg), still(300, EVERYWHERE)))
        assert isinstance(fit, EpipolarFit)
        assert mask[400:].mean() > 0.95 and fit.inliers[:400].mean() > 0.95
        assert fit.inliers.mean() > 0.95 if of_scene else not fit.inliers[400:].any()


@pytest.mark.parametrize(("stays", "reason"), [(still(300, EVERYWHERE), SAME_PHOTO), (still(60, STAMP), ONLY_A_LOGO)])
def test_what_stays_in_place_alone_is_a_copy_or_a_logo(stays, reason):
    rng = np.random.default_rng(5)
    keypoints = rng.uniform([0, 0], STILL_SIZE, (2000, 2))
    wrong = [rng.uniform([0, 0], STILL_SIZE, (12, 2)) for _ in range(2)]
    points = together(stays, wrong)
    mask = find_stationary(*points)
    found = fit_moving(
        fit_lev_ransac, points, mask, is_widespread(points[0][mask], keypoints, STILL_SIZE), OPTIONS, seed=3
    )
    assert found == Rejected(reason)


def test_what_covers_a_photo_is_counted_where_it_shows_something():
    rng = np.random.default_rng(6)
    thing = rng.uniform([250, 150], [400, 300], (500, 2))  # before a white wall
    assert is_widespread(thing[:200], thing, STILL_SIZE)
    assert not is_widespread(thing, rng.uniform([0, 0], STILL_SIZE, (2000, 2)), STILL_SIZE)
    assert not is_widespread(np.zeros((0, 2)), thing, STILL_SIZE)


def test_one_keypoint_of_each_cell_says_the_same_of_what_is_widespread():
    rng = np.random.default_rng(5)
    for share in (0.1, 0.3, 0.5, 0.7, 1.0):
        keypoints = rng.uniform([0, 0], np.array(STILL_SIZE) * 0.8, (3000, 2))
        points = keypoints[(keypoints < np.array(STILL_SIZE) * share).all(axis=1)]
        few = one_per_cell(keypoints, STILL_SIZE)
        assert 30 < len(few) <= 64
        assert is_widespread(points, few, STILL_SIZE) == is_widespread(points, keypoints, STILL_SIZE)
