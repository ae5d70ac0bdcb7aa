"""One set of tests for every registered estimator, ours and any plug-in's."""

import itertools
import pickle
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from sfm_app.geometry.epipolar import sampson_distance
from sfm_app.plugins import load_plugins
from sfm_app.settings import EpipolarSettings
from sfm_app.synthetic.correspondences import PairOptions, make_pair, random_rotation
from sfm_app.types import EpipolarFit, Rejected

ESTIMATORS = load_plugins().estimators
UNREFINED = {"opencv-ransac"}
"""They return the F of seven matches: twice the noise, and some true matches beyond the threshold."""
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
def name(request):
    return request.param


@pytest.fixture
def fit(name):
    return ESTIMATORS[name].fit


@pytest.fixture
def accuracy_px(name):
    """How far exact matches may lie from F, by their median, on an easy pair."""
    return 0.8 if name in UNREFINED else 0.4


def options(**values):
    return OPTIONS.model_copy(update=values)


def mapped(H, x):
    h = np.column_stack([x, np.ones(len(x))]) @ H.T
    return h[:, :2] / h[:, 2:]


def homography_pair(kind, seed, sigma_px):
    """400 matches that one homography explains: of a camera that only turned, or of a plane."""
    rng = np.random.default_rng([seed, 77])
    K = np.array([[900.0, 0, 512], [0, 900, 384], [0, 0, 1]])
    x1 = rng.uniform((0, 0), (1024, 768), (4000, 2))
    while True:
        R, t, n = random_rotation(rng, 30.0), rng.normal(0, 0.4, 3), rng.normal((0, 0, -1), 0.4)
        x2 = mapped(K @ (R if kind == "rotation" else R - np.outer(t, n)) @ np.linalg.inv(K), x1)
        seen = np.flatnonzero(((x2 > 0) & (x2 < (1024, 768))).all(axis=1))[:400]
        if len(seen) == 400:
            return x1[seen] + rng.normal(0, sigma_px, (400, 2)), x2[seen] + rng.normal(0, sigma_px, (400, 2))


def is_well_formed(found, count):
    assert isinstance(found, EpipolarFit) and found.F.shape == (3, 3)
    assert np.linalg.norm(found.F) == pytest.approx(1) and np.linalg.svd(found.F, compute_uv=False)[2] < 1e-12
    assert (found.inliers.shape, found.inliers.dtype) == ((count,), np.bool_)
    assert found.priors.shape == (count,) and found.priors.min() >= 0 and found.priors.max() == 1
    assert found.trials >= 1 and found.degeneracy in ("", "collinear", "planar", "rotation")
    return True


