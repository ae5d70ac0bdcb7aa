"""The forms of the Huang-Faugeras constraint, on exact cameras and on matrices without one."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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
from sfm_app.types import CameraPairs

FORMS = {
    "(5.8)": huang_faugeras,
    "(5.9)": frobenius_form,
    "(5.11)": trivedi,
    "(5.25)": polynomial_form,
}
seeds = st.integers(0, 2**32 - 1)


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


def test_the_scale_of_f_has_no_effect(views, form):
    made = views(3, noise=0.01)
    scales = np.array([1e-6, -3.0, 1e8])[:, None, None]
    np.testing.assert_allclose(
        np.abs(form(essential(made.Fs * scales, made.K))),
        np.abs(form(essential(made.Fs, made.K))),
        rtol=1e-6,
        atol=1e-12,
    )


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
    pairs = prepare(CameraPairs.from_Fs(Fs, (1, 1)), unit_px=1.0, origin_px=(0.0, 0.0))
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


def test_halves_are_indexed_like_arrays():
    _, halves = halves_of(np.array([random_rank_two(seed) for seed in range(4)]))
    triples = halves[np.array([[0, 1, 2], [3, 1, 0]])]
    assert (triples.U.shape, triples.V.shape, triples.s.shape) == ((2, 3, 2, 3), (2, 3, 2, 3), (2, 3, 2))
    np.testing.assert_array_equal(triples.U[1, 0], halves.U[3])
