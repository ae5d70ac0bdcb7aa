"""Perspective views show every ray of a wide photo, in few views."""

import numpy as np
import pytest

from sfm_app.camera.models import camera_matrix
from sfm_app.camera.perspective_views import OPTIONS, PerspectiveView, center_view, cover_rays


def cone(across_deg, down_deg, count=161):
    """Unit vectors of an equidistant lens over a rectangle of the photo."""
    x, y = np.meshgrid(*(np.radians(np.linspace(-0.5, 0.5, count) * side) for side in (across_deg, down_deg)))
    theta = np.hypot(x, y)
    bend = np.sinc(theta / np.pi)
    rays = np.stack([bend * x, bend * y, np.cos(theta)], -1).reshape(-1, 3)
    return rays[rays[:, 2] > 0.0]


def sphere(count=4000):
    rays = np.random.default_rng(0).normal(size=(count, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def shown(view, rays, margin_px=0.0):
    seen = rays @ view.R.T @ view.K.T
    with np.errstate(divide="ignore", invalid="ignore"):
        x = seen[:, :2] / seen[:, 2:]
    low, high = -margin_px, np.array([view.width, view.height]) + margin_px
    return (seen[:, 2] > 0.0) & np.all((x >= low) & (x <= high), axis=1)


@pytest.mark.parametrize(
    ("rays", "count"),
    [
        (cone(60, 45), 1),
        (cone(80, 50), 1),
        (cone(100, 60), 2),
        (cone(120, 80), 2),
        (cone(150, 100), 4),
        (cone(175, 131), 4),
        (sphere(), 6),
    ],
    ids=["60", "80", "100", "120", "150", "175", "all round"],
)
def test_every_ray_is_in_one_of_few_views(rays, count):
    views = cover_rays(rays, 200.0, 10_000)
    assert len(views) == count
    # views are as large as whole pixels
    assert np.any([shown(view, rays, 1.0) for view in views], axis=0).all()
    half = np.radians(0.5 * OPTIONS.most_field_deg + OPTIONS.overlap_deg)
    for view in views:
        np.testing.assert_allclose(view.R @ view.R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(view.R) == pytest.approx(1.0) and view.K[0, 0] == view.K[1, 1] == 200.0
        assert max(view.width, view.height) < 2.0 * 200.0 * np.tan(half) * 1.35  # corners of a part reach farther


def test_large_views_are_scaled_down():
    (view,) = cover_rays(cone(60, 45), 2000.0, 500)
    assert max(view.width, view.height) == 500
    assert 300.0 < view.K[0, 0] < 500.0 / (2.0 * np.tan(np.radians(30.0)))


def test_rays_are_those_of_pixel_centers():
    view = cover_rays(cone(120, 80), 150.0, 1000)[1]
    rays = view.rays()
    assert rays.shape == (view.height, view.width, 3)
    seen = rays[7, 11] @ view.R.T @ view.K.T
    np.testing.assert_allclose(seen[:2] / seen[2], [11.5, 7.5], atol=1e-9)


def test_views_next_to_each_other_overlap():
    rays = cone(120, 80)
    left, right = cover_rays(rays, 200.0, 1000)
    middle = np.column_stack([np.sin(t := np.radians(np.linspace(-3.0, 3.0, 9))), np.zeros(9), np.cos(t)])
    assert shown(left, middle).all() and shown(right, middle).all()
    aside = np.array([[np.sin(np.radians(20.0)), 0.0, np.cos(np.radians(20.0))]])
    assert shown(left, aside).tolist() == [False] and shown(right, aside).tolist() == [True]


@pytest.mark.parametrize("center", [(500.0, 400.0), (540.0, 380.0), (700.0, 250.0), (100.0, 700.0)])
def test_a_centered_view_shows_nothing_else_and_as_much_as_it_can(center):
    tilt = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    view = PerspectiveView(tilt * np.linalg.det(tilt), camera_matrix(900.0, 880.0, *center), 1000, 800)

    found = center_view(view)

    fx, fy, cx, cy = found.K[0, 0], found.K[1, 1], found.K[0, 2], found.K[1, 2]
    assert (fx, cx, cy) == (fy, found.width / 2, found.height / 2)
    np.testing.assert_allclose(found.R @ found.R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found.R) == pytest.approx(1.0)
    inside = shown(view, found.rays().reshape(-1, 3), margin_px=1e-6)
    assert inside.all()
    larger = PerspectiveView(found.R, camera_matrix(fx, fx, cx + 2, cy + 2), found.width + 4, found.height + 4)
    assert not shown(view, larger.rays().reshape(-1, 3)).all()
    middle = np.array([500.0, 400.0, 1.0]) @ np.linalg.inv(view.K).T @ view.R
    np.testing.assert_allclose(found.R @ middle / np.linalg.norm(middle), (0, 0, 1), atol=1e-12)


def test_a_view_that_is_centered_stays_as_it_is():
    view = PerspectiveView(np.eye(3), camera_matrix(900.0, 900.0, 500.0, 400.0), 1000, 800)
    found = center_view(view)
    assert (found.width, found.height) == (1000, 800)
    np.testing.assert_allclose(found.K, view.K)
    np.testing.assert_allclose(found.R, view.R, atol=1e-15)
