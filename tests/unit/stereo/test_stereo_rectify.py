"""Rectification: rows match, disparities are as promised, and hopeless pairs are refused with a reason."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.stereo.rectify import DISPARITY_STEP, MAX_DISPARITIES, Rectification, rectify
from sfm_app.stereo.view import View
from sfm_app.types import Rejected

K = np.array([[300.0, 0, 155], [0, 290.0, 118], [0, 0, 1]])


def turned(x: float, y: float, z: float) -> np.ndarray:
    angle = np.linalg.norm([x, y, z])
    if angle == 0:
        return np.eye(3)
    a, b, c = np.array([x, y, z]) / angle
    cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def view_at(center, rotation=None, points=None) -> View:
    R = np.eye(3) if rotation is None else rotation
    points = np.empty((0, 3)) if points is None else points
    return View("v", K, R, -R @ np.array(center, float), 320, 240, np.arange(len(points)), points)


def cloud() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-1.5, 1.5, (200, 2)), rng.uniform(4, 7, 200)])


def project(H: np.ndarray, view: View, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels in the photo and after the homography."""
    x = (points @ view.R.T + view.t) @ view.K.T
    warped = (x / x[:, 2:]) @ H.T
    return x[:, :2] / x[:, 2:], warped[:, :2] / warped[:, 2:]


small = st.floats(-0.15, 0.15)


@given(direction=st.floats(0, 2 * np.pi), turns=st.tuples(small, small, small), forward=st.floats(-0.2, 0.2))
def test_rows_match_and_disparities_follow_depth(direction, turns, forward):
    points = cloud()
    reference = view_at([0, 0, 0], points=points)
    neighbour = view_at([0.6 * np.cos(direction), 0.6 * np.sin(direction), forward], turned(*turns))

    found = rectify(reference, neighbour)

    assert isinstance(found, Rectification), found
    x1, left = project(found.left, reference, points)
    x2, right = project(found.right, neighbour, points)
    depth = (points @ found.rotation.T)[:, 2]
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-8)
    disparity = left[:, 0] - right[:, 0]
    np.testing.assert_allclose(disparity, found.focal_px * found.baseline / depth - found.offset_px, atol=1e-8)
    in_both = np.all((x1 > 0) & (x1 < [320, 240]) & (x2 > 0) & (x2 < [320, 240]), axis=1)
    assert np.all((disparity >= 0) & (disparity < found.disparities))
    assert np.all((left[in_both] >= [found.disparities, 0]) & (left[in_both] <= found.size))


@pytest.mark.parametrize("center", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0)])
def test_photos_are_warped_as_the_homographies_say(center):
    found = rectify(view_at([0, 0, 0], points=cloud()), view_at(center, turned(0, 0, 0.1)))
    spot = np.array([181.5, 101.5])
    y, x = np.mgrid[:240, :320] + 0.5
    photo = (250 * np.exp(-((x - spot[0]) ** 2 + (y - spot[1]) ** 2) / 18)).astype(np.uint8)

    for warped, H in zip(found.warp(photo, photo), (found.left, found.right), strict=True):
        y, x = np.mgrid[: warped.shape[0], : warped.shape[1]] + 0.5
        weight = np.where(warped > 20, warped, 0).astype(float)
        centroid = [np.sum(weight * x), np.sum(weight * y)] / np.sum(weight)
        expected = H @ [*spot, 1]
        np.testing.assert_allclose(centroid, expected[:2] / expected[2], atol=0.05)


@pytest.mark.parametrize("center", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0, -0.5, 0)])
def test_keeps_the_resolution_of_the_reference(center):
    reference = view_at([0, 0, 0], points=cloud())

    found = rectify(reference, view_at(center))

    middle = np.array([[160.0, 120, 1], [161, 120, 1], [160, 121, 1]]) @ found.left.T
    middle = middle[:, :2] / middle[:, 2:]
    area = abs(np.linalg.det(middle[1:] - middle[0]))
    assert 0.97 < area < 1.03


def test_disparities_are_limited_by_shrinking():
    near = np.column_stack([np.linspace(-0.3, 0.3, 50), np.zeros(50), np.linspace(0.8, 8, 50)])

    found = rectify(view_at([0, 0, 0], points=near), view_at([1.5, 0, 0], turned(0, 0.2, 0)))

    assert isinstance(found, Rectification), found
    assert found.disparities % DISPARITY_STEP == 0
    assert MAX_DISPARITIES / 2 < found.disparities <= MAX_DISPARITIES + DISPARITY_STEP
    assert found.focal_px < 0.9 * K[0, 0]


@pytest.mark.parametrize(
    ("center", "rotation", "reason"),
    [
        ((0, 0, 0), np.eye(3), "same place"),
        ((0.01, 0, 0.6), np.eye(3), "along the viewing direction"),
        ((0.5, 0, 0), turned(0, 1.3, 0), "another direction"),
        ((0.5, 0, 0), turned(0.9, 0, 0), "overlap"),
    ],
)
def test_refuses_with_a_reason(center, rotation, reason):
    found = rectify(view_at([0, 0, 0], points=cloud()), view_at(center, rotation))

    assert isinstance(found, Rejected)
    assert reason in found.reason


def test_refuses_without_sparse_points():
    assert rectify(view_at([0, 0, 0]), view_at([0.5, 0, 0])) == Rejected("too few sparse points")
