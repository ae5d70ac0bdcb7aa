"""Fisheye lenses of one exponent are the projections of the textbook."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.selfcal.wide_lens import Fisheye, bearings_through

THETA = np.linspace(0.0, 1.4, 8)


@pytest.mark.parametrize(
    ("exponent", "radius"),
    [
        (1.0, np.tan(THETA)),
        (0.5, 2 * np.tan(THETA / 2)),
        (0.0, THETA),
        (-0.5, 2 * np.sin(THETA / 2)),
        (-1.0, np.sin(THETA)),
    ],
)
def test_exponents_are_the_known_projections(exponent, radius):
    np.testing.assert_allclose(Fisheye(300.0, exponent).radius(THETA), 300.0 * radius)


@given(exponent=st.floats(-0.9, 1.0), theta=st.floats(0.0, 1.5), azimuth=st.floats(-3.0, 3.0))
def test_a_ray_comes_back(exponent, theta, azimuth):
    lens = Fisheye(0.4, exponent, (0.02, -0.01))
    ray = np.array([[np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)]])
    np.testing.assert_allclose(lens.rays(lens.project(ray)), ray, atol=1e-9)


def test_exponents_near_zero_are_no_step():
    radii = [Fisheye(1.0, e).radius(THETA) for e in (-1e-5, 0.0, 1e-5)]
    np.testing.assert_allclose(radii[0], radii[1], atol=1e-9)
    np.testing.assert_allclose(radii[2], radii[1], atol=1e-9)


def test_the_field_of_view_counts_both_sides():
    assert Fisheye(100.0, 0.0).field_deg(200.0 * np.pi / 2) == pytest.approx(180.0)
    assert Fisheye(100.0, 1.0).field_deg(200.0) == pytest.approx(90.0)


@pytest.mark.parametrize("exponent", [1.0, 0.3, 0.0, -0.5])
def test_slopes_are_those_of_the_rays(exponent):
    lens, points = Fisheye(0.45, exponent), np.array([[0.0, 0.0], [0.2, -0.1], [-0.4, 0.3]])
    rays, by_x, by_y = np.hsplit(bearings_through(lens, np.tile(points, 2))[:, 9:], 3)
    for slope, step in ((by_x, [1e-4, 0.0]), (by_y, [0.0, 1e-4])):
        np.testing.assert_allclose(rays + slope * 1e-4, lens.rays(points + step), atol=3e-7)
        np.testing.assert_allclose(np.einsum("ni,ni->n", rays, slope), 0.0, atol=1e-4)
