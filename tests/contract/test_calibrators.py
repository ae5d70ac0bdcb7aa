"""One set of tests for every registered calibrator, ours and any plug-in's."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import get_args

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.plugins import load_plugins
from sfm_app.selfcal import calibrate_photo_set, pair_weights, photo_set, zero_curves
from sfm_app.settings import CalibrationSettings, ConstraintForm
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.types import Calibration, CameraPairs, CameraPrior, PhotoPairs

CALIBRATORS = load_plugins().calibrators
OPTIONS = CalibrationSettings()
SIZE = (1000, 750)
K = np.array([[1100.0, 0, 510], [0, 1100, 370], [0, 0, 1]])
GUESS = np.array([[1200.0, 0, 500], [0, 1200, 375], [0, 0, 1]])


def fundamentals(count, seed, *, noise=3e-4, motion="free"):
    """(P, 3, 3) for all pairs of `count` cameras of matrix K; `noise` is that of the entries of E."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(-0.6, 0.6, (count, 3)) if motion == "free" else np.zeros((count, 3))
    centers = rng.normal(size=(count, 3))
    if motion == "orbit":
        turns[:, 1] = 0.25 * np.arange(count)
        centers = np.stack([-np.sin(turns[:, 1]), np.zeros(count), -np.cos(turns[:, 1])], axis=1)
    rotations = Rotation.from_rotvec(turns).as_matrix().transpose(0, 2, 1)
    inverse, found = np.linalg.inv(K), []
    for i, j in combinations(range(count), 2):
        t = rotations[j] @ (centers[i] - centers[j])
        E = np.cross(np.eye(3), t / np.linalg.norm(t)).T @ rotations[j] @ rotations[i].T
        found.append(inverse.T @ (E + rng.normal(0, noise, (3, 3))) @ inverse)
    return np.array(found)


def random_fundamentals(count, seed):
    scale = np.diag([1e-3, 1e-3, 1.0])
    return scale @ np.random.default_rng(seed).normal(size=(count, 3, 3)) @ scale


NOT_ROBUST = {"geometric", "huang-faugeras", "kruppa"}
"""Sums of squares over all pairs, which one wrong F moves. Geometric would see it by its matches; here are none."""

UNDETERMINED = {
    "no pairs": np.empty((0, 3, 3)),
    "one pair": fundamentals(2, 0),
    "one pair, ten times": np.repeat(fundamentals(2, 0), 10, axis=0),
    "one pair, to and fro": np.concatenate([fundamentals(2, 0), -2 * fundamentals(2, 0).transpose(0, 2, 1)] * 3),
    "pure translation, exact": fundamentals(6, 0, noise=0.0, motion="translation"),
    "pure translation, noisy": fundamentals(6, 1, motion="translation"),
    "orbit, exact": fundamentals(6, 0, noise=0.0, motion="orbit"),
    "orbit, noisy": fundamentals(6, 1, motion="orbit"),
    "no camera, few pairs": random_fundamentals(4, 0),
    "no camera, many pairs": random_fundamentals(60, 1),
    "rank one": np.ones((5, 3, 3)) + np.eye(3)[0] * np.arange(5)[:, None, None],
    "the identity": np.tile(np.eye(3), (4, 1, 1)) + np.arange(4)[:, None, None] * np.diag([1.0, 2, 3]),
}


@pytest.fixture(params=CALIBRATORS)
def calibrate(request):
    return CALIBRATORS[request.param].calibrate


def run(calibrate, Fs, seed=0, weights=None, size=SIZE):
    return calibrate(CameraPairs.from_Fs(Fs, size, weights), OPTIONS, seed)


