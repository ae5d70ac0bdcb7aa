"""Disparities and the depths they stand for, on a plane with known depth."""

import numpy as np
import pytest

from sfm_app.stereo.rectify import depths_from_disparities, disparities, rectify


@pytest.mark.parametrize("center", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0.3, -0.3, 0.1), (0.1, 0, 0.9)])
@pytest.mark.parametrize("sample_px", [0.0, 0.5])
def test_finds_the_plane_whatever_the_baseline(plane, make_view, center, sample_px):
    view, neighbor = make_view((0, 0, 0), sample_px=sample_px), make_view(center, turn=(0.02, -0.03, 0.05))
    rectification = rectify(view, neighbor)

    canvases = rectification.warp(plane.photo(view), plane.photo(neighbor), (view, neighbor))
    disparity = disparities(*canvases, rectification.disparities)
    depth, parallax = depths_from_disparities(disparity, rectification, view, neighbor)

    known = depth > 0
    error_px = ((depth / plane.depth(view) - 1) * parallax)[known]
    assert np.mean(known) > (0.7 if center[2] < 0.5 else 0.5)  # forward there is nothing about the epipole
    assert abs(np.median(error_px)) < 0.08  # pixel centers misplaced in one of the photos would make it 0.5
    assert 0.01 < np.median(np.abs(error_px)) < 0.15
    assert np.array_equal(parallax > 0, known)


def test_pixels_that_the_neighbor_does_not_see_have_no_depth(make_view):
    view, neighbor = make_view((0, 0, 0)), make_view((1.0, 0, 0))
    rectification = rectify(view, neighbor)
    everywhere = np.full(rectification.size[::-1], 20, np.float32)

    depth, _ = depths_from_disparities(everywhere, rectification, view, neighbor)

    # the neighbor stands to the right and sees everything further left
    row, col = np.nonzero(depth)
    moved = col + 0.5 - 230 * 1.0 / depth[row, col]
    assert np.all(moved > 0)
    assert not depth[:, :40].any()
    assert np.mean(depth[5:-5, 120:-5] > 0) > 0.95