@pytest.mark.parametrize("outliers", [0.0, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_finds_the_truth_and_the_injected_noise(name, fit, accuracy_px, outliers, seed):
    pair = make_pair(PairOptions(outliers=outliers, **SCENE), seed)
    found = fit(pair.x1, pair.x2, OPTIONS, seed)
    assert is_well_formed(found, 400)
    noise = np.sqrt(np.mean(sampson_distance(found.F, pair.x1, pair.x2)[pair.is_inlier] ** 2))
    rough = name in UNREFINED
    assert 0.40 < noise < (1.3 if rough else 0.65)
    assert 0 < np.median(sampson_distance(found.F, pair.exact_x1, pair.exact_x2)) < accuracy_px
    assert found.inliers[pair.is_inlier].mean() > (0.85 if rough else 0.95)
    assert found.inliers[~pair.is_inlier].sum() < 0.1 * 400 and found.degeneracy == ""


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
    if case == "on a line in both views" and found:  # they do support an F, one of many
        assert found.degeneracy == "collinear"
        return
    assert isinstance(found, Rejected), found
    assert 0 < len(found.reason) < 60


def with_value(value):
    return np.where(np.arange(200).reshape(100, 2) == 7, value, CLOUD)


REFUSED = [
    *((with_value(value), "not finite") for value in (np.nan, np.inf, -np.inf)),
    *((with_value(value), "must lie within") for value in (1e16, -1e300)),
    *((x, "shape|pair up") for x in (CLOUD[:, 0], CLOUD.T, np.ones((100, 3)), CLOUD[:50], CLOUD[..., None])),
    *((x, "shape|pair up") for x in ([[1.0, 2.0], [3.0]] * 50, 3.0, None)),
    *((np.zeros((100, 2), kind), "real numbers") for kind in (bool, complex, object, str, "datetime64[s]")),
]


@pytest.mark.parametrize(("bad", "message"), REFUSED)
def test_invalid_points_are_refused(fit, bad, message):
    for views in ((bad, CLOUD), (CLOUD, bad)):
        with pytest.raises(ValueError, match=message):
            fit(*views, OPTIONS, 0)


def test_any_integer_is_a_seed(fit):
    pair = make_pair(PairOptions(**SCENE), 3)
    for seed in (-1, 2**70):
        found, same = (fit(pair.x1, pair.x2, OPTIONS, one) for one in (seed, seed % 2**64))
        assert pickle.dumps(found) == pickle.dumps(same)


@pytest.mark.parametrize("count", [8, 16, 20])
def test_few_exact_matches_give_an_answer_or_a_reason(fit, count):
    pair = make_pair(PairOptions(**{**SCENE, "points": count, "sigma_px": 0.0}), 2)
    found = fit(pair.x1, pair.x2, options(min_inliers=8), 0)
    assert isinstance(found, Rejected) or (found.inliers.all() and found.rms_px < 1e-3)
    assert count < 16 or isinstance(found, EpipolarFit)


def test_fewest_inliers_are_a_setting(fit):
    pair = make_pair(PairOptions(**SCENE), 1)
    assert fit(pair.x1, pair.x2, options(min_inliers=380), 0)
    assert not fit(pair.x1, pair.x2, options(min_inliers=401), 0)


def test_layout_and_type_of_the_arrays_do_not_matter(fit):
    pair = make_pair(PairOptions(outliers=0.2, **SCENE), 4)
    x1, x2 = np.rint(pair.x1), np.rint(pair.x2)
    before = x1.copy(), x2.copy()
    expected = pickle.dumps(fit(x1, x2, OPTIONS, 0))
    assert np.array_equal(x1, before[0]) and np.array_equal(x2, before[1])

    padded = np.zeros((800, 3))
    padded[::2, :2] = x1
    backwards = np.ascontiguousarray(x1[::-1])[::-1]
    locked = x1.copy()
    locked.flags.writeable = False
    views = {
        "integers": (x1.astype(np.int32), x2.astype(np.int64)),
        "small floats": (x1.astype(np.float32), x2.astype(np.float16)),
        "other byte order": (x1.astype(">f8"), x2.astype(">i4")),
        "Fortran order": (np.asfortranarray(x1), np.asfortranarray(x2)),
        "strided": (padded[::2, :2], x2),
        "reversed": (backwards, x2),
        "read-only": (locked, x2),
        "lists": (x1.tolist(), x2.tolist()),
    }
    for view, (a, b) in views.items():
        assert pickle.dumps(fit(a, b, OPTIONS, 0)) == expected, view


def test_runs_in_threads_give_the_same_bytes_which_cross_process_borders(fit):
    pair = make_pair(PairOptions(outliers=0.3, **SCENE), 8)
    matches = np.stack([pair.x1, pair.x2])
    with ThreadPoolExecutor(4) as pool:
        runs = list(pool.map(lambda _: pickle.dumps(fit(pair.x1, pair.x2, OPTIONS, 3)), range(6)))
    assert len(set(runs)) == 1
    np.testing.assert_array_equal(np.stack([pair.x1, pair.x2]), matches)  # the input is left alone
    for found in (fit(pair.x1, pair.x2, OPTIONS, 3), fit(CLOUD[:5], CLOUD[:5], OPTIONS, 0)):
        copy = pickle.loads(pickle.dumps(found))  # noqa: S301 - our own bytes
        assert type(copy) is type(found) and bool(copy) == bool(found)
    again = pickle.loads(pickle.dumps(fit))  # noqa: S301
    assert pickle.dumps(again(pair.x1, pair.x2, OPTIONS, 3)) == runs[0]


def test_a_repeated_match_counts_once_and_gets_one_verdict(fit):
    pair = make_pair(PairOptions(outliers=0.3, **SCENE), 3)
    once = fit(pair.x1, pair.x2, OPTIONS, 0)
    thrice = fit(np.tile(pair.x1, (3, 1)), np.tile(pair.x2, (3, 1)), OPTIONS, 0)
    np.testing.assert_array_equal(thrice.inliers, np.tile(thrice.inliers[:400], 3))
    np.testing.assert_array_equal(thrice.priors, np.tile(thrice.priors[:400], 3))
    assert np.mean(thrice.inliers[:400] == once.inliers) > 0.9


@pytest.mark.parametrize("seed", range(3))
def test_twenty_noisy_matches_are_enough(name, fit, seed):
    pair = make_pair(PairOptions(**{**SCENE, "points": 20}), seed)
    found = fit(pair.x1, pair.x2, OPTIONS, 0)
    if name != "lev-ransac" and not found:  # what the others may miss, ours does not
        return
    assert is_well_formed(found, 20)
    assert 0 < np.median(sampson_distance(found.F, pair.exact_x1, pair.exact_x2)) < 1.0


def test_ten_thousand_matches(fit, accuracy_px):
    pair = make_pair(PairOptions(outliers=0.3, **{**SCENE, "points": 10_000}), 3)
    found = fit(pair.x1, pair.x2, OPTIONS, 0)
    assert is_well_formed(found, 10_000)
    assert 0 < np.median(sampson_distance(found.F, pair.exact_x1, pair.exact_x2)) < accuracy_px
    assert found.inliers[pair.is_inlier].mean() > 0.9 and found.inliers[~pair.is_inlier].mean() < 0.05


def peak_bytes():
    """Most memory that this process ever held since `clear_refs` was last written, of any library."""
    return 1024 * int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text()).group(1))


