"""Rectification in every direction, reasons of rejected pairs, disparities and their depths."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.stereo.rectify import DISPARITY_STEP, OPTIONS, Rectification, depths_from_disparities, disparities, rectify
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
    pose = np.column_stack([R, -R @ np.array(center, float)])
    return View("v", K, pose, 320, 240, np.arange(len(points)), points)


def cloud() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-1.5, 1.5, (200, 2)), rng.uniform(4, 7, 200)])


def on_canvas(found: Rectification, view: View, points: np.ndarray, shift_px: float = 0.0) -> np.ndarray:
    """(N, 2) pixels of points on the canvas of a view."""
    x, y, z = ((points - view.center) @ found.rotation.T).T
    theta, phi = np.arctan2(np.hypot(y, z), x), np.arctan2(y, z)
    columns = (found.theta_max - theta) * found.columns_per_rad + found.disparities + shift_px
    return np.column_stack([columns, (phi - found.phi_min) * found.rows_per_rad])


def seen(view: View, points: np.ndarray) -> np.ndarray:
    x = (points @ view.R.T + view.t) @ view.K.T
    return (x[:, 2] > 0) & np.all((x[:, :2] > 0) & (x[:, :2] < x[:, 2:] * [view.width, view.height]), axis=1)


small = st.floats(-0.15, 0.15)
sphere = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.3)


@given(direction=sphere, turns=st.tuples(small, small, small))
def test_rows_match_and_disparities_follow_depth_for_any_motion(direction, turns):
    points = cloud()
    reference = view_at([0, 0, 0], points=points)
    neighbor = view_at(0.6 * np.array(direction) / np.linalg.norm(direction), turned(*turns))

    found = rectify(reference, neighbor)

    assert isinstance(found, Rectification), found
    left = on_canvas(found, reference, points)
    right = on_canvas(found, neighbor, points, found.offset_px)
    np.testing.assert_allclose(left[:, 1], right[:, 1], atol=1e-6)
    disparity = left[:, 0] - right[:, 0]
    both = seen(reference, points) & seen(neighbor, points)
    assert both.sum() > 50
    to_point, to_other = points - reference.center, points - neighbor.center
    cosine = np.sum(to_point * to_other, axis=1) / np.linalg.norm(to_point, axis=1) / np.linalg.norm(to_other, axis=1)
    angle = np.arccos(np.minimum(cosine, 1))
    np.testing.assert_allclose(disparity + found.offset_px, angle * found.columns_per_rad, atol=1e-3)
    within = (disparity >= 0) & (disparity < found.disparities)
    assert within[both].mean() > 0.97  # the range is that of the points but for the strays
    assert np.all((left[both & within] >= [found.disparities - 1e-6, -1e-6]) & (left[both & within] <= found.size))
    assert np.prod(found.size - np.array([found.disparities, 0])) < 1.05 * OPTIONS.max_growth * 320 * 240


def seen_by(neighbor, view, depth, known):
    row, col = np.nonzero(known)
    P = view.projection_into(neighbor)
    pixels = np.stack([col + view.sample_px, row + view.sample_px, np.ones(len(row))])
    x, y, w = P[:, :3] @ pixels * depth[known] + P[:, 3:]
    return x / w, y / w


@pytest.mark.parametrize("center", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0.02, 0.01, 0.5), (0, 0, -0.5)])
def test_photos_are_warped_to_the_pixels_of_points(center):
    reference, neighbor = view_at([0, 0, 0], points=cloud()), view_at(center, turned(0, 0, 0.1))
    found = rectify(reference, neighbor)
    point = np.array([[0.5, 0.4, 5.0]])
    photos = []
    for view in (reference, neighbor):
        x = K @ (view.R @ point[0] + view.t)
        v, u = np.mgrid[:240, :320] + 0.5
        photos.append((250 * np.exp(-((u - x[0] / x[2]) ** 2 + (v - x[1] / x[2]) ** 2) / 18)).astype(np.uint8))

    warped = found.warp(*photos, (reference, neighbor))

    for image, view, shift_px in zip(warped, (reference, neighbor), (0.0, found.offset_px), strict=True):
        y, x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
        weight = np.where(image > 20, image, 0).astype(float)
        centroid = [np.sum(weight * x), np.sum(weight * y)] / np.sum(weight)
        # the canvas is curved near the ends of the baseline, the middle of a spot moves a little there
        np.testing.assert_allclose(centroid, on_canvas(found, view, point, shift_px)[0], atol=0.25)


@pytest.mark.parametrize("center", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0, -0.5, 0)])
def test_keeps_the_resolution_of_the_reference(center):
    reference = view_at([0, 0, 0], points=cloud())

    found = rectify(reference, view_at(center))

    spots = np.array([[160.0, 120, 1], [161, 120, 1], [160, 121, 1]]) @ np.linalg.inv(K).T
    middle = on_canvas(found, reference, spots)
    assert 0.97 < abs(np.linalg.det(middle[1:] - middle[0])) < 1.03


def test_disparities_are_limited_by_shrinking():
    near = np.column_stack([np.linspace(-0.3, 0.3, 50), np.zeros(50), np.linspace(0.3, 8, 50)])

    found = rectify(view_at([0, 0, 0], points=near), view_at([1.2, 0, 0], turned(0, 0.2, 0)))

    assert isinstance(found, Rectification), found
    assert found.disparities % DISPARITY_STEP == 0
    assert OPTIONS.max_disparities / 2 < found.disparities <= OPTIONS.max_disparities + DISPARITY_STEP
    assert 0.5 * K[0, 0] < found.columns_per_rad < 1.8 * K[0, 0]


def test_rejected_pairs_have_a_reason():
    reference = view_at([0, 0, 0], points=cloud())

    assert rectify(reference, reference) == Rejected("the photos were taken from the same place")
    assert rectify(reference, view_at((0.5, 0, 0), turned(0.9, 0, 0))) == Rejected("the photos do not overlap")
    assert rectify(view_at([0, 0, 0]), view_at([0.5, 0, 0])) == Rejected("too few sparse points")


@pytest.mark.parametrize("center", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0.3, -0.3, 0.1), (0.1, 0, 0.9)])
@pytest.mark.parametrize("sample_px", [0.0, 0.5])
def test_depths_lie_on_the_plane_for_any_baseline(plane, make_view, center, sample_px):
    view, neighbor = make_view((0, 0, 0), sample_px=sample_px), make_view(center, turn=(0.02, -0.03, 0.05))
    rectification = rectify(view, neighbor)

    canvases = rectification.warp(plane.photo(view), plane.photo(neighbor), (view, neighbor))
    disparity = disparities(*canvases, rectification.disparities)
    depth = depths_from_disparities(disparity, rectification, view, neighbor)

    known = depth > 0
    moved = np.subtract(seen_by(neighbor, view, depth, known), seen_by(neighbor, view, plane.depth(view), known))
    error_px = np.sign(depth / plane.depth(view) - 1)[known] * np.hypot(*moved)
    assert np.mean(known) > (0.7 if center[2] < 0.5 else 0.5)  # forward there is nothing about the epipole
    assert abs(np.median(error_px)) < 0.08  # pixel centers misplaced in one of the photos would make it 0.5
    assert 0.01 < np.median(np.abs(error_px)) < 0.15


@pytest.mark.parametrize(("disparity", "known"), [(0.9, False), (1.2, True)])
def test_a_parallax_below_a_pixel_has_no_depth(make_view, disparity, known):
    view, neighbor = make_view((0, 0, 0)), make_view((0.5, 0, 0))
    rectification = replace(rectify(view, neighbor), offset_px=0.0)
    everywhere = np.full(rectification.size[::-1], disparity, np.float32)

    depth = depths_from_disparities(everywhere, rectification, view, neighbor)

    assert (np.mean(depth > 0) > 0.5) if known else not depth.any()


def test_pixels_outside_the_neighbor_have_no_depth(make_view):
    view, neighbor = make_view((0, 0, 0)), make_view((1.0, 0, 0))
    rectification = rectify(view, neighbor)
    everywhere = np.full(rectification.size[::-1], 20, np.float32)

    depth = depths_from_disparities(everywhere, rectification, view, neighbor)

    # the neighbor stands to the right and sees everything further left
    row, col = np.nonzero(depth)
    moved = col + 0.5 - 230 * 1.0 / depth[row, col]
    assert np.all(moved > 0)
    assert not depth[:, :40].any()
    assert np.mean(depth[5:-5, 120:-5] > 0) > 0.95
