"""The production calibrator on cameras that are cropped, squeezed, narrow, few, mixed or undetermined."""

import numpy as np
import pytest

from sfm_app.selfcal import pair_weights
from sfm_app.selfcal.zero_curves import METHOD, calibrate
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPairs

pytestmark = pytest.mark.slow

OPTIONS = CalibrationSettings()


def run(made, seed=0, weights=None):
    return calibrate(CameraPairs.from_Fs(made.Fs, made.size, weights), OPTIONS, seed)


def errors(found, K, size):
    """Largest relative focal error, and largest error of the center in longer sides."""
    focal = np.abs(np.diag(found.K)[:2] / np.diag(K)[:2] - 1).max()
    return focal, np.abs(found.K[:2, 2] - K[:2, 2]).max() / max(size)


CAMERAS = {
    "plain": {},
    "wide": {"focal": 450},
    "narrow": {"focal": 2700, "noise": 2e-4},
    "cropped": {"center": (720, 260)},
    "portrait": {"size": (750, 1000)},
    "squeezed": {"aspect": 0.75},
    "stretched and cropped": {"aspect": 1.25, "center": (400, 450)},
    "level": {"motion": "level", "noise": 3e-4},
}


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("seed", range(2))
def test_finds_the_camera(views, camera, seed):
    knobs = dict(CAMERAS[camera])
    if "motion" in knobs:
        knobs["motion"] = getattr(views, knobs["motion"])
    made = views(7, seed, **knobs)
    found = run(made)
    assert found.identifiable, found.reason
    assert found.method == METHOD
    focal, center = errors(found, made.K, made.size)
    assert 0 < focal < 0.02
    assert 0 < center < 0.02
    assert found.evidence["agreeing_pairs"] > 15


@pytest.mark.parametrize("knobs", [{}, {"focal": 2700}, {"center": (720, 260)}])
def test_pixels_stay_square_unless_the_pairs_clearly_say_otherwise(views, knobs):
    for seed in range(12):
        found = run(views(6, seed, **knobs))
        assert found.K[0, 0] == found.K[1, 1]
        assert found.evidence["aspect_gain"] < 3.9


def test_the_aspect_is_freed_where_the_pairs_require_it(views):
    found = run(views(6, aspect=0.75))
    assert found.K[1, 1] / found.K[0, 0] == pytest.approx(0.75, rel=0.02)
    assert 4 < found.evidence["aspect_gain"] < 15


def test_pixels_that_may_not_be_square_are_not_claimed_to_be_known(views):
    """Between clearly square and clearly not, K may be off by as much as they are."""
    found = [run(views(4, seed, aspect=0.9)) for seed in range(8)]
    held = [one for one in found if one.K[0, 0] == pytest.approx(one.K[1, 1]) and one.evidence["aspect_gain"] > 1.0]
    assert len(held) >= 2 and not any(one.identifiable for one in held)
    assert any(one.reason == "the pixels may not be square" for one in held)


@pytest.mark.parametrize("count", [3, 5])
def test_spread_is_the_size_of_the_error(views, count):
    scores = []
    for seed in range(12):
        made = views(count, seed, noise=2e-3)
        found = run(made, seed)
        if found.identifiable:
            scores.append((found.K[0, 0] - made.K[0, 0]) / found.spread["fx"])
    assert len(scores) >= 8
    assert 0.2 < np.median(np.abs(scores)) < 1.8
    assert np.quantile(np.abs(scores), 0.8) < 4


def test_wrong_pairs_are_outvoted(views, random_fundamentals):
    made = views(6)
    Fs = made.Fs.copy()
    Fs[:6] = random_fundamentals(6)
    found = calibrate(CameraPairs.from_Fs(Fs, made.size, made.weights), OPTIONS, 0)
    assert found.identifiable
    assert max(errors(found, made.K, made.size)) < 0.03
    assert 7 < found.evidence["agreeing_pairs"] < 11


def test_a_zoomed_photo_is_outvoted(views):
    made, zoomed = views(5, noise=3e-4), views(5, noise=3e-4, focal=1500)
    Fs = made.Fs.copy()
    with_photo_0 = [0, 1, 2, 3]
    # photo 0 was taken at 1.5 times the focal: its pixels are those of the others, 1.5 times further from the center
    zoom = made.K @ np.linalg.inv(zoomed.K)
    Fs[with_photo_0] = made.Fs[with_photo_0] @ zoom
    found = calibrate(CameraPairs.from_Fs(Fs, made.size, made.weights), OPTIONS, 0)
    assert found.identifiable
    assert max(errors(found, made.K, made.size)) < 0.05


