"""One set of tests for every registered estimator, ours and any plug-in's."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from sfm_app.geometry.distances import sampson_distance
from sfm_app.plugins import load_plugins
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair
from sfm_app.types import EpipolarFit, Rejected

ESTIMATORS = load_plugins().estimators
SCENE = {"points": 400, "sigma_px": 0.5, "width": 1024, "height": 768, "focal_px": 900.0}
OPTIONS = EpipolarSettings(max_error_px=2.0, max_trials=2000)
RNG = np.random.default_rng(5)
CLOUD = RNG.uniform(0, 1000, (100, 2))
LINE = np.column_stack([np.linspace(0, 1000, 100), np.linspace(0, 700, 100)])

DEGENERATE = {
    "no points": (np.empty((0, 2)), np.empty((0, 2))),
    "one point": (CLOUD[:1], CLOUD[:1]),
    "six points": (CLOUD[:6], CLOUD[6:12]),
    "seven points": (CLOUD[:7], CLOUD[7:14]),
    "one point, repeated": (np.tile(CLOUD[:1], (100, 1)), np.tile(CLOUD[1:2], (100, 1))),
    "ten points, repeated": (np.tile(CLOUD[:10], (10, 1)), np.tile(CLOUD[10:20], (10, 1))),
    "all in one point of view 2": (CLOUD, np.tile(CLOUD[:1], (100, 1))),
    "on a line in both views": (LINE, LINE[:, ::-1].copy()),
    "random matches": (CLOUD, RNG.uniform(0, 1000, (100, 2))),
    "random matches far away": (CLOUD * 1e9, RNG.uniform(0, 1e9, (100, 2))),
    "random matches of nearly no extent": (CLOUD * 1e-9, RNG.uniform(0, 1e-9, (100, 2))),
}


@pytest.fixture(params=ESTIMATORS)
def fit(request):
    return ESTIMATORS[request.param].fit


def is_well_formed(found, count):
    assert isinstance(found, EpipolarFit)
    assert found.F.shape == (3, 3)
    assert np.linalg.norm(found.F) == pytest.approx(1)
    assert np.linalg.svd(found.F, compute_uv=False)[2] < 1e-12
    assert (found.inliers.shape, found.inliers.dtype) == ((count,), np.bool_)
    assert found.priors.shape == (count,)
    assert found.priors.min() >= 0
    assert found.priors.max() == 1
    assert found.trials >= 1
    assert found.degeneracy in ("", "planar", "rotation")
    return True


@pytest.mark.parametrize("outliers", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(4))
def test_finds_the_truth_and_the_injected_noise(fit, outliers, seed):
    pair = make_pair(PairOptions(outliers=outliers, **SCENE), seed)

    found = fit(pair.x1, pair.x2, OPTIONS, seed)

    assert is_well_formed(found, 400)
    noise = np.sqrt(np.mean(sampson_distance(found.F, pair.x1, pair.x2)[pair.is_inlier] ** 2))
    assert 0.40 < noise < 0.65
    assert 0 < np.median(sampson_distance(found.F, pair.exact_x1, pair.exact_x2)) < 0.4
    assert found.inliers[pair.is_inlier].mean() > 0.95
    assert found.inliers[~pair.is_inlier].sum() < 0.1 * 400
    assert found.degeneracy == ""


def test_evidence_is_that_of_the_returned_matrix(fit):
    pair = make_pair(PairOptions(outliers=0.3, **SCENE), 9)

    found = fit(pair.x1, pair.x2, OPTIONS, 0)

    distance = sampson_distance(found.F, pair.x1, pair.x2)
    np.testing.assert_array_equal(found.inliers, distance <= OPTIONS.max_error_px)
    assert found.rms_px == pytest.approx(np.sqrt(np.mean(distance[found.inliers] ** 2)))
    assert found.priors[pair.is_inlier].mean() > found.priors[~pair.is_inlier].mean() + 0.3


@pytest.mark.parametrize("case", DEGENERATE)
def test_matches_without_geometry_are_rejected_with_a_reason(fit, case):
    found = fit(*DEGENERATE[case], OPTIONS, 0)
    assert isinstance(found, Rejected), found
    assert found.reason
    assert len(found.reason) < 60


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_points_that_are_not_finite_are_refused(fit, bad):
    x = CLOUD.copy()
    x[3, 1] = bad
    with pytest.raises(ValueError, match="not finite"):
        fit(x, CLOUD, OPTIONS, 0)
    with pytest.raises(ValueError, match="not finite"):
        fit(CLOUD, x, OPTIONS, 0)


@pytest.mark.parametrize(("x1", "x2"), [(CLOUD[:, 0], CLOUD), (CLOUD, np.ones((100, 3))), (CLOUD, CLOUD[:50])])
def test_wrong_shapes_are_refused(fit, x1, x2):
    with pytest.raises(ValueError, match=r"shape|pair up"):
        fit(x1, x2, OPTIONS, 0)


@pytest.mark.parametrize("count", [8, 16, 20])
def test_few_exact_matches_give_an_answer_or_a_reason(fit, count):
    pair = make_pair(PairOptions(**{**SCENE, "points": count, "sigma_px": 0.0}), 2)
    found = fit(pair.x1, pair.x2, OPTIONS.model_copy(update={"min_inliers": 8}), 0)
    assert isinstance(found, Rejected) or (found.inliers.all() and found.rms_px < 1e-3)
    assert count < 16 or isinstance(found, EpipolarFit)


def test_fewest_inliers_are_a_setting(fit):
    pair = make_pair(PairOptions(**SCENE), 1)
    assert fit(pair.x1, pair.x2, OPTIONS.model_copy(update={"min_inliers": 380}), 0)
    assert not fit(pair.x1, pair.x2, OPTIONS.model_copy(update={"min_inliers": 401}), 0)


def test_layout_and_type_of_the_arrays_do_not_matter(fit):
    pair = make_pair(PairOptions(outliers=0.2, **SCENE), 4)
    x1, x2 = np.rint(pair.x1), np.rint(pair.x2)
    expected = pickle.dumps(fit(x1, x2, OPTIONS, 0))

    padded = np.zeros((800, 3))
    padded[::2, :2] = x1
    views = [
        (x1.astype(np.int32), x2.astype(np.int64)),
        (np.asfortranarray(x1), np.asfortranarray(x2)),
        (padded[::2, :2], x2),
    ]
    for a, b in views:
        assert pickle.dumps(fit(a, b, OPTIONS, 0)) == expected


def test_input_is_left_alone(fit):
    pair = make_pair(PairOptions(outliers=0.2, **SCENE), 4)
    before = pair.x1.copy(), pair.x2.copy()
    fit(pair.x1, pair.x2, OPTIONS, 0)
    np.testing.assert_array_equal(pair.x1, before[0])
    np.testing.assert_array_equal(pair.x2, before[1])


def test_products_cross_process_borders(fit):
    pair = make_pair(PairOptions(**SCENE), 6)
    for found in (fit(pair.x1, pair.x2, OPTIONS, 0), fit(CLOUD[:5], CLOUD[:5], OPTIONS, 0)):
        copy = pickle.loads(pickle.dumps(found))  # noqa: S301 - our own bytes
        assert type(copy) is type(found)
        assert bool(copy) == bool(found)
    fit_again = pickle.loads(pickle.dumps(fit))  # noqa: S301
    assert fit_again is fit


def test_ten_runs_in_threads_give_the_same_bytes(fit):
    pair = make_pair(PairOptions(outliers=0.3, **SCENE), 8)
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda _: pickle.dumps(fit(pair.x1, pair.x2, OPTIONS, 3)), range(10)))
    assert len(set(runs)) == 1


def test_repeated_matches_are_no_evidence(fit):
    x = RNG.uniform(0, 1000, (12, 4))
    found = fit(np.repeat(x[:, :2], 20, axis=0), np.repeat(x[:, 2:], 20, axis=0), OPTIONS, 0)
    assert isinstance(found, Rejected)
