"""Planes through depth maps."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.stereo.patch_match import fit_planes, plane_normals
from sfm_app.stereo.view import View

slope = st.floats(-1.0, 1.0)


def view_with(K: np.ndarray, sample_px: float = 0.5) -> View:
    return View("v", K, np.eye(3), np.zeros(3), 30, 20, sample_px=sample_px)


def plane_depth(view: View, normal: np.ndarray, distance: float) -> np.ndarray:
    y, x = np.mgrid[:20, :30] + view.sample_px
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(view.K).T
    return (distance / (rays @ normal)).astype(np.float32)


@settings(max_examples=30)
@given(a=slope, b=slope, skew=st.floats(-20, 20), sample_px=st.sampled_from([0.0, 0.5]))
def test_a_plane_comes_back_exactly(a, b, skew, sample_px):
    view = view_with(np.array([[100.0, skew, 14], [0, 140.0, 9], [0, 0, 1]]), sample_px)
    normal = np.array([a, b, 3.0]) / np.linalg.norm([a, b, 3.0])
    depth = plane_depth(view, normal, 5.0)

    planes = fit_planes(depth)
    normals = plane_normals(planes, view)

    np.testing.assert_allclose(planes[..., 0] * depth, 1, rtol=2e-6)
    np.testing.assert_allclose(normals, np.broadcast_to(-normal, normals.shape), atol=1e-3)


def test_noise_is_smoothed_but_not_away():
    view = view_with(np.array([[100.0, 0, 15], [0, 100.0, 10], [0, 0, 1]]))
    depth = plane_depth(view, np.array([0, 0, 1.0]), 5.0)
    noisy = depth + np.random.default_rng(0).normal(0, 0.01, depth.shape).astype(np.float32)

    planes = fit_planes(noisy)

    inside = (1 / planes[..., 0] - depth)[5:-5, 5:-5]
    assert 0.0005 < inside.std() < 0.003


def test_steps_stay_sharp():
    view = view_with(np.array([[100.0, 0, 15], [0, 100.0, 10], [0, 0, 1]]))
    depth = np.full((20, 30), 5.0, np.float32)
    depth[:, 15:] = 6.0

    planes = fit_planes(depth)

    np.testing.assert_allclose(planes[..., 0] * depth, 1, rtol=1e-6)
    np.testing.assert_allclose(plane_normals(planes, view)[..., 2], -1.0, atol=1e-5)


def test_specks_and_empty_pixels_get_nothing():
    depth = np.zeros((20, 30), np.float32)
    depth[10, 10:13] = 5.0

    planes = fit_planes(depth)

    assert not planes.any()
    assert not plane_normals(planes, view_with(np.diag([100.0, 100.0, 1.0]))).any()
