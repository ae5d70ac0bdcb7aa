"""Several cameras from the pairs within and between them."""

from itertools import combinations, product

import numpy as np
import pytest

from sfm_app.selfcal.groups import CameraGroup, VoteTables, best_places, calibrate_cameras
from sfm_app.selfcal.pairs import LOG_FOCAL
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPairs

slow = pytest.mark.slow

OPTIONS = CalibrationSettings()


def answers(made, members):
    members = np.asarray(members)
    sizes = [made.sizes[int(np.argmax(members == k))] for k in range(members.max() + 1)]
    of_pair = np.array([[members[i], members[j]] for i, j in made.pairs.photos], np.int64).reshape(-1, 2)
    return calibrate_cameras([CameraGroup(size) for size in sizes], made.pairs, of_pair, OPTIONS, "mine")


def score(found, K):
    places = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    return max(abs(found.K[at] - K[at]) / found.spread[name] for name, at in places.items())


@slow
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


@slow
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


@slow
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


@slow
def test_without_any_pair_nothing_is_known(shots):
    made = shots(2, 0, points=10)
    assert len(made.pairs.Fs) == 0
    found = answers(made, [0, 1])
    assert [camera.reason for camera in found] == ["0 usable pairs, 2 are needed"] * 2


@slow
@pytest.mark.parametrize("motion", ["orbit", "parallel"])
def test_motions_that_leave_the_focal_open_leave_it_open(shots, motion):
    made = shots(6, 1, motion=getattr(shots, motion), focal=[1000.0] * 3 + [1300.0] * 3)
    for camera, K in zip(answers(made, [0, 0, 0, 1, 1, 1]), made.Ks[[0, 3]], strict=True):
        assert not camera.identifiable or score(camera, K) < 3


@slow
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


def value_of(places, own, between):
    gain = sum(own[k, place] for k, place in enumerate(places))
    return gain + sum(table[places[i], places[j]] for (i, j), table in between.items())


def icm(own, between):
    places = list(np.argmax(own, axis=1))
    for _ in range(20):
        for k in range(len(places)):
            trials = [[*places[:k], g, *places[k + 1 :]] for g in range(own.shape[1])]
            places = max(trials, key=lambda trial: value_of(trial, own, between))
    return value_of(places, own, between)


def test_best_places_are_nearly_always_the_best():
    exact = lower = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        own, count = rng.uniform(0, 1, (4, 4)), 4
        between = {edge: rng.uniform(0, 1.5, (4, 4)) for edge in combinations(range(count), 2) if rng.random() < 0.8}
        best = max(value_of(places, own, between) for places in product(range(4), repeat=count))
        value = value_of(best_places(own, between), own, between)
        assert value <= best + 1e-12
        exact += value > best - 1e-9
        lower += value < icm(own, between) - 1e-9
    assert exact >= 32
    assert lower == 0


def test_best_places_of_a_chain_are_the_best():
    for seed in range(10):
        rng = np.random.default_rng(seed)
        own, between = rng.uniform(size=(5, 4)), {(k, k + 1): rng.uniform(0, 2, (4, 4)) for k in range(4)}
        best = max(product(range(4), repeat=5), key=lambda places: value_of(places, own, between))
        assert tuple(best_places(own, between)) == best


def test_without_pairs_every_camera_takes_its_own_best():
    assert best_places(np.array([[0, 1.0, 0], [2, 1, 0]]), {}).tolist() == [1, 0]


@slow
def test_zooms_on_an_orbit_leave_all_focals_open(shots):
    """Photos that look at one point from one distance fit any common factor of their focals."""
    focals = 1000.0 * np.linspace(0.8, 1.2, 8)
    pairs = shots(8, 3, focal=focals, motion=shots.orbit, points=300).as_set(["zoom"] * 8)
    members = np.array(pairs.photos)
    own = [CameraGroup((1000, 750), family=0) for _ in focals]
    found = calibrate_cameras(own, CameraPairs(pairs.Fs, pairs.weights, (1, 1), pairs.photos, pairs.inliers), members,
                              OPTIONS, "here")  # fmt: skip
    assert not any(one.is_estimated for one in found)
    assert all("orbit" in one.reason for one in found)
