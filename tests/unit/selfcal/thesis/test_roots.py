"""Roots of single polynomials and of sweeps of them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.selfcal.constraints import center_polynomials, focal_polynomials
from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis import curves as roots
from sfm_app.selfcal.thesis.curves import companion_roots, swept_roots
from sfm_app.types import CameraPairs


def off(found, expected):
    """Largest distance from a root to the nearest of the other set, as a share of its size."""
    apart = np.abs(found[..., :, None] - expected[..., None, :])
    sizes = np.abs(expected)
    return max(np.max(np.min(apart, axis=-2) / sizes), np.max(np.min(apart / sizes[..., None, :], axis=-1)))


@pytest.fixture
def to_eigenvalues(monkeypatch):
    """Counts the polynomials whose roots are found as eigenvalues."""
    counts = []

    def counted(coefficients):
        counts.append(coefficients[..., 0].size)
        return companion_roots(coefficients)

    monkeypatch.setattr(roots, "companion_roots", counted)
    return counts


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=4, max_size=8), st.floats(0.01, 100))
def test_companion_roots_are_roots(roots, lead):
    coefficients = lead * np.poly(roots)[::-1]
    found = companion_roots(coefficients[None])[0]
    assert found.shape == (len(roots),)
    # roots of high multiplicity are ill-conditioned, the polynomial built from what was found is not
    np.testing.assert_allclose(np.poly(found)[::-1], np.poly(roots)[::-1], atol=1e-6 * np.abs(np.poly(roots)).max())


def test_missing_powers_become_far_roots():
    found = companion_roots(np.array([[6.0, -5.0, 1.0, 0.0, 0.0]]))[0]
    near = np.sort(found[np.abs(found) < 1e3].real)
    np.testing.assert_allclose(near, [2, 3], rtol=1e-6)
    assert np.sum(np.abs(found) > 1e3) == 2


def test_a_vanishing_polynomial_collapses_to_zero():
    found = companion_roots(np.array([[0.0, 0, 0, 0, 0], [1, 0, 0, 0, 1]]))
    assert np.all(found[0] == 0)
    np.testing.assert_allclose(np.abs(found[1]), 1)


@pytest.mark.parametrize("noise", [1e-3, 0.1])
def test_swept_roots_are_the_companion_roots(views, noise, to_eigenvalues):
    made = views(6, noise=noise)
    pairs = prepare(CameraPairs.from_Fs(made.Fs, made.size, made.weights), unit_px=made.size[0], origin_px=(0.0, 0.0))
    sweep = np.linspace(0.01, 1, 100)
    for polynomials in (
        focal_polynomials(pairs, 3 * sweep, (0.5, 0.375)),
        center_polynomials(pairs, sweep, (1.0, 1.0)),
    ):
        found = swept_roots(polynomials)
        assert off(found, companion_roots(polynomials)) < 1e-7
        np.testing.assert_array_equal(found[3], swept_roots(polynomials[3:4])[0])
    # the first of every sweep and hardly any other
    assert 2 * len(pairs) <= sum(to_eigenvalues) < 3 * len(pairs)


def test_roots_meet_on_the_real_axis_and_leave_it(to_eigenvalues):
    # (x - 2)^2 = t and (x + 3)^2 = -t: one pair comes to the axis where the other leaves it
    t = np.linspace(-1, 1, 100)
    found = swept_roots(np.array([[np.poly1d([1, -4, 4 - s]) * np.poly1d([1, 6, 9 + s]) for s in t]])[..., ::-1])
    up, down = np.sqrt(t + 0j), np.sqrt(-t + 0j)
    assert off(found, np.stack([2 + up, 2 - up, -3 + down, -3 - down], axis=-1)[None]) < 1e-12
    assert sum(to_eigenvalues) < 10


def test_a_sweep_need_not_be_smooth():
    polynomials = np.random.default_rng(0).normal(size=(5, 40, 9))
    assert off(swept_roots(polynomials), companion_roots(polynomials)) < 1e-9


def test_double_roots_are_as_good_as_eigenvalues():
    t = np.linspace(0.5, 1.5, 30)
    polynomials = np.array([[np.poly([s, s, 2j, -2j])[::-1].real for s in t]])
    np.testing.assert_array_equal(np.sort(swept_roots(polynomials)), np.sort(companion_roots(polynomials)))


def test_vanishing_polynomials_are_passed_over(to_eigenvalues):
    polynomials = np.array([[[s, 0.0, 0.0, 0.0, 1.0] for s in np.linspace(1, 2, 20)]] * 2)
    polynomials[0, [0, 1, 7, 19]] = 0.0
    polynomials[1] = 0.0
    found = swept_roots(polynomials)
    vanished = np.all(polynomials == 0, axis=-1)
    assert np.all(found[vanished] == 0)
    np.testing.assert_allclose(np.abs(found[~vanished]) ** 4, np.repeat(polynomials[~vanished][:, :1], 4, axis=1))
    assert sum(to_eigenvalues) == 2
