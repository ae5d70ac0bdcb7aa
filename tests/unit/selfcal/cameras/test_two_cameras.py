"""Photos of one size that are of two cameras, whatever hides it."""

import numpy as np
import pytest

from sfm_app.selfcal.groups import VoteTables
from sfm_app.selfcal.other_cameras import divide_photos
from sfm_app.selfcal.pairs import LOG_FOCAL

pytestmark = pytest.mark.slow

MIDDLE = np.array([[1e3, 0, 500], [0, 1e3, 375], [0, 0, 1]])


def divided(made, Fs=None, kept=None, starts=(1.0,)):
    """The division of photos of 1000 x 750 pixels; `kept`: pairs that are there."""
    Fs = MIDDLE.T @ (made.pairs.Fs if Fs is None else Fs) @ MIDDLE
    rows = [k for k in range(len(Fs)) if kept is None or kept(*made.pairs.photos[k])]
    thetas = np.zeros((len(starts), 5))
    thetas[:, LOG_FOCAL] = np.log(starts)
    tables = VoteTables(Fs[rows], np.zeros((len(rows), 2), np.int64), np.ones(len(rows)))
    return divide_photos(tables, [made.pairs.photos[k] for k in rows], list(thetas))


@pytest.mark.parametrize("ratio", [1.5, 0.65])
def test_two_cameras_that_hardly_see_each_other_are_told_apart(shots, ratio):
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