def is_well_formed(found):
    assert isinstance(found, Calibration) and (found.K.shape, found.K.dtype) == ((3, 3), np.float64)
    assert np.all(np.isfinite(found.K)) and found.K[0, 0] > 0 and found.K[1, 1] > 0
    np.testing.assert_array_equal(found.K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], [0, 0, 0, 0, 1])
    assert (found.width, found.height) == SIZE and found.identifiable == (found.reason == "")
    assert found.method in (*CALIBRATORS, "guess", "estimate") and np.isfinite(found.radial)
    assert set(found.spread) <= {"fx", "fy", "cx", "cy", "k1"}
    assert set(found.held) <= {"center", "aspect", "k1"}
    assert all(np.isfinite(value) and value >= 0 for value in found.spread.values())
    assert all(isinstance(value, float) and np.isfinite(value) for value in found.evidence.values())
    return True


@pytest.mark.parametrize("seed", range(3))
def test_finds_the_camera(calibrate, seed):
    found = run(calibrate, fundamentals(6, seed))
    assert is_well_formed(found) and found.identifiable, found.reason
    error = np.abs(found.K - K)
    assert 0 < error[[0, 1], [0, 1]].max() < 0.05 * 1100 and 0 < error[:2, 2].max() < 0.05 * 1000
    assert 0 < found.evidence["support"] <= 1


@pytest.mark.parametrize("form", get_args(ConstraintForm))
@pytest.mark.parametrize("name", ["huang-faugeras", "geometric", "perturbation", "multi-start"])
def test_every_form_of_the_constraint_finds_the_camera(name, form):
    options = OPTIONS.model_copy(update={"constraint_form": form})
    found = CALIBRATORS[name].calibrate(CameraPairs.from_Fs(fundamentals(5, 0), SIZE), options, 0)
    assert is_well_formed(found) and found.identifiable, found.reason
    np.testing.assert_allclose(found.K, K, rtol=0.02, atol=15)
    assert np.abs(found.K - K).max() > 0


@pytest.mark.parametrize("form", get_args(ConstraintForm))
@pytest.mark.parametrize("case", UNDETERMINED)
def test_no_form_of_the_constraint_invents_a_camera(case, form):
    options = OPTIONS.model_copy(update={"constraint_form": form})
    found = CALIBRATORS["huang-faugeras"].calibrate(CameraPairs.from_Fs(UNDETERMINED[case], SIZE), options, 0)
    assert is_well_formed(found) and (found.identifiable, found.method) == (False, "guess")


@pytest.mark.parametrize("name", CALIBRATORS)
def test_some_wrong_pairs_do_no_harm(name):
    Fs = fundamentals(6, 0)
    Fs[[2, 9]] = random_fundamentals(2, 0)
    found = run(CALIBRATORS[name].calibrate, Fs)
    if name in NOT_ROBUST:
        assert not found.identifiable or np.abs(np.diag(found.K) - np.diag(K)).max() < 0.15 * 1100
        return
    assert found.identifiable, found.reason
    np.testing.assert_allclose(found.K, K, rtol=0.06, atol=50)


@pytest.mark.parametrize("case", UNDETERMINED)
def test_undetermined_cameras_are_guesses_with_a_reason(calibrate, case):
    found = run(calibrate, UNDETERMINED[case])
    assert is_well_formed(found) and not found.identifiable
    assert 0 < len(found.reason) < 120 and found.method == "guess"
    np.testing.assert_array_equal(found.K, GUESS)


def test_three_pairs_give_an_answer_or_a_reason(calibrate):
    for seed in range(6):
        found = run(calibrate, fundamentals(3, seed))
        assert is_well_formed(found)
        if found.identifiable:
            np.testing.assert_allclose(np.diag(found.K)[:2], 1100, rtol=0.15)


