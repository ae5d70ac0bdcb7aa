"""Photos of one size: one camera, or each its own."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.selfcal import calibrate_photo_set
from sfm_app.selfcal.groups import CameraGroup, VoteTables, calibrate_cameras
from sfm_app.selfcal.other_cameras import LEAST_PHOTOS_PER_PHOTO, cross_validate
from sfm_app.selfcal.priors import FAMILY_SPREAD, USUAL_FOCAL, TiedPriors
from sfm_app.selfcal.zero_curves import calibrate
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPairs

pytestmark = pytest.mark.slow

MIDDLE = np.array([[1e3, 0, 500], [0, 1e3, 375], [0, 0, 1]])
UNLIKE = 1000 * np.geomspace(0.7, 1.75, 10)
"""Ten focals, the last 2.5 times the first."""


def asked(made, Fs=None, labels=None, seed=0):
    """What held pairs say."""
    Fs = MIDDLE.T @ (made.pairs.Fs if Fs is None else Fs) @ MIDDLE
    tables = VoteTables(Fs, np.zeros((len(Fs), 2), np.int64), made.pairs.weights)
    return cross_validate(tables, made.pairs.photos, [np.zeros(5)], labels or {}, seed)


def with_wrong(Fs, share, rng):
    """Some of the matrices as if they were of other cameras, up to 2.7 times longer or shorter."""
    found = Fs.copy()
    for k in rng.permutation(len(Fs))[: round(share * len(Fs))]:
        scale = np.diag([1.0, 1.0, np.exp(rng.uniform(-1, 1))])
        change = MIDDLE @ scale @ np.linalg.inv(MIDDLE)
        found[k] = change.T @ Fs[k] @ change
    return found


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4])
def test_one_camera_stays_one_whatever_some_pairs_say(shots, share):
    for seed in range(8):
        made = shots(8, 300 + seed, noise_px=1.5, points=120)
        found = asked(made, with_wrong(made.pairs.Fs, share, np.random.default_rng(seed)))
        assert not found.is_camera_per_photo
        assert 0.5 < found.shared < 0.97
        assert found.own < found.shared + 0.04


def test_motions_that_leave_the_focal_open_are_no_reason_to_split(shots):
    for motion in (shots.orbit, shots.parallel, shots.onward, shots.turning):
        made = shots(8, 310, motion=motion, noise_px=1.0, points=120)
        assert not asked(made).is_camera_per_photo


def test_photos_of_unlike_cameras_are_told_apart(shots):
    right = 0
    for seed in range(8):
        focals = np.random.default_rng(seed).permutation(UNLIKE)
        found = asked(shots(10, 320 + seed, focal=focals, noise_px=1.0, points=200))
        right += found.is_camera_per_photo
        assert 0.1 < found.shared < 0.6
        assert found.own < 0.97
    assert 6 <= right <= 8


def test_few_cameras_that_say_as_much_are_preferred(shots):
    focals = [1000.0] * 5 + [1600.0] * 5
    for seed in range(4):
        made = shots(10, 330 + seed, focal=focals, points=200)
        halves = asked(made, labels={photo: int(photo >= 5) for photo in range(10)})
        assert not halves.is_camera_per_photo
        assert 0.85 < halves.shared < 1.0


def test_few_photos_are_never_asked(shots):
    made = shots(LEAST_PHOTOS_PER_PHOTO - 1, 1, focal=UNLIKE[: LEAST_PHOTOS_PER_PHOTO - 1])
    assert asked(made) == (1.0, 1.0, 0.0, False)


def test_the_answer_is_the_same_for_every_order_of_the_cameras_of_a_pair(shots):
    made = shots(10, 321, focal=UNLIKE, points=200)
    turned = replace(made, pairs=replace(made.pairs, photos=tuple(pair[::-1] for pair in made.pairs.photos)))
    assert asked(turned, made.pairs.Fs.transpose(0, 2, 1)) == pytest.approx(asked(made), abs=1e-9)


def test_a_folder_of_unlike_cameras_gets_one_for_each_photo(shots):
    made = shots(10, 321, focal=UNLIKE, noise_px=0.5, points=300)
    found = calibrate_photo_set(made.as_set(["web"] * 10), calibrate, CalibrationSettings(), 0, together=True)
    assert sorted(camera.photos for camera in found) == [(photo,) for photo in range(10)]
    assert len({camera.name for camera in found}) == 10 and "web" in {camera.name for camera in found}
    off = {camera.photos[0]: np.log(camera.found.focal_px / UNLIKE[camera.photos[0]]) for camera in found}
    known = [off[camera.photos[0]] for camera in found if camera.found.identifiable]
    assert 5 <= len(known) <= 10 and sum(camera.found.is_estimated for camera in found) >= 7
    assert 0 < np.median(np.abs(known)) < 0.02
    assert max(map(abs, known)) < 0.1


def test_zooms_on_an_orbit_leave_all_focals_open(shots):
    """Photos that look at one point from one distance fit any common factor of their focals."""
    focals = 1000.0 * np.linspace(0.8, 1.2, 8)
    pairs = shots(8, 3, focal=focals, motion=shots.orbit, points=300).as_set(["zoom"] * 8)
    members = np.array(pairs.photos)
    own = [CameraGroup((1000, 750), family=0) for _ in focals]

    found = calibrate_cameras(own, CameraPairs(pairs.Fs, pairs.weights, (1, 1), pairs.photos, pairs.inliers), members,
                              CalibrationSettings(), "here")  # fmt: skip

    assert not any(one.is_estimated for one in found)
    assert all("orbit" in one.reason for one in found)


def test_a_photo_about_which_nobody_says_anything_follows_the_others(shots):
    focals = 2.0 * UNLIKE
    made = shots(10, 322, focal=focals, noise_px=0.5, points=300)
    pairs = made.as_set(["web"] * 10)
    pairs = replace(pairs, sizes={**pairs.sizes, 10: (1000, 750)}, groups={**pairs.groups, 10: "web"})
    found = calibrate_photo_set(pairs, calibrate, CalibrationSettings(), 0, together=True)
    (lonely,) = (camera for camera in found if camera.photos == (10,))
    assert not lonely.found.identifiable and "0 usable pairs" in lonely.found.reason
    assert 1700 < lonely.found.focal_px < 2800  # the others' mean is 2200, the usual focal 1200


def prior(families, free_focal=False, hints=None, focals=(1.0, 2.0, 4.0)):
    thetas = np.zeros((3, 5))
    thetas[:, 0] = np.log(focals)
    priors = TiedPriors(np.ones(3), np.full(3, np.nan) if hints is None else hints, families=np.array(families))
    free = np.zeros((3, 4), np.bool_)
    free[:, 3] = free_focal
    return priors.prior(free, thetas)


def test_focals_of_a_family_scatter_about_their_mean():
    found = prior([0, 0, 0])
    assert found.precision[:, 0] == pytest.approx(FAMILY_SPREAD**-2)
    # drawn towards the usual focal by a prior of 0.7 beside three of 0.3
    share = 3 / FAMILY_SPREAD**2 / (3 / FAMILY_SPREAD**2 + 0.7**-2)
    assert found.mean[:, 0] == pytest.approx(USUAL_FOCAL + share * (np.log(2) - USUAL_FOCAL))


def test_families_are_apart_and_one_alone_has_nobody_to_follow():
    found = prior([-1, 5, -1])
    assert found.mean[:, 0] == pytest.approx(USUAL_FOCAL)
    assert found.precision[:, 0] == pytest.approx(0.7**-2)
    two = prior([0, 0, 1])
    assert two.mean[0, 0] == two.mean[1, 0] != two.mean[2, 0]


def test_a_claim_comes_before_the_family():
    found = prior([0, 0, 0], hints=np.array([3.0, np.nan, np.nan]))
    assert found.mean[0, 0] == pytest.approx(np.log(3))
    assert found.precision[0, 0] > 10 * found.precision[1, 0]
    freed = prior([0, 0, 0], free_focal=True, hints=np.array([3.0, np.nan, np.nan]))
    assert freed.mean[0, 0] == freed.mean[1, 0]


def within_bars(made, groups):
    """Pictures of several shapes that bars have brought to one size."""
    pairs = made.as_set(groups)
    return replace(pairs, padded_sizes=dict.fromkeys(pairs.sizes, (1000, 1000)))


def test_pictures_of_one_shape_are_of_no_camera_where_all_others_are_of_their_own(shots):
    sizes = [(1000, 666)] * 4 + [(1000, 500 + 40 * k) for k in range(6)]
    focals = np.random.default_rng(2).permutation(UNLIKE)
    made = shots(10, 323, focal=focals, size=sizes, noise_px=0.5, points=300)
    pairs = within_bars(made, [f"{width}x{height}" for width, height in sizes])
    found = calibrate_photo_set(pairs, calibrate, CalibrationSettings(), 0, together=True)
    assert sorted(camera.photos for camera in found) == [(photo,) for photo in range(10)]
    off = [abs(np.log(camera.found.focal_px / focals[camera.photos[0]])) for camera in found]
    assert 0 < np.median(off) < 0.05


def test_two_cameras_within_bars_are_two(shots):
    sizes = [(1000, 750)] * 6 + [(1000, 600)] * 6
    made = shots(12, 324, focal=[900.0] * 6 + [1300.0] * 6, size=sizes, noise_px=0.5, points=300)
    pairs = within_bars(made, ["one"] * 6 + ["two"] * 6)
    found = calibrate_photo_set(pairs, calibrate, CalibrationSettings(), 0, together=True)
    assert [camera.photos for camera in found] == [tuple(range(6)), tuple(range(6, 12))]


def test_pairs_move_with_the_corners_that_pixels_are_counted_from(shots):
    pairs = shots(4, 1).as_set(["one"] * 4)
    corners = {1: (30, 0), 3: (-12, 7)}
    moved = pairs.with_origins(corners)
    for k, (first, second) in enumerate(pairs.photos):
        shift = np.array([*corners.get(first, (0, 0)), *corners.get(second, (0, 0))])
        assert moved.inliers[k] + shift == pytest.approx(pairs.inliers[k])
        before, after = (
            _residuals(F, x) for F, x in ((pairs.Fs[k], pairs.inliers[k]), (moved.Fs[k], moved.inliers[k]))
        )
        assert after == pytest.approx(before, abs=1e-9)
    assert pairs.with_origins({}) is pairs


def _residuals(F, x):
    ones = np.ones((len(x), 1))
    return np.einsum("ni,ij,nj->n", np.hstack([x[:, 2:], ones]), F, np.hstack([x[:, :2], ones]))
