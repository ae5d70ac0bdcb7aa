"""Disparities and the depths they stand for, on a plane with known depth."""

import numpy as np
import pytest

from sfm_app.stereo.matching import depths_from_disparities, disparities, has_texture
from sfm_app.stereo.rectify import rectify


@pytest.mark.parametrize("center", [(0.5, 0, 0), (-0.5, 0, 0), (0, 0.5, 0), (0.3, -0.3, 0.1)])
@pytest.mark.parametrize("sample_px", [0.0, 0.5])
def test_finds_the_plane_whatever_the_baseline(plane, make_view, center, sample_px):
    view, neighbour = make_view((0, 0, 0), sample_px=sample_px), make_view(center, turn=(0.02, -0.03, 0.05))
    rectification = rectify(view, neighbour)

    disparity = disparities(*rectification.warp(plane.photo(view), plane.photo(neighbour)), rectification.disparities)
    depth, parallax = depths_from_disparities(disparity, rectification, view, neighbour)

    known = depth > 0
    error = (depth / plane.depth(view) - 1)[known]
    assert np.mean(known) > 0.7
    assert 1e-5 < np.median(np.abs(error)) < 2e-3
    # half a pixel of misplaced sample on this slanted plane is more than this
    assert abs(np.median(error)) < 4e-4
    assert np.array_equal(parallax > 0, known)


def test_pixels_that_the_neighbour_does_not_see_have_no_depth(plane, make_view):
    view, neighbour = make_view((0, 0, 0)), make_view((1.0, 0, 0))
    rectification = rectify(view, neighbour)

    disparity = disparities(*rectification.warp(plane.photo(view), plane.photo(neighbour)), rectification.disparities)
    depth, _ = depths_from_disparities(disparity, rectification, view, neighbour)

    unseen = int(0.8 * 230 * 1.0 / 4.5)  # parallax of the far side in pixels, less a margin
    assert not depth[:, :unseen].any()
    assert np.mean(depth[:, 100:] > 0) > 0.8


def test_a_flat_sky_has_no_texture():
    image = np.full((40, 60), 250, np.uint8)
    image[20:] = np.random.default_rng(0).integers(0, 255, (20, 60))

    found = has_texture(image)

    assert not found[:15].any()
    assert found[20:].all()
