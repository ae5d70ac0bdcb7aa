"""Groups that hold photos of several cameras."""

import numpy as np
import pytest

from sfm_app.selfcal.groups import VoteTables
from sfm_app.selfcal.other_cameras import split_by_focal
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
def test_two_cameras_are_told_apart(shots, ratio):
    right = 0
    for seed in range(20):
        made = shots(8, seed, focal=[1000.0] * 4 + [1000.0 * ratio] * 4, points=120)
        focals, labels = groups(made, starts=(1.0, ratio, 1.2))
        halves = {tuple(labels[:4]), tuple(labels[4:])}
        right += halves == {(0,) * 4, (1,) * 4} and sorted(focals) == pytest.approx(sorted([1.0, ratio]), rel=0.06)
    assert right >= 19


def test_one_zoomed_photo_of_eight_is_found(shots):
    right = 0
    for seed in range(20):
        made = shots(8, seed, focal=[1000.0] * 7 + [1500.0], points=120)
        focals, labels = groups(made)
        right += labels == [0] * 7 + [1] and focals[1] == pytest.approx(1.5, rel=0.06)
    assert right >= 19


def test_close_focals_are_mostly_told_apart(shots):
    # 20 %: one F in ten photos may vote for the wrong half, but every camera found is one of the two
    right = 0
    for seed in range(10):
        made = shots(8, seed, focal=[1000.0] * 4 + [1200.0] * 4)
        focals, labels = groups(made, starts=(1.0, 1.2))
        assert np.all(np.min(np.abs(focals[:, None] - [1.0, 1.2]), axis=1) < 0.06)
        right += {tuple(labels[:4]), tuple(labels[4:])} == {(0,) * 4, (1,) * 4}
    assert right >= 7


def test_the_scale_of_the_weights_does_not_matter(shots):
    made = shots(8, 1, focal=[1000.0] * 4 + [1500.0] * 4, points=120)
    assert groups(made, weights=np.full(len(made.pairs.Fs), 0.05))[1] == groups(made)[1]
    assert set(groups(made)[1]) == {0, 1}
