"""RES-RANSAC's priors, by hand."""

import math

import numpy as np
import pytest

from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.scores import residual_validity, validity_from_residuals
from sfm_app.synthetic.correspondences import PairOptions, make_pair


def test_a_small_example():
    # median 100: bins of 1, the last one from 99 on. Histogram 1, 2 and 4, Gaussian of the rms of all errors
    residuals = np.array([0.5, 1.5, 1.8, 100.0, 200.0, 300.0, 1e3])
    last = 4 * math.exp(-(99.5**2) / (2 * np.mean(residuals**2)))
    first, second = (n * math.exp(-(q**2) / (2 * np.mean(residuals**2))) for n, q in ((1, 0.5), (2, 1.5)))
    total = first + second + last

    expected = [1 - first / total, *[1 - (first + second) / total] * 2, 0, 0, 0, 0]

    np.testing.assert_allclose(validity_from_residuals(residuals), expected, rtol=1e-12)
    assert 0.84 < expected[0] < 0.86


def test_units_do_not_matter_and_order_is_kept():
    residuals = np.abs(np.random.default_rng(0).normal(size=501))
    valid = validity_from_residuals(residuals)
    np.testing.assert_allclose(
        validity_from_residuals(1e-3 * residuals), valid, atol=0.01
    )  # a match may change its bin
    assert (np.diff(valid[np.argsort(residuals)]) <= 0).all()
    assert (valid == 0).sum() == pytest.approx(250, abs=5)


@pytest.mark.parametrize(
    ("residuals", "expected"),
    [
        ([0, 0, 0, 1], [1, 1, 1, 0]),
        ([2, 2, 2], [1, 1, 1]),
        ([1, 1, np.inf], [1, 1, 1]),
        ([1, np.inf, np.inf], [1, 0, 0]),
        ([1, 9, np.inf], None),
    ],
)
def test_residuals_that_tell_little_still_give_priors(residuals, expected):
    valid = validity_from_residuals(np.array(residuals, dtype=float))
    assert valid.max() > 0
    assert expected is None or valid.tolist() == expected


def test_the_true_model_puts_the_priors_on_inliers():
    pair = make_pair(PairOptions(points=400, outliers=0.4), 0)
    m = prepare(pair.x1, pair.x2, 0)
    F = np.diag([m.unit_px, m.unit_px, 1])
    shift1, shift2 = np.eye(3), np.eye(3)
    shift1[:2, 2], shift2[:2, 2] = m.center[:2], m.center[2:]
    f = (F.T @ shift2.T @ pair.F @ shift1 @ F).reshape(9)

    valid = residual_validity(m.points, f, 1.0)[m.rows]

    assert valid[pair.is_inlier].mean() > 5 * valid[~pair.is_inlier].mean()
    assert (valid > 0).mean() == pytest.approx(0.5, abs=0.02)
