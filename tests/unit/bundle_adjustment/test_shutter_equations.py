"""Normal equations behind a rolling shutter, beside those written down in full."""

import numpy as np
import pytest

from sfm_app.bundle.normal_equations import POSE
from sfm_app.bundle.rolling_shutter import (
    ShutterBundle,
    add_points,
    apply_shutter_step,
    linearize,
    shutter_cost,
    solve_step,
)

SCALE_PX = 0.5


@pytest.fixture(scope="module")
def model(film):
    found = film(0.02, frames=9, swing_deg_s=60.0)
    rng = np.random.default_rng(4)
    velocity, offsets = rng.normal(scale=0.5, size=(9, 6)), rng.normal(scale=1e-3, size=(9, 6))
    return ShutterBundle(found.bundle, found.rows.share, 0.02, velocity, offsets)


def test_points_are_eliminated_as_by_dense_algebra():
    rng = np.random.default_rng(0)
    point, n = np.array([0, 0, 0, 1, 1, 1, 1]), 6
    columns = np.array([[0, 1, 5], [2, 3, 5], [0, 1, 5], [0, 1, 5], [2, 3, 5], [2, 3, 5], [0, 1, 5]])
    r, by_view, by_point = rng.normal(size=(7, 2)), rng.normal(size=(7, 2, 3)), rng.normal(size=(7, 2, 3))
    for one in range(2):
        Q = np.linalg.qr(by_point[point == one].reshape(-1, 3))[0]
        by_point[point == one] = Q.reshape(-1, 2, 3)
    J, Jp = np.zeros((14, n)), np.zeros((14, 6))
    for k in range(7):
        J[2 * k : 2 * k + 2, columns[k]] = by_view[k]
        Jp[2 * k : 2 * k + 2, 3 * point[k] : 3 * point[k] + 3] = by_point[k]
    half, g = np.zeros((n, n)), np.zeros(n)

    add_points((np.arange(7), np.array([0, 3, 7])), columns, r, by_view, by_point, half, g)

    left = np.eye(14) - Jp @ Jp.T
    assert half + half.T - np.diag(np.diag(half)) == pytest.approx(J.T @ left @ J)
    assert g == pytest.approx(J.T @ left @ r.ravel())


def test_steps_lead_to_where_only_the_noise_is_left(model):
    precision = np.zeros(model.unknowns)
    offsets = slice(POSE * 9, 2 * POSE * 9)
    precision[offsets], precision[offsets.stop :] = 1e3, 1e9
    before = shutter_cost(model, SCALE_PX)

    for _ in range(6):
        pull = np.zeros_like(precision)
        pull[offsets] = -precision[offsets] * model.offsets.ravel()
        step = solve_step(linearize(model, precision, pull, SCALE_PX, held=True))
        model = apply_shutter_step(model, step, 1.0)

    assert shutter_cost(model, SCALE_PX) < 0.1 * before
    assert 0.2 < step.noise_px < 0.35
    assert np.abs(step.views).max() < 1e-3


def test_a_known_readout_stays(model):
    nothing = np.zeros(model.unknowns)

    step = solve_step(linearize(model, nothing, nothing, SCALE_PX, held=True))

    assert step.views[-1] == 0.0 and step.deviation == 0.0
    assert apply_shutter_step(model, step, 1.0).readout == 0.02


def test_priors_hold_what_they_are_sure_of(model):
    precision = np.zeros(model.unknowns)
    offsets = slice(POSE * 9, 2 * POSE * 9)
    precision[offsets] = 1e12

    free = solve_step(linearize(model, 0.0 * precision, 0.0 * precision, SCALE_PX, held=False))
    held = solve_step(linearize(model, precision, 0.0 * precision, SCALE_PX, held=False))

    assert np.abs(free.views[offsets]).max() > 1e-4
    assert np.abs(held.views[offsets]).max() < 1e-6
    assert held.deviation < free.deviation
