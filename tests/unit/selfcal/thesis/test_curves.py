"""Zero curves of thesis 5.8.3."""

import numpy as np
import pytest

from sfm_app.selfcal.constraints import center_polynomials, focal_polynomials
from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis.curves import center_curves, companion_roots, degeneracy, focal_curves, usable_curves
from sfm_app.types import CameraPairs


def in_widths(made):
    return prepare(CameraPairs.from_Fs(made.Fs, made.size, made.weights), unit_px=made.size[0], origin_px=(0.0, 0.0))


def thesis_curve(roots):
    """The thesis's choice, root by root."""
    curve = np.zeros(roots.shape[:2])
    for at in np.ndindex(curve.shape):
        real = [root for root in roots[at] if abs(root.real) > 1e-9]
        curve[at] = min(real, key=lambda root: abs(root.imag)).real if real else 0.0
    return curve


@pytest.mark.parametrize("noise", [1e-3, 0.1])
def test_curves_are_those_of_the_companion_matrices(views, noise):
    pairs, sweep = in_widths(views(6, noise=noise)), np.linspace(0.01, 1, 100)

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
    pairs, K = in_widths(made), made.K / 1000

    fy = focal_curves(pairs, K[0, 0] * np.array([0.5, 1.0, 1.5]), (K[0, 2], K[1, 2]))
    v = center_curves(pairs, K[0, 2] * np.array([0.5, 1.0, 1.5]), (K[0, 0], K[1, 1]))

    np.testing.assert_allclose(fy[:, 1], K[1, 1], rtol=1e-4)
    np.testing.assert_allclose(v[:, 1], K[1, 2], rtol=1e-4)
    assert np.ptp(fy[:, 0]) > 1e-3  # away from it the pairs differ
    assert np.ptp(v[:, 0]) > 1e-3


def test_noisy_curves_pass_close_by(views):
    made = views(5, noise=1e-3)
    pairs, K = in_widths(made), made.K / 1000
    fy = focal_curves(pairs, np.array([K[0, 0]]), (K[0, 2], K[1, 2]))[:, 0]
    assert 1e-5 < np.median(np.abs(fy - K[1, 1])) < 0.03


@pytest.mark.parametrize("motion", ["translation", "level"])
def test_degenerate_motions_lose_their_curves(views, motion):
    # level cameras say nothing about fy: the whole constraint scales with it
    pairs = in_widths(views(4, noise=0.0, motion=getattr(views, motion)))
    curves = focal_curves(pairs, np.linspace(0.03, 3, 50), (0.5, 0.375))
    assert np.all(degeneracy(curves, 3.0) > 0.5)
    assert len(usable_curves(curves, 3.0)) == 0


def test_degeneracy_is_the_share_out_of_range():
    curves = np.array([[1.0, 2, 3, 4], [0, 0, 1, 2], [-1, 0, 5, 1], [1, 1, 1, 1]])
    np.testing.assert_array_equal(degeneracy(curves, 3.0), [0.5, 0.5, 0.75, 0])
    np.testing.assert_array_equal(usable_curves(curves, 3.0), curves[[0, 1, 3]])


def test_no_pairs_no_curves():
    pairs = prepare(CameraPairs.from_Fs(np.empty((0, 3, 3)), (4, 3), []), unit_px=4.0, origin_px=(0.0, 0.0))
    assert focal_curves(pairs, np.ones(7), (0.5, 0.4)).shape == (0, 7)
    assert center_curves(pairs, np.ones(7), (1.0, 1.0)).shape == (0, 7)
    assert len(usable_curves(np.empty((0, 7)), 3.0)) == 0