@pytest.mark.parametrize(
    ("Fs", "weights", "size"),
    [
        (K, np.ones(1), SIZE),
        (np.ones((4, 3, 4)), np.ones(4), SIZE),
        (np.zeros((4, 3, 3)), np.ones(4), SIZE),
        (random_fundamentals(4, 0), np.ones(3), SIZE),
        (random_fundamentals(4, 0), np.ones((4, 1)), SIZE),
        (random_fundamentals(4, 0), -np.ones(4), SIZE),
        (random_fundamentals(4, 0), np.ones(4), (0, 750)),
        (random_fundamentals(4, 0) + [[0, np.nan, 0]] * 3, np.ones(4), SIZE),
        (random_fundamentals(4, 0) * [[1, np.inf, 1]] * 3, np.ones(4), SIZE),
        (random_fundamentals(4, 0), np.array([1, np.nan, 1, 1]), SIZE),
        (random_fundamentals(4, 0), np.array([1, np.inf, 1, 1]), SIZE),
    ],
)
def test_malformed_input_is_refused(calibrate, Fs, weights, size):
    with pytest.raises(ValueError, match=r"shape|zero|weights|size|finite"):
        calibrate(CameraPairs.from_Fs(Fs, size, weights), OPTIONS, 0)


def test_scale_sign_order_and_direction_do_not_matter(calibrate):
    Fs = fundamentals(6, 2)
    expected = run(calibrate, Fs).K
    scales = np.random.default_rng(0).uniform(1, 1e6, 15) * np.where(np.arange(15) % 2, 1, -1)
    for same in (Fs * scales[:, None, None], Fs[::-1], Fs.transpose(0, 2, 1)):
        np.testing.assert_allclose(run(calibrate, same).K, expected, rtol=2e-3)


def test_pairs_without_weight_do_not_count(calibrate):
    Fs = np.concatenate([fundamentals(6, 3), random_fundamentals(5, 3)])
    weights = np.concatenate([np.full(15, 0.8), np.zeros(5)])
    all_pairs, used = run(calibrate, Fs, weights=weights), run(calibrate, Fs[:15], weights=weights[:15])
    np.testing.assert_array_equal(all_pairs.K, used.K)


@pytest.mark.parametrize("Fs", [fundamentals(5, 1), UNDETERMINED["one pair"]], ids=["found", "guess"])
def test_input_is_left_alone_and_answers_of_threads_repeat_and_cross_process_borders(calibrate, Fs):
    weights = np.linspace(0.1, 1, len(Fs))
    before = Fs.copy(), weights.copy()
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda _: pickle.dumps(run(calibrate, Fs, seed=3, weights=weights)), range(6)))
    assert len(set(runs)) == 1
    np.testing.assert_array_equal(Fs, before[0])
    np.testing.assert_array_equal(weights, before[1])
    found, copy = run(calibrate, Fs, seed=3, weights=weights), pickle.loads(runs[0])  # noqa: S301 - our own bytes
    np.testing.assert_array_equal(copy.K, found.K)
    assert (copy.identifiable, copy.reason, copy.evidence) == (found.identifiable, found.reason, found.evidence)
    assert pickle.loads(pickle.dumps(calibrate)) is calibrate  # noqa: S301


TRACKS = TrackOptions(
    points=150, sigma_px=0.5, width=1000, height=750, focal_px=(1100, 1100), aspect=(1, 1), center_offset=0.0
)


@cache
def matched(seed):
    """Pairs with their matches, of a camera with focal 1100 and the center in the middle."""
    tracks, rng, Fs = make_tracks(TRACKS, seed), np.random.default_rng(seed), []
    for view in tracks.pairs.values():
        E = view.K.T @ view.F @ view.K
        inverse = np.linalg.inv(view.K)
        Fs.append(inverse.T @ (E / np.linalg.norm(E) + rng.normal(0, 2e-4, (3, 3))) @ inverse)
    inliers = tuple(np.hstack([view.x1, view.x2]) for view in tracks.pairs.values())
    return CameraPairs(np.array(Fs), np.ones(len(Fs)), SIZE, tuple(tracks.pairs), inliers)


def each(pairs, change):
    """The same pairs with other inliers."""
    return replace(pairs, inliers=tuple(change(x) for x in pairs.inliers))


def first(pairs, change):
    return replace(pairs, inliers=(change(pairs.inliers[0]), *pairs.inliers[1:]))


ROUND_THE_MIDDLE = np.array([[0, -1, 375.0], [1, 0, -500], [-375, 500, 0]])
"""F of a photo and itself, as a motion straight ahead would have it."""

