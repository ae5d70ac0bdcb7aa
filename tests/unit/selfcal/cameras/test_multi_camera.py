"""Several cameras from the pairs within and between them."""

import numpy as np
import pytest

from sfm_app.selfcal.groups import CameraGroup, VoteTables, calibrate_cameras
from sfm_app.selfcal.pairs import LOG_FOCAL
from sfm_app.settings import CalibrationSettings

pytestmark = pytest.mark.slow

OPTIONS = CalibrationSettings()


def answers(made, members, cameras=None, options=OPTIONS):
    members = np.asarray(members)
    sizes = [made.sizes[int(np.argmax(members == k))] for k in range(members.max() + 1)]
    cameras = cameras or [CameraGroup(size) for size in sizes]
    of_pair = np.array([[members[i], members[j]] for i, j in made.pairs.photos], np.int64).reshape(-1, 2)
    return calibrate_cameras(cameras, made.pairs, of_pair, options, "mine")


def score(found, K):
    places = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    return max(abs(found.K[at] - K[at]) / found.spread[name] for name, at in places.items())


def test_two_cameras_of_different_size_and_focal(shots):
    sizes, focals = [(1000, 750)] * 3 + [(600, 800)] * 3, [1000.0] * 3 + [900.0] * 3
    made = shots(6, 1, focal=focals, size=sizes)
    found = answers(made, [0, 0, 0, 1, 1, 1])
    for camera, photo in zip(found, (0, 3), strict=True):
        assert camera.identifiable, camera.reason
        assert (camera.width, camera.height) == sizes[photo]
        assert camera.method == "mine"
        assert 0 < abs(camera.K[0, 0] / focals[photo] - 1) < 0.02
        assert 0 < score(camera, made.Ks[photo]) < 3


def test_every_photo_of_its_own_camera(shots):
    focals = np.random.default_rng(1).uniform(700, 1500, 9)
    made = shots(9, 2, focal=focals)
    found = answers(made, range(9))
    known = [k for k in range(9) if found[k].identifiable]
    assert len(known) >= 6
    for k in known:
        assert 0 < abs(found[k].K[0, 0] / focals[k] - 1) < 0.08
        assert 0 < score(found[k], made.Ks[k]) < 3
    assert all("uncertain" in found[k].reason for k in range(9) if k not in known)


def test_a_camera_without_enough_pairs_is_not_known(shots):
    made = shots(5, 3, focal=[1000.0] * 4 + [1500.0])
    few = [k for k, pair in enumerate(made.pairs.photos) if 4 not in pair or pair == (0, 4)]
    pairs = type(made.pairs)(
        made.pairs.Fs[few], made.pairs.weights[few], made.pairs.size,
        tuple(made.pairs.photos[k] for k in few), tuple(made.pairs.inliers[k] for k in few),
    )  # fmt: skip
    first, second = answers(type(made)(pairs, made.Ks, made.sizes), [0, 0, 0, 0, 1])
    assert first.identifiable, first.reason
    assert 0 < score(first, made.Ks[0]) < 3
    assert (second.identifiable, second.reason) == (False, "1 usable pairs, 2 are needed")


def test_without_any_pair_nothing_is_known(shots):
    made = shots(2, 0, points=10)
    assert len(made.pairs.Fs) == 0
    found = answers(made, [0, 1])
    assert [camera.reason for camera in found] == ["0 usable pairs, 2 are needed"] * 2


@pytest.mark.parametrize("motion", ["orbit", "parallel"])
def test_motions_that_leave_the_focal_open_leave_it_open(shots, motion):
    made = shots(6, 1, motion=getattr(shots, motion), focal=[1000.0] * 3 + [1300.0] * 3)
    for camera, K in zip(answers(made, [0, 0, 0, 1, 1, 1]), made.Ks[[0, 3]], strict=True):
        assert not camera.identifiable or score(camera, K) < 3


def test_tables_agree_on_the_right_focals(shots):
    made = shots(2, 4, focal=[900.0, 1400.0], noise_px=0.0)
    middle = np.array([[1e3, 0, 500], [0, 1e3, 375], [0, 0, 1]])
    tables = VoteTables(middle.T @ made.pairs.Fs @ middle, np.array([[0, 1]]), np.array([0.5]))
    focals = np.linspace(0.6, 2.0, 29)
    thetas = np.zeros((29, 5))
    thetas[:, LOG_FOCAL] = np.log(focals)
    votes = tables.votes(0, thetas, thetas, 0.01)
    assert votes.shape == (29, 29)
    assert votes[6, 16] == pytest.approx(0.5, abs=1e-3)
    assert votes[16, 6] < 0.3
    back = VoteTables(middle.T @ made.pairs.Fs.transpose(0, 2, 1) @ middle, np.array([[1, 0]]), np.array([0.5]))
    np.testing.assert_allclose(back.votes(0, thetas, thetas, 0.01), votes.T, atol=1e-5)