@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux can reset its count of peak memory")
def test_memory_is_linear_in_the_matches(fit):
    few, many = (make_pair(PairOptions(outliers=0.1, **{**SCENE, "points": count}), 0) for count in (100, 20_000))
    fit(few.x1, few.x2, options(max_trials=100), 0)  # loads and compiles
    Path("/proc/self/clear_refs").write_text("5")
    before = peak_bytes()
    assert fit(many.x1, many.x2, options(max_trials=100), 0)
    # one byte per pair of matches would be 400 MB
    assert peak_bytes() - before < 20_000 * 5000


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_exact_matches_give_the_exact_answer(fit, outliers):
    pair = make_pair(PairOptions(outliers=outliers, **{**SCENE, "sigma_px": 0.0}), 3)
    found = fit(pair.x1, pair.x2, OPTIONS, 0)
    assert is_well_formed(found, 400) and found.inliers[pair.is_inlier].all()
    distance = sampson_distance(found.F, pair.x1, pair.x2)
    assert distance[pair.is_inlier].max() < 1e-2  # OpenCV computes in single precision


@pytest.mark.parametrize(("scale", "shift"), [(0.1, 0.0), (10.0, 0.0), (1.0, 1e6)])
def test_tiny_huge_and_distant_images(fit, accuracy_px, scale, shift):
    pair = make_pair(PairOptions(outliers=0.3, **SCENE), 3)
    found = fit(pair.x1 * scale + shift, pair.x2 * scale - shift, options(max_error_px=2.0 * scale), 0)
    assert is_well_formed(found, 400)
    error = np.median(sampson_distance(found.F, pair.exact_x1 * scale + shift, pair.exact_x2 * scale - shift))
    assert 0 < error < accuracy_px * scale and found.inliers[pair.is_inlier].mean() > 0.85
    assert found.inliers[~pair.is_inlier].mean() < 0.1


def test_one_match_far_away_is_an_outlier(fit):
    pair = make_pair(PairOptions(outliers=0.1, **SCENE), 3)
    pair.x1[0], pair.x2[1] = (1e5, 0.0), (0.0, -1e5)
    found = fit(pair.x1, pair.x2, OPTIONS, 0)
    assert found.inliers[2:][pair.is_inlier[2:]].mean() > 0.85 and not found.inliers[:2].any()


def test_absurd_matches_do_not_hide_the_scene():
    pair = make_pair(PairOptions(outliers=0.3, **SCENE), 3)
    kept = pair.is_inlier.copy()
    kept[:3] = False
    pair.x1[0], pair.x2[1], pair.x1[2] = (1e10, 0.0), (0.0, -1e12), (-1e15, 1e15)
    found = ESTIMATORS["lev-ransac"].fit(pair.x1, pair.x2, OPTIONS, 0)
    assert found.inliers[kept].mean() > 0.97 and not found.inliers[:3].any()
    assert found.degeneracy == ""
    assert 0 < np.median(sampson_distance(found.F, pair.exact_x1, pair.exact_x2)) < 0.2