HOSTILE = {
    "seven inliers": lambda p: replace(each(p, lambda x: x[:7]), weights=pair_weights([7] * len(p.Fs))),
    "one inlier": lambda p: each(p, lambda x: x[:1]),
    "no inliers": lambda p: each(p, lambda x: x[:0]),
    "one pair without": lambda p: first(p, lambda x: x[:0]),
    "one pair with": lambda p: replace(p, inliers=(p.inliers[0], *(x[:0] for x in p.inliers[1:]))),
    "identical points": lambda p: each(p, lambda x: np.repeat(x[:1], 20, axis=0)),
    "all in the middle": lambda p: each(p, lambda x: 0 * x + [500, 375, 500, 375]),
    "on one line": lambda p: each(p, lambda x: x[:, [0, 0, 2, 2]]),
    "on a vertical line": lambda p: each(p, lambda x: x * [0, 1, 0, 1] + [500, 0, 500, 0]),
    "nothing moved": lambda p: each(p, lambda x: x[:, [0, 1, 0, 1]]),
    "huge": lambda p: each(p, lambda x: x * 1e6),
    "one huge": lambda p: first(p, lambda x: np.vstack([x, [[1e12, -1e12, 1e12, 5.0]]])),
    "tiny": lambda p: each(p, lambda x: x * 1e-200),
    "mirrored": lambda p: each(p, lambda x: -x),
    "integers": lambda p: each(p, lambda x: np.round(x).astype(np.int64)),
    "16 bit": lambda p: each(p, lambda x: np.round(x).astype(np.int16)),
    "single precision": lambda p: each(p, lambda x: x.astype(np.float32)),
    "strided": lambda p: each(p, lambda x: np.repeat(x, 2, axis=0)[::2]),
    "of other pairs": lambda p: replace(p, inliers=p.inliers[3:] + p.inliers[:3]),
    "matches of noise": lambda p: each(p, lambda x: np.random.default_rng(0).uniform(0, 700, x.shape)),
    "matrices of noise": lambda p: replace(p, Fs=random_fundamentals(len(p.Fs), 0)),
    "rank one": lambda p: replace(p, Fs=np.tile(UNDETERMINED["rank one"], (2, 1, 1))),
    "photos unknown": lambda p: replace(p, photos=()),
    "hardly trusted": lambda p: replace(p, weights=np.full(len(p.Fs), 1e-200)),
    "the same F throughout": lambda p: replace(p, Fs=np.repeat(p.Fs[:1], len(p.Fs), axis=0)),
    "nearly the same F throughout": lambda p: replace(p, Fs=p.Fs[:1] + 1e-7 * np.abs(p.Fs[:1]).max() * p.Fs),
    "the same photo throughout": lambda p: replace(p, Fs=np.tile(ROUND_THE_MIDDLE, (len(p.Fs), 1, 1)),
                                                   inliers=tuple(x[:, [0, 1, 0, 1]] for x in p.inliers)),
    "photos of one pair": lambda p: replace(p, photos=(p.photos[0],) * len(p.photos)),
    "a view of a hundredth of a degree": lambda p: each(p, lambda x: 1e-4 * x + 0.9999 * np.tile([500, 375], 2)),
    "rank one and the rest": lambda p: replace(p, Fs=np.concatenate([np.ones((3, 3, 3)), p.Fs[3:]])),
    "all but the same weight": lambda p: replace(p, weights=np.geomspace(1e-300, 1.0, len(p.Fs))),
    "absurd claims": lambda p: replace(p, prior=CameraPrior("a net", 1e12, 1e-3, (-1e9, 1e9), 1e-3, 9.0, 1e-6)),
}  # fmt: skip


