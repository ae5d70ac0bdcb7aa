"""The forms of the constraint, the Kruppa equations, and least squares on them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis.constraint_forms import (
    Halves,
    equations,
    essential,
    frobenius_form,
    huang_faugeras,
    huang_faugeras_equations,
    polynomial_form,
    trivedi,
)
from sfm_app.selfcal.thesis.kruppa import calibrate, kruppa_equations, kruppa_ratios, pair_focals
from sfm_app.selfcal.thesis.least_squares import find_minima, fit_camera
from sfm_app.selfcal.thesis.verdict import CameraParameters
from sfm_app.settings import CalibrationSettings
from sfm_app.types import CameraPairs

FORMS = {"(5.8)": huang_faugeras, "(5.9)": frobenius_form, "(5.11)": trivedi, "(5.25)": polynomial_form}
seeds = st.integers(0, 2**32 - 1)


def in_widths(Fs, size=(1000, 750)):
    return prepare(CameraPairs.from_Fs(Fs, size), unit_px=size[0], origin_px=(0.0, 0.0))


def random_rank_two(seed):
    U, s, Vt = np.linalg.svd(np.random.default_rng(seed).normal(size=(3, 3)))
    return (U[:, :2] * s[:2]) @ Vt[:2]


@pytest.fixture(params=FORMS)
def form(request):
    return FORMS[request.param]


def test_it_vanishes_at_the_true_camera_and_at_no_other(views, form):
    made = views(4, noise=0.0, focal=900, aspect=1.2, center=(420, 400))
    other = made.K.copy()
    other[0, 0] *= 1.2
    moved = made.K.copy()
    moved[0, 2] += 150
    assert np.abs(form(essential(made.Fs, made.K))).max() < 1e-6
    for wrong in (other, moved):
        assert np.abs(form(essential(made.Fs, wrong))).reshape(6, -1).max(axis=1).min() > 1e-5


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_all_forms_are_functions_of_the_singular_values(seed):
    E = random_rank_two(seed)
    s1, s2, _ = np.linalg.svd(E, compute_uv=False)
    d = (s1**2 - s2**2) / (s1**2 + s2**2)
    assert huang_faugeras(E) == pytest.approx((s1 - s2) / s2)
    assert np.linalg.norm(frobenius_form(E)) == pytest.approx(d, abs=1e-9)
    assert polynomial_form(E)[0] == pytest.approx(d**2, abs=1e-9)
    assert np.sum(trivedi(E)) == pytest.approx(d**2, abs=1e-9)


def test_trivedi_does_not_hold_with_i_equal_to_j(views):
    # the term for i = j, which (5.11) does not exclude, at the camera itself
    made = views(2, noise=0.0)
    E = essential(made.Fs, made.K)[0]
    S = E @ E.T / np.trace(E @ E.T)
    assert np.abs(4 * np.diag(S) ** 2 - (1 - 2 * np.diag(S)) ** 2).max() > 0.1
    assert np.abs(trivedi(E)).max() < 1e-9


def test_rank_one_is_infinitely_far():
    assert huang_faugeras(np.diag([2.0, 0.0, 0.0])) == np.inf


def halves_of(Fs):
    pairs = in_widths(Fs, (1, 1))
    return pairs, Halves.from_fundamentals(pairs.F)


@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(0.2, 5), st.floats(0.2, 5), st.floats(-1, 1), st.floats(-1, 1))
def test_two_equations_have_the_norm_of_the_ratio(seed, fx, fy, u, v):
    pairs, halves = halves_of(random_rank_two(seed)[None])
    s = np.linalg.svd(essential(pairs.F, np.array([[fx, 0, u], [0, fy, v], [0, 0, 1]])), compute_uv=False)[0]
    camera = np.array([fx, fy, u, v])
    assert np.linalg.norm(equations(halves, camera)) == pytest.approx((s[0] - s[1]) / (s[0] + s[1]), abs=1e-7)
    size = np.linalg.norm(huang_faugeras_equations(halves, camera))
    assert size == pytest.approx(min((s[0] - s[1]) / s[1], 2e6), rel=1e-3, abs=1e-6)


def test_the_equations_change_sign_where_the_constraint_only_touches_zero(views):
    made = views(2, noise=0.0)
    _, halves = halves_of(made.Fs)
    fx, fy, u, v = made.K[0, 0], made.K[1, 1], made.K[0, 2], made.K[1, 2]
    before, after = (equations(halves, np.array([f * fx, f * fy, u, v]))[0] for f in (0.99, 1.01))
    assert np.linalg.norm(before) > 1e-5
    np.testing.assert_allclose(before, -after, rtol=0.1, atol=1e-6)


OPTIONS = CalibrationSettings()


def camera_of(K, factor=1.0):
    return np.array([factor * K[0, 0], factor * K[1, 1], K[0, 2], K[1, 2]]) / 1000


def test_true_cameras_satisfy_5_5_and_the_equations(views):
    made = views(4, noise=0.0, focal=900, aspect=1.1, center=(450, 400))
    pairs = in_widths(made.Fs)
    C = (made.K / [[1000], [1000], [1]]) @ (made.K / [[1000], [1000], [1]]).T
    for F, e2 in zip(pairs.F, pairs.e2, strict=True):
        cross = np.cross(np.eye(3), e2)
        left, right = cross @ C @ cross.T, F @ C @ F.T
        np.testing.assert_allclose(left / np.linalg.norm(left), right / np.linalg.norm(right), atol=1e-9)
    halves = Halves.from_fundamentals(pairs.F)
    assert np.abs(kruppa_equations(halves, camera_of(made.K))).max() < 1e-9
    ratios = kruppa_ratios(halves, camera_of(made.K))
    np.testing.assert_allclose(ratios[:, [1, 2]], ratios[:, [0, 0]], rtol=1e-6)


def test_other_cameras_do_not(views):
    made = views(4, noise=0.0)
    errors = np.linalg.norm(
        kruppa_equations(Halves.from_fundamentals(in_widths(made.Fs).F), camera_of(made.K, 1.2)), axis=-1
    )
    assert errors.min() > 1e-3
    assert errors.max() <= 1


@pytest.mark.parametrize("focal", [400.0, 1000.0, 2500.0])  # 1000 px is the width: f = 1 is a trivial root
def test_the_focal_of_an_exact_pair_is_the_true_one(views, focal):
    made = views(5, seed=3, noise=0.0, focal=focal, center=(520, 340))
    np.testing.assert_allclose(pair_focals(in_widths(made.Fs), (0.52, 0.34)), focal / 1000, rtol=1e-6)


def test_noise_moves_the_focal_a_little(views):
    made = views(6, seed=1, noise=1e-3)
    focals = pair_focals(in_widths(made.Fs), (0.5, 0.375))
    assert 1e-4 < abs(np.nanmedian(focals) - 1) < 0.05


def test_a_focal_is_found_where_the_linear_equations_fail(views):
    # level cameras: all optical axes in one plane, only the quadratic equation is left
    made = views(5, seed=2, noise=0.0, motion=views.level)
    focals = pair_focals(in_widths(made.Fs), (0.5, 0.375))
    np.testing.assert_allclose(focals[np.isfinite(focals)], 1.0, rtol=1e-5)
    assert np.count_nonzero(np.isfinite(focals)) >= 8


@pytest.mark.parametrize("motion", ["orbit", "translation"])
def test_pairs_without_a_focal_give_none(views, motion):
    made = views(5, noise=0.0, motion=getattr(views, motion))
    assert np.all(np.isnan(pair_focals(in_widths(made.Fs), (0.5, 0.375))))


def test_without_any_focal_of_its_own_it_starts_from_the_usual_one(views):
    made = views(5, noise=0.0, motion=views.orbit)
    found = calibrate(CameraPairs.from_Fs(made.Fs, made.size), OPTIONS, 0)
    assert not found.identifiable
    assert found.evidence["focal_estimates"] == 0


def truth(made):
    return np.array([made.K[0, 0], made.K[1, 1], made.K[0, 2], made.K[1, 2]]) / made.size[0]


@pytest.mark.parametrize("count", [3, 6])
def test_exact_pairs_lead_to_the_exact_camera(views, count):
    made = views(count, seed=1, noise=0.0, focal=1200, aspect=0.9, center=(560, 330))
    found = fit_camera(in_widths(made.Fs), CameraParameters.initial(0.75), np.ones(count * (count - 1) // 2))
    np.testing.assert_allclose(found, truth(made), atol=1e-5)


def test_it_stops_where_scipy_does(views):
    made = views(6, seed=2, noise=5e-3)
    pairs, weights = in_widths(made.Fs), np.linspace(0.1, 1, 15)
    halves = Halves.from_fundamentals(pairs.F)

    def residuals(camera):
        return (np.sqrt(weights)[:, None] * huang_faugeras_equations(halves, camera)).ravel()

    expected = least_squares(residuals, [1.0, 1.0, 0.5, 0.375], method="lm", xtol=1e-12, ftol=1e-12)
    found = fit_camera(pairs, CameraParameters.initial(0.75), weights)
    np.testing.assert_allclose(found, expected.x, atol=1e-4)
    assert np.abs(np.array(found) - truth(made)).max() > 1e-3


def test_searches_side_by_side_are_as_if_alone(views):
    pairs = in_widths(views(5, noise=2e-3).Fs)
    halves, rng = Halves.from_fundamentals(pairs.F), np.random.default_rng(0)
    triples = np.array([[0, 1, 2], [3, 5, 9], [2, 4, 8], [1, 6, 7]])
    starts = np.column_stack([rng.uniform(0.5, 2, (4, 2)), rng.uniform(0.3, 0.6, (4, 2))])
    together = find_minima(halves[triples], np.ones((4, 3)), starts)
    for i in range(4):
        alone = find_minima(halves[triples[i : i + 1]], np.ones((1, 3)), starts[i : i + 1])
        np.testing.assert_allclose(together.cameras[i], alone.cameras[0], rtol=1e-6)
        assert together.sums[i] == pytest.approx(alone.sums[0], rel=1e-6)


def test_where_nothing_depends_on_the_camera_it_stays(views):
    pairs = in_widths(views(4, noise=0.0, motion=views.translation).Fs)
    np.testing.assert_allclose(
        fit_camera(pairs, CameraParameters.initial(0.75), np.ones(6)), [1, 1, 0.5, 0.375], atol=1e-6
    )


def test_it_never_ends_above_its_start(views, random_fundamentals):
    Fs = random_fundamentals(12, 4)
    pairs = in_widths(Fs)
    start = CameraParameters.initial(0.75)
    end = fit_camera(pairs, start, np.ones(12))
    sums = [
        np.sum(huang_faugeras_equations(Halves.from_fundamentals(pairs.F), np.array(camera)) ** 2)
        for camera in (start, end)
    ]
    assert sums[1] < sums[0]
    assert np.all(np.isfinite(end))
    assert min(end[:2]) > 0
