"""Roots, zero curves, their meeting points, and Algorithm 4 (thesis 5.8)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis.curves import (
    center_curves,
    center_polynomials,
    companion_roots,
    degeneracy,
    focal_curves,
    focal_polynomials,
    usable_curves,
)
from sfm_app.selfcal.thesis.zero_curves import METHOD, calibrate, meeting_point, meeting_points
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPairs

OPTIONS, X = CalibrationSettings(), np.linspace(0, 1, 101)


def in_widths(Fs, size=(1000, 750)):
    return prepare(CameraPairs.from_Fs(Fs, size), unit_px=size[0], origin_px=(0.0, 0.0))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=4, max_size=8), st.floats(0.01, 100))
def test_companion_roots_are_roots(roots, lead):
    coefficients = lead * np.poly(roots)[::-1]
    found = companion_roots(coefficients[None])[0]
    assert found.shape == (len(roots),)
    # roots of high multiplicity are ill-conditioned, the polynomial built from what was found is not
    np.testing.assert_allclose(np.poly(found)[::-1], np.poly(roots)[::-1], atol=1e-6 * np.abs(np.poly(roots)).max())


def test_missing_powers_become_far_roots_and_vanishing_polynomials_zero():
    found = companion_roots(np.array([[6.0, -5.0, 1.0, 0.0, 0.0], [0, 0, 0, 0, 0], [1, 0, 0, 0, 1]]))
    near = np.sort(found[0][np.abs(found[0]) < 1e3].real)
    np.testing.assert_allclose(near, [2, 3], rtol=1e-6)
    assert np.sum(np.abs(found[0]) > 1e3) == 2
    assert np.all(found[1] == 0)
    np.testing.assert_allclose(np.abs(found[2]), 1)


def thesis_curve(roots):
    """The thesis's choice, root by root."""
    curve = np.zeros(roots.shape[:2])
    for at in np.ndindex(curve.shape):
        real = [root for root in roots[at] if abs(root.real) > 1e-9]
        curve[at] = min(real, key=lambda root: abs(root.imag)).real if real else 0.0
    return curve