def test_weights_decide_between_two_cameras(views):
    one, other = views(5, 1, noise=3e-4), views(5, 2, noise=3e-4, focal=2000)
    Fs = np.concatenate([one.Fs, other.Fs])
    for weights, focal in (([1.0] * 10 + [0.2] * 10, 1000), ([0.2] * 10 + [1.0] * 10, 2000)):
        found = calibrate(CameraPairs.from_Fs(Fs, one.size, np.array(weights)), OPTIONS, 0)
        assert found.K[0, 0] == pytest.approx(focal, rel=0.05)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_pairs(views, count):
    made = views(3)
    found = calibrate(CameraPairs.from_Fs(made.Fs[:count], made.size), OPTIONS, 0)
    assert not found.identifiable
    assert found.reason == f"{count} usable pairs, 3 are needed"
    assert found.evidence == {"pairs": count}


def test_three_pairs_leave_the_center_near_the_middle(views):
    made = views(3, 1, noise=4e-3)
    found = calibrate(CameraPairs.from_Fs(made.Fs, made.size), OPTIONS.model_copy(update={"center_sigma": 1.0}), 0)
    assert 0 < np.linalg.norm(found.K[:2, 2] - [500, 375]) < 60


def test_the_prior_holds_the_center_of_few_pairs(views):
    made = views(4, 1, noise=4e-3)
    offsets = []
    for sigma in (0.01, 1.0):
        options = OPTIONS.model_copy(update={"center_sigma": sigma})
        found = calibrate(CameraPairs.from_Fs(made.Fs, made.size), options, 0)
        offsets.append(np.linalg.norm(found.K[:2, 2] - [500, 375]))
    assert offsets[0] < 20
    assert offsets[0] <= offsets[1]


def test_the_prior_is_measured_in_widths(views):
    made = views(4, 1, noise=3e-3)
    swap = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])
    lying = calibrate(CameraPairs.from_Fs(made.Fs, (1000, 750)), OPTIONS.model_copy(update={"center_sigma": 0.06}), 0)
    standing = calibrate(
        CameraPairs.from_Fs(swap @ made.Fs @ swap, (750, 1000)), OPTIONS.model_copy(update={"center_sigma": 0.08}), 0
    )
    assert lying.identifiable
    np.testing.assert_allclose(swap @ standing.K @ swap, lying.K, rtol=1e-3)


def test_seed_changes_the_spread_only(views):
    made = views(5)
    first, second = run(made, 1), run(made, 2)
    np.testing.assert_array_equal(first.K, second.K)
    assert first.spread != second.spread
    assert first.spread["fx"] == pytest.approx(second.spread["fx"], rel=1.0)


def with_other_pairs(shots, seed):
    """28 pairs of one camera among 153 of photos that have no camera in common, and the true K."""
    right, focals = shots(8, seed, points=400), np.random.default_rng(seed + 100).normal(np.log(620), 0.3, 18)
    wrong = shots(18, seed + 50, focal=np.exp(focals), center=(0.5, 0.2), points=80, noise_px=2.0)
    inliers = (*right.pairs.inliers, *wrong.pairs.inliers)
    ids = (*right.pairs.photos, *((i + 8, j + 8) for i, j in wrong.pairs.photos))
    Fs = np.concatenate([right.pairs.Fs, wrong.pairs.Fs])
    return CameraPairs(Fs, pair_weights([len(x) for x in inliers]), right.pairs.size, ids, inliers), right.Ks[0]


def test_wrong_pairs_do_not_pull_a_camera_away_however_many_they_are(shots):
    pairs, K = with_other_pairs(shots, seed=0)
    found = calibrate(pairs, OPTIONS, 0)
    assert found.identifiable, found.reason
    scores = [abs((found.K - K)[place]) / found.spread[name] for place, name in (((0, 0), "fx"), ((1, 2), "cy"))]
    assert max(scores) < 3 and found.spread["fx"] < 15
    assert 0.95 < found.evidence["votes_kept"] < 1.05  # an adjustment to all of them would keep less than half