def test_exchanged_views_give_the_transpose(name, fit, accuracy_px):
    pair = make_pair(PairOptions(outliers=0.2, **SCENE), 3)
    there, back = fit(pair.x1, pair.x2, OPTIONS, 0), fit(pair.x2, pair.x1, OPTIONS, 0)
    assert np.mean(there.inliers == back.inliers) > (0.85 if name in UNREFINED else 0.98)
    assert np.median(sampson_distance(back.F.T, pair.exact_x1, pair.exact_x2)) < accuracy_px


@pytest.mark.parametrize("move", [(0.0, 0.0), (5.0, 3.0)])
def test_equal_views_are_no_epipolar_geometry(fit, move):
    found = fit(CLOUD, CLOUD + move, OPTIONS, 0)
    assert isinstance(found, Rejected) or found.degeneracy == "rotation"


@pytest.mark.parametrize("sigma_px", [0.0, 0.5])
@pytest.mark.parametrize("kind", ["rotation", "planar"])
@pytest.mark.parametrize("seed", range(5))
def test_matches_of_one_homography_are_flagged(fit, kind, sigma_px, seed):
    found = fit(*homography_pair(kind, seed, sigma_px), OPTIONS, seed)
    assert found.degeneracy == kind if found else sigma_px == 0


def test_a_plane_among_outliers_is_flagged(fit):
    x1, x2 = homography_pair("planar", 5, 0.5)
    x2[:120] += np.random.default_rng(0).uniform(-256, 256, (120, 2))
    assert fit(x1, x2, OPTIONS, 0).degeneracy == "planar"


@pytest.mark.parametrize("values", [{}, {"min_inliers": 8, "max_error_px": 50.0}, {"min_inliers": 8, "max_trials": 1}])
@pytest.mark.parametrize("seed", range(3))
def test_noise_is_rejected(fit, values, seed):
    rng = np.random.default_rng([seed, 300])
    found = fit(rng.uniform(0, 1000, (300, 2)), rng.uniform(0, 1000, (300, 2)), options(**values), seed)
    assert isinstance(found, Rejected)


EDGES = {"min_inliers": (8, 10_000), "max_trials": (1, 10), "confidence": (0.5, 0.999999), "max_error_px": (0.1, 50.0)}


@pytest.mark.parametrize("edge", [(key, value) for key, values in EDGES.items() for value in values], ids=str)
def test_options_at_their_edges(fit, accuracy_px, edge):
    pair = make_pair(PairOptions(outliers=0.3, **SCENE), 3)
    changed = options(**dict([edge]))

    found = fit(pair.x1, pair.x2, changed, 0)

    if edge[0] == "confidence" or edge == ("min_inliers", 8):
        assert isinstance(found, EpipolarFit)
    if found:
        assert is_well_formed(found, 400)
        assert found.inlier_count >= changed.min_inliers and found.trials <= changed.max_trials
        assert found.rms_px <= changed.max_error_px
        error = np.median(sampson_distance(found.F, pair.exact_x1, pair.exact_x2))
        # one sample is rarely clean, and what it gives is then only better than chance
        rough_px = 25.0 if edge == ("max_trials", 1) else 0.2 * changed.max_error_px
        assert error < max(5 * accuracy_px, rough_px)


def awkward_matches(rng):
    """Few matches, rounded, repeated, partly on lines, partly of one homography: what falls out of small photos."""
    count, step = int(rng.integers(0, 60)), float(rng.choice([1e-6, 1.0, 50.0, 400.0]))
    x1 = np.rint(rng.uniform(0, 1000, (count, 2)) / step) * step
    x2 = np.rint((x1 + rng.normal(0, rng.choice([0.0, 1.0, 300.0]), (count, 2))) / step) * step
    same = rng.random(count) < rng.choice([0.0, 0.5, 0.95])
    x1[same, 1] = x1[same, 0] * rng.choice([0.0, 1.0])
    x2[rng.random(count) < rng.choice([0.0, 0.5])] = 0.0
    return x1, x2


def test_awkward_matches_give_a_sound_answer_or_a_reason(fit):
    for seed, least in itertools.product(range(40), (8, 16)):
        x1, x2 = awkward_matches(np.random.default_rng([seed, 60]))
        found = fit(x1, x2, options(min_inliers=least, max_trials=100), seed)
        if found:
            assert is_well_formed(found, len(x1)), seed
            assert found.inlier_count >= least
        else:
            assert found.reason, seed