@pytest.mark.parametrize("seed", range(2))
def test_finds_the_camera_with_matches(calibrate, seed):
    found = calibrate(matched(seed), OPTIONS, 0)
    assert is_well_formed(found) and found.identifiable, found.reason
    error = np.abs(found.K - [[1100, 0, 500], [0, 1100, 375], [0, 0, 1]])
    assert 0 < error[[0, 1], [0, 1]].max() < 0.05 * 1100 and 0 < error[:2, 2].max() < 50
    assert set(found.key_pairs) <= set(matched(seed).photos)


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_matches_never_raise(calibrate, case):
    found = calibrate(HOSTILE[case](matched(1)), OPTIONS, 0)
    assert is_well_formed(found)
    if found.identifiable:
        np.testing.assert_allclose(np.diag(found.K)[:2], 1100, rtol=0.08)


@pytest.mark.parametrize("change", [
    lambda p: replace(p, inliers=p.inliers[:-1]),
    lambda p: first(p, lambda x: x[:, :3]),
    lambda p: first(p, lambda x: x[0]),
    lambda p: first(p, lambda x: x * np.nan),
    lambda p: first(p, lambda x: x * np.inf),
    lambda p: replace(p, photos=p.photos[1:]),
])  # fmt: skip
def test_malformed_matches_are_refused(calibrate, change):
    with pytest.raises(ValueError, match=r"inliers|photos|finite"):
        calibrate(change(matched(1)), OPTIONS, 0)


def test_matches_are_left_alone_and_answers_repeat(calibrate):
    pairs = matched(2)
    before = pairs.Fs.copy(), [x.copy() for x in pairs.inliers]
    with ThreadPoolExecutor(2) as pool:
        runs = list(pool.map(lambda _: pickle.dumps(calibrate(pairs, OPTIONS, 3)), range(4)))
    assert len(set(runs)) == 1
    np.testing.assert_array_equal(pairs.Fs, before[0])
    np.testing.assert_array_equal(pairs.inliers, before[1])
    found, copy = calibrate(pairs, OPTIONS, 3), pickle.loads(runs[0])  # noqa: S301 - our own bytes
    assert (copy.K.tobytes(), copy.spread, copy.key_pairs) == (found.K.tobytes(), found.spread, found.key_pairs)


def test_order_and_direction_of_pairs_with_matches_do_not_matter(calibrate):
    pairs = matched(3)
    expected = calibrate(pairs, OPTIONS, 0).K
    back = replace(
        each(pairs, lambda x: x[:, [2, 3, 0, 1]]),
        Fs=pairs.Fs.transpose(0, 2, 1), photos=tuple((j, i) for i, j in pairs.photos),
    )  # fmt: skip
    turned = replace(pairs, Fs=pairs.Fs[::-1], photos=pairs.photos[::-1], inliers=pairs.inliers[::-1])
    for same in (back, turned):
        np.testing.assert_allclose(calibrate(same, OPTIONS, 0).K, expected, rtol=2e-3, atol=0.5)


GROUPINGS = {
    "one": lambda _: "one",
    "each its own": lambda photo: f"camera {photo}",
    "two": lambda photo: "even" if photo % 2 == 0 else "odd",
}


@pytest.mark.parametrize("grouping", GROUPINGS)
@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_sets_of_several_cameras_never_raise(case, grouping, monkeypatch):
    """The safety net is taken away: what is fitted together may not fall into it either."""
    monkeypatch.setattr(photo_set, "FAILURES", ())
    pairs = HOSTILE[case](matched(1))
    if not pairs.photos:
        pytest.skip("a set knows its photos")
    photos = range(1 + max(max(pair) for pair in pairs.photos))
    photo_pairs = PhotoPairs(
        pairs.Fs, pairs.weights, pairs.photos, pairs.inliers,
        sizes=dict.fromkeys(photos, SIZE), groups={photo: GROUPINGS[grouping](photo) for photo in photos},
        priors=dict.fromkeys(photos, pairs.prior) if pairs.prior else {},
    )  # fmt: skip
    found = calibrate_photo_set(photo_pairs, zero_curves.calibrate, OPTIONS, 0, together=True)
    assert sorted(photo for camera in found for photo in camera.photos) == list(photos)
    for camera in found:
        assert is_well_formed(replace(camera.found, method="guess"))
        assert camera.found.identifiable or camera.found.reason
