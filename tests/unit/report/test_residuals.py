"""Residuals over the photo: noise stays noise, and what a lens model lacks is found where it is."""

from dataclasses import replace

import numpy as np
import pytest

from sfm_app.report.figures import epipolar_residuals, residual_grid
from sfm_app.types import CameraPairs


def test_the_residuals_are_the_noise_along_the_epipolar_lines(camera, seen):
    found = epipolar_residuals(seen(camera, noise_px=0.25), camera)

    assert np.std(found.distances_px) == pytest.approx(0.25, rel=0.05)
    assert np.sum(found.along**2, axis=(0, 2)) == pytest.approx(np.ones(len(found.distances_px)))
    assert found.repeats == 5.0


def test_noise_is_not_taken_for_a_lens(camera, seen):
    grid = residual_grid(epipolar_residuals(seen(camera), camera), (camera.width, camera.height))

    assert np.mean(grid.clear) < 0.02
    assert 0.1 < np.nanmedian(grid.size_px) < 0.17
    assert np.nanmax(np.abs(grid.shift_px)) < 0.25


def test_what_the_lens_lacks_is_found_in_its_cells(camera, seen):
    """A dent: keypoints of a few cells lie half a pixel too low. Partners of most lie elsewhere."""
    size = np.array([camera.width, camera.height])
    low, high = np.array([7.0, 3.0]) / 14.0, np.array([9.0, 5.0]) / 14.0

    def dent(x):
        inside = ((x > low * size[0]) & (x < high * size[0])).all(axis=1)
        return inside[:, None] * [0.0, 0.5]

    pairs = seen(camera, lacks=dent, points=2500)
    grid = residual_grid(epipolar_residuals(pairs, camera), (camera.width, camera.height))

    there = np.zeros(grid.clear.shape, bool)
    there[3:5, 7:9] = True
    assert np.mean(grid.shift_px[there], axis=0) == pytest.approx([0.0, 0.5], abs=0.17)
    assert grid.clear[there].all() and np.mean(grid.clear[~there]) < 0.1
    assert np.nanmean(np.abs(grid.shift_px[~there])) < 0.08


def test_without_pairs_all_cells_are_empty(camera):
    nothing = CameraPairs.from_Fs(np.zeros((0, 3, 3)), (camera.width, camera.height))

    grid = residual_grid(epipolar_residuals(nothing, camera), (camera.width, camera.height))

    assert np.isnan(grid.size_px).all() and not grid.clear.any()


@pytest.mark.parametrize("camera", ["perspective"], indirect=True)
def test_a_distorted_lens_is_undone_first(camera, seen):
    """Matches that a barrel lens bent leave no more than noise, once it is known."""
    bent = replace(camera, radial=-0.1)

    def bend(x):
        about = (x - camera.K[:2, 2]) / 800.0
        return 800.0 * about * -0.1 * np.sum(about**2, axis=1, keepdims=True)

    pairs = seen(camera, noise_px=0.2, lacks=bend)

    assert np.std(epipolar_residuals(pairs, bent).distances_px) == pytest.approx(0.2, rel=0.1)
    assert np.std(epipolar_residuals(pairs, camera).distances_px) > 1.0