@pytest.mark.parametrize("noise", [1e-3, 0.1])
def test_curves_are_those_of_the_companion_matrices(views, noise):
    pairs, sweep = in_widths(views(6, noise=noise).Fs), np.linspace(0.01, 1, 100)
    fy = focal_curves(pairs, 3 * sweep, (0.5, 0.375))
    v = center_curves(pairs, sweep, (1.0, 1.1))
    quartics, octics = focal_polynomials(pairs, 3 * sweep, (0.5, 0.375)), center_polynomials(pairs, sweep, (1.0, 1.1))
    roots = np.sqrt(companion_roots(quartics))
    roots[np.abs(roots.imag) > np.abs(roots.real)] = 0.0  # not "approximately zero"
    np.testing.assert_allclose(fy, thesis_curve(roots), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(v, thesis_curve(companion_roots(octics)), rtol=1e-9, atol=1e-12)
    assert np.ptp(fy) > 0.5
    assert np.ptp(v) > 0.5


@pytest.mark.parametrize("seed", range(5))
def test_exact_curves_run_through_the_true_camera(views, seed):
    made = views(4, seed, noise=0.0, focal=900, aspect=1.15)
    pairs, K = in_widths(made.Fs), made.K / 1000
    fy = focal_curves(pairs, K[0, 0] * np.array([0.5, 1.0, 1.5]), (K[0, 2], K[1, 2]))
    v = center_curves(pairs, K[0, 2] * np.array([0.5, 1.0, 1.5]), (K[0, 0], K[1, 1]))
    np.testing.assert_allclose(fy[:, 1], K[1, 1], rtol=1e-4)
    np.testing.assert_allclose(v[:, 1], K[1, 2], rtol=1e-4)
    assert np.ptp(fy[:, 0]) > 1e-3  # away from it the pairs differ
    assert np.ptp(v[:, 0]) > 1e-3


def test_noisy_curves_pass_close_by(views):
    made = views(5, noise=1e-3)
    pairs, K = in_widths(made.Fs), made.K / 1000
    fy = focal_curves(pairs, np.array([K[0, 0]]), (K[0, 2], K[1, 2]))[:, 0]
    assert 1e-5 < np.median(np.abs(fy - K[1, 1])) < 0.03


@pytest.mark.parametrize("motion", ["translation", "level"])
def test_degenerate_motions_lose_their_curves(views, motion):
    # level cameras say nothing about fy: the whole constraint scales with it
    pairs = in_widths(views(4, noise=0.0, motion=getattr(views, motion)).Fs)
    curves = focal_curves(pairs, np.linspace(0.03, 3, 50), (0.5, 0.375))
    assert np.all(degeneracy(curves, 3.0) > 0.5)
    assert len(usable_curves(curves, 3.0)) == 0


def test_degeneracy_is_the_share_out_of_range():
    curves = np.array([[1.0, 2, 3, 4], [0, 0, 1, 2], [-1, 0, 5, 1], [1, 1, 1, 1]])
    np.testing.assert_array_equal(degeneracy(curves, 3.0), [0.5, 0.5, 0.75, 0])
    np.testing.assert_array_equal(usable_curves(curves, 3.0), curves[[0, 1, 3]])


def lines_through(x0, y0, slopes):
    return np.array([y0 + slope * (X - x0) for slope in slopes])


def test_curves_meet_in_a_point_and_outlying_ones_do_not_pull():
    curves = lines_through(0.3, 1.0, [-1, -0.5, 0.4, 1.2])
    outlying = np.vstack([curves, np.full((3, 101), [[2.0], [2.5], [0.2]])])
    for found, low, high in (
        (meeting_point(curves, 3.0, 0.1), 0.999, 1.001),
        (meeting_point(outlying, 3.0, 0.05), 0.5, 0.6),  # three of six others
    ):
        assert X[found.sample] == pytest.approx(0.3)
        assert found.value == pytest.approx(1.0)
        assert low < found.support < high


def test_score_is_thesis_5_33_as_a_maximum():
    curves = np.random.default_rng(0).uniform(-0.5, 3.5, (6, 20))
    rho = np.exp(-np.abs(curves[:, None, :] - curves[None, :, :]) / 0.3).sum(axis=1) - 1
    allowed = np.where((curves > 0) & (curves < 3), rho, -1)
    k, j = np.unravel_index(np.argmax(allowed), allowed.shape)
    found = meeting_point(curves, 3.0, 0.3)
    assert (found.sample, found.value) == (j, curves[k, j])
    assert found.support == pytest.approx(rho[k, j] / 5)


def test_samples_out_of_range_are_no_answer():
    assert meeting_point(np.array([[0.0, -1, 3], [0, -1, 3]]), 3.0, 0.1) is None
    assert meeting_point(np.array([[0.0, -1, 2.9], [0, -1, 1]]), 3.0, 0.1).sample == 2


def test_there_are_as_many_peaks_as_cameras(views):
    for seed, focals in ((1, (700, 1500)), (2, (800, 1200)), (7, (800, 1200)), (6, (900, 2000))):
        Fs = np.concatenate([views(5, seed + 100 * i, noise=5e-4, focal=f).Fs for i, f in enumerate(focals)])
        found = focal_peaks(Fs)
        assert len(found) >= 2
        np.testing.assert_allclose(sorted(found[:2]), focals, rtol=0.05)
    for seed in (2, 3, 4):
        assert focal_peaks(views(5, seed, noise=5e-4, focal=1100).Fs) == [pytest.approx(1100, rel=0.05)]


def focal_peaks(Fs):
    """Focals sqrt(fx fy) in pixels, the best supported first."""
    pairs = in_widths(Fs)
    fx = 3 * np.arange(1, 201) / 200
    curves = usable_curves(focal_curves(pairs, fx, (0.5, 0.375)), 3.0)
    return [1000 * np.sqrt(fx[m.sample] * m.value) for m in meeting_points(curves, fx, (0.3, 3.0), 0.1)]


def test_peaks_are_apart_and_end_at_the_limits():
    sweep = np.linspace(0.1, 3, 30)
    at = [np.abs(sweep - place) for place in (0.2, 1.0, 1.1, 2.0)]
    near = np.minimum.reduce(at)
    # two curves that meet at 0.2, 1.0, 1.1 and 2.0, all at 1.5 or so
    curves = np.array([1.5 + 0 * sweep, 1.5 + near])
    found = meeting_points(curves, sweep, (0.3, 3.0), 0.05)
    assert [round(float(sweep[m.sample]), 1) for m in found] == [1.0, 2.0]
    assert all(m.support > 0.99 for m in found)


def run(made, options=OPTIONS, seed=0):
    return calibrate(CameraPairs.from_Fs(made.Fs, made.size, made.weights), options, seed)


@pytest.mark.parametrize("aspect", [0.8, 1.0, 1.2])
@pytest.mark.parametrize("seed", range(3))
def test_finds_the_camera_to_a_sample_of_the_sweep(views, aspect, seed):
    made = views(5, seed, noise=5e-4, aspect=aspect)
    found = run(made)
    assert found.identifiable, found.reason
    assert found.method == METHOD
    assert 0 < abs(found.K[0, 0] - made.K[0, 0]) < 61  # samples are 30 px apart
    assert abs(found.K[1, 1] - made.K[1, 1]) < 61
    assert np.abs(found.K[:2, 2] - made.K[:2, 2]).max() < 50
    assert 0.8 < found.evidence["focal_support"] < 1
    assert found.evidence["focal_curves"] <= found.evidence["pairs"] == 10


def test_two_cameras_have_two_peaks(views):
    fine = OPTIONS.model_copy(update={"samples": 200})
    one = run(views(5, 2, noise=5e-4, focal=1100), fine)
    pairs = [views(5, 1 + 100 * i, noise=5e-4, focal=focal) for i, focal in enumerate((700, 1500))]
    Fs = np.concatenate([made.Fs for made in pairs])
    several = calibrate(CameraPairs.from_Fs(Fs, pairs[0].size), fine, 0)
    assert one.evidence["focal_peaks"] == 1
    assert several.evidence["focal_peaks"] >= 2
