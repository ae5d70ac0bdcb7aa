import numpy as np
import pytest

from sfm_app.fundamental.degeneracy import (
    ONLY_A_LOGO,
    SAME_PHOTO,
    find_stationary,
    fit_moving,
    is_widespread,
    one_per_cell,
)
from sfm_app.fundamental.lev_ransac import fit_lev_ransac
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.cameras import axis_rotation
from sfm_app.types import EpipolarFit, Rejected

SIZE, FOCAL = (640, 480), 700.0
OPTIONS = EpipolarSettings()


def project(X):
    return X[:, :2] / X[:, 2:] * FOCAL + [320, 240]


def views(count=400, moved=(0.6, 0.0, 0.0), turn_deg=(0.0, 5.0, 0.0), near=4.0, noise=0.3, seed=1):
    """Matches of a scene of random depth, 4 to 9 units away, seen before and after a motion of the camera."""
    rng = np.random.default_rng(seed)
    Z = rng.uniform(near, 9.0, count)
    x1 = rng.uniform([0, 0], SIZE, (count, 2))
    X = np.column_stack([(x1 - [320, 240]) / FOCAL * Z[:, None], Z])
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
        fit_lev_ransac, points, mask, is_widespread(points[0][mask], points[0], SIZE), OPTIONS, seed=3
    )


@pytest.mark.parametrize("noise", [0.0, 0.25, 0.4])
@pytest.mark.parametrize("count", [20, 60, 300])
def test_a_time_stamp_is_found_and_hardly_anything_else(count, noise):
    mask = find_stationary(*together(views(turn_deg=(2.0, 3.0, 0.0)), still(count, STAMP, noise)))

    assert mask[400:].mean() > 0.95
    assert mask[:400].mean() < 0.02


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
    assert not find_stationary(*views(count=3000, **motion)).any()


@pytest.mark.parametrize("noise", [0.0, 0.2, 0.4])
def test_copies_of_a_photo_stay_in_place_as_a_whole(noise):
    assert find_stationary(*still(500, EVERYWHERE, noise)).all()


def test_a_strong_time_stamp_is_found_beside_a_thing_that_the_camera_keeps_in_place():
    mask = find_stationary(*together(views(), still(100, STAMP)))

    assert mask[400:].mean() > 0.95
    assert 0 < mask[:400].mean() < 0.04


def test_a_few_matches_are_left_to_the_estimator():
    assert not find_stationary(*together(views(), still(7, STAMP))).any()
    assert not find_stationary(np.zeros((0, 2)), np.zeros((0, 2))).any()


def test_keypoints_of_a_smaller_image_are_less_exact():
    stamp = still(60, STAMP, noise=1.2)

    assert not find_stationary(*stamp).any()
    assert find_stationary(*stamp, unit_px=3.0).all()


def test_a_logo_is_no_inlier_and_does_not_change_the_geometry():
    scene = views()
    alone = fit_lev_ransac(*scene, OPTIONS, 3)

    mask, fit = fitted(together(scene, still(300, STAMP)))

    assert len(fit.inliers) == len(fit.priors) == 700
    assert not fit.inliers[mask].any() and fit.priors[mask].max() == 0
    assert fit.inliers[:400].mean() > 0.95 and fit.priors[:400].max() == 1
    assert min(np.abs(fit.F - alone.F).max(), np.abs(fit.F + alone.F).max()) < 0.02


def test_a_turntable_before_a_still_wall_gives_the_motion_of_what_turns():
    points = together(views(), still(300, EVERYWHERE))

    mask, fit = fitted(points)

    assert isinstance(fit, EpipolarFit)
    assert fit.inliers[:400].mean() > 0.95 and not fit.inliers[400:].any()
    assert mask[400:].mean() > 0.95


def test_far_things_stay_in_place_when_the_camera_does_not_turn():
    points = together(views(turn_deg=(0, 0, 0)), still(300, EVERYWHERE, noise=0.3))

    mask, fit = fitted(points)

    assert mask[400:].mean() > 0.95
    assert fit.inliers.mean() > 0.95


@pytest.mark.parametrize(("stays", "reason"), [(still(300, EVERYWHERE), SAME_PHOTO), (still(60, STAMP), ONLY_A_LOGO)])
def test_what_stays_in_place_alone_is_a_copy_or_a_logo(stays, reason):
    rng = np.random.default_rng(5)
    keypoints = rng.uniform([0, 0], SIZE, (2000, 2))
    wrong = [rng.uniform([0, 0], SIZE, (12, 2)) for _ in range(2)]
    points = together(stays, wrong)
    mask = find_stationary(*points)

    found = fit_moving(fit_lev_ransac, points, mask, is_widespread(points[0][mask], keypoints, SIZE), OPTIONS, seed=3)

    assert found == Rejected(reason)


def test_what_covers_a_photo_is_counted_where_it_shows_something():
    rng = np.random.default_rng(6)
    thing = rng.uniform([250, 150], [400, 300], (500, 2))  # before a white wall

    assert is_widespread(thing[:200], thing, SIZE)
    assert not is_widespread(thing, rng.uniform([0, 0], SIZE, (2000, 2)), SIZE)
    assert not is_widespread(np.zeros((0, 2)), thing, SIZE)


def test_one_keypoint_of_each_cell_says_the_same_of_what_is_widespread():
    rng = np.random.default_rng(5)
    for share in (0.1, 0.3, 0.5, 0.7, 1.0):
        keypoints = rng.uniform([0, 0], np.array(SIZE) * 0.8, (3000, 2))
        points = keypoints[(keypoints < np.array(SIZE) * share).all(axis=1)]
        few = one_per_cell(keypoints, SIZE)
        assert 30 < len(few) <= 64
        assert is_widespread(points, few, SIZE) == is_widespread(points, keypoints, SIZE)
