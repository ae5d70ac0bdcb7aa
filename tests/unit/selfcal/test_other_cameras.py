"""Photos of one size that are of several cameras."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.selfcal.groups import VoteTables
from sfm_app.selfcal.other_cameras import PER_PHOTO, cross_validate, divide_photos, split_by_focal
from sfm_app.selfcal.pairs import LOG_FOCAL

pytestmark = pytest.mark.slow

MIDDLE = np.array([[1e3, 0, 500], [0, 1e3, 375], [0, 0, 1]])


def groups(made, Fs=None, weights=None, starts=(1.0, 1.5, 0.7)):
    """Focals of the cameras found in longer sides, and the number of the camera by photo."""
    Fs = MIDDLE.T @ (made.pairs.Fs if Fs is None else Fs) @ MIDDLE
    weights = np.ones(len(Fs)) if weights is None else weights
    thetas = np.zeros((len(starts), 5))
    thetas[:, LOG_FOCAL] = np.log(starts)
    cameras, labels = split_by_focal(
        VoteTables(Fs, np.zeros((len(Fs), 2), np.int64), weights), made.pairs.photos, list(thetas)
    )
    return np.exp(cameras[:, LOG_FOCAL]), [labels[photo] for photo in sorted(labels)]


def test_photos_of_one_camera_are_never_split(shots):
    for seed in range(20):
        made = shots(6, seed, noise_px=1.0, points=120)
        focals, labels = groups(made)
        assert set(labels) == {0}
        assert focals == pytest.approx([1.0])


def test_wrong_pairs_do_not_split_a_camera(shots):
    for seed in range(20):
        made, other = shots(7, seed, points=120), shots(7, seed + 50, focal=1700.0, points=120)
        Fs = made.pairs.Fs.copy()
        wrong = np.random.default_rng(seed).permutation(min(len(Fs), len(other.pairs.Fs)))[:4]
        Fs[wrong] = other.pairs.Fs[wrong]
        assert set(groups(made, Fs)[1]) == {0}


@pytest.mark.parametrize("ratio", [1.5, 0.6])
def test_photos_are_split_by_camera(shots, ratio):
    right = 0
    for seed in range(20):
        made = shots(8, seed, focal=[1000.0] * 4 + [1000.0 * ratio] * 4, points=120)
        focals, labels = groups(made, starts=(1.0, ratio, 1.2))
        halves = {tuple(labels[:4]), tuple(labels[4:])}
        right += halves == {(0,) * 4, (1,) * 4} and sorted(focals) == pytest.approx(sorted([1.0, ratio]), rel=0.06)
    assert right >= 19


def test_one_zoomed_photo_of_eight_is_split_off(shots):
    right = 0
    for seed in range(20):
        made = shots(8, seed, focal=[1000.0] * 7 + [1500.0], points=120)
        focals, labels = groups(made)
        right += labels == [0] * 7 + [1] and focals[1] == pytest.approx(1.5, rel=0.06)
    assert right >= 19


def test_close_focals_are_mostly_split(shots):
    # 20 %: one F in ten photos may vote for the wrong half, but every camera found is one of the two
    right = 0
    for seed in range(10):
        made = shots(8, seed, focal=[1000.0] * 4 + [1200.0] * 4)
        focals, labels = groups(made, starts=(1.0, 1.2))
        assert np.all(np.min(np.abs(focals[:, None] - [1.0, 1.2]), axis=1) < 0.06)
        right += {tuple(labels[:4]), tuple(labels[4:])} == {(0,) * 4, (1,) * 4}
    assert right >= 7


def divided(made, Fs=None, kept=None, starts=(1.0,)):
    """The division of photos of 1000 x 750 pixels; `kept`: pairs that are there."""
    Fs = MIDDLE.T @ (made.pairs.Fs if Fs is None else Fs) @ MIDDLE
    rows = [k for k in range(len(Fs)) if kept is None or kept(*made.pairs.photos[k])]
    thetas = np.zeros((len(starts), 5))
    thetas[:, LOG_FOCAL] = np.log(starts)
    tables = VoteTables(Fs[rows], np.zeros((len(rows), 2), np.int64), np.ones(len(rows)))
    return divide_photos(tables, [made.pairs.photos[k] for k in rows], list(thetas))


@pytest.mark.parametrize("ratio", [1.5, 0.65])
def test_two_cameras_with_hardly_any_common_pair_are_divided(shots, ratio):
    """No photo alone wants another focal: all that it shares pairs with would have to change with it."""
    right = 0
    for seed in range(10):
        made = shots(12, seed, focal=[1000.0] * 7 + [1000.0 * ratio] * 5, points=120)
        two = divided(made, kept=lambda a, b: (a < 7) == (b < 7) or (a, b) == (6, 7))
        assert two is not None and two.is_certain
        right += [two.labels[k] for k in range(12)] == [0] * 7 + [1] * 5
        assert np.exp(two.cameras[:, LOG_FOCAL]) == pytest.approx([1.0, ratio], rel=0.1)
    assert right >= 9


def test_photos_of_one_camera_are_not_divided(shots):
    for seed in range(20):
        two = divided(shots(8, seed, noise_px=1.0, points=120), starts=(1.0, 1.5))
        assert two is None or not two.is_possible


def test_wrong_pairs_are_no_other_camera(shots):
    rng = np.random.default_rng(0)
    for seed in range(20):
        made, other = shots(8, seed, points=120), shots(8, seed + 50, focal=1700.0, points=120)
        Fs = made.pairs.Fs.copy()
        most = min(len(Fs), len(other.pairs.Fs))
        wrong = rng.permutation(most)[: most // 3]
        Fs[wrong] = other.pairs.Fs[wrong]
        two = divided(made, Fs)
        assert two is None or not two.is_possible


def test_motions_that_leave_the_focal_open_say_nothing(shots):
    for seed in range(10):
        two = divided(shots(8, seed, motion=shots.parallel))
        assert two is None or not two.is_possible


def test_one_photo_alone_is_no_camera(shots):
    """`split` asks single photos, and wants more of them."""
    two = divided(shots(8, 3, focal=[1000.0] * 7 + [1500.0], points=120))
    assert two is not None and two.smaller_count == 1 and not two.is_possible


UNLIKE = 1000 * np.geomspace(0.7, 1.75, 10)
"""Ten focals, the last 2.5 times the first."""


def validate(made, Fs=None, labels=None, seed=0):
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
def test_wrong_pairs_do_not_make_a_camera_per_photo(shots, share):
    for seed in range(8):
        made = shots(8, 300 + seed, noise_px=1.5, points=120)
        found = validate(made, with_wrong(made.pairs.Fs, share, np.random.default_rng(seed)))
        assert not found.is_camera_per_photo
        assert 0.5 < found.shared < 0.97
        assert found.own < found.shared + 0.04


def test_motions_that_leave_the_focal_open_are_no_reason_to_split(shots):
    for motion in (shots.orbit, shots.parallel, shots.onward, shots.turning):
        made = shots(8, 310, motion=motion, noise_px=1.0, points=120)
        assert not validate(made).is_camera_per_photo


def test_photos_of_unlike_cameras_have_a_camera_each(shots):
    right = 0
    for seed in range(8):
        focals = np.random.default_rng(seed).permutation(UNLIKE)
        found = validate(shots(10, 320 + seed, focal=focals, noise_px=1.0, points=200))
        right += found.is_camera_per_photo
        assert 0.1 < found.shared < 0.6
        assert found.own < 0.97
    assert 6 <= right <= 8


def test_few_cameras_that_say_as_much_are_preferred(shots):
    focals = [1000.0] * 5 + [1600.0] * 5
    for seed in range(4):
        made = shots(10, 330 + seed, focal=focals, points=200)
        halves = validate(made, labels={photo: int(photo >= 5) for photo in range(10)})
        assert not halves.is_camera_per_photo
        assert 0.85 < halves.shared < 1.0


def test_few_photos_are_not_validated(shots):
    made = shots(PER_PHOTO.least_photos - 1, 1, focal=UNLIKE[: PER_PHOTO.least_photos - 1])
    assert validate(made) == (1.0, 1.0, 0.0, False)


def test_the_answer_is_the_same_for_every_order_of_the_cameras_of_a_pair(shots):
    made = shots(10, 321, focal=UNLIKE, points=200)
    turned = replace(made, pairs=replace(made.pairs, photos=tuple(pair[::-1] for pair in made.pairs.photos)))
    assert validate(turned, made.pairs.Fs.transpose(0, 2, 1)) == pytest.approx(validate(made), abs=1e-9)
