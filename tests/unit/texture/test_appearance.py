"""Gains of photos, and outlier views."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from painted_box import box, sightings

from sfm_app.texture.appearance import median, outlier_mask, photo_gains
from sfm_app.texture.sightings import facets


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=12))
@settings(deadline=None)
def test_median_is_numpys(values):
    assert median(np.array([*values, 7.0, -7.0]), len(values)) == pytest.approx(np.median(values))


@pytest.mark.parametrize("strays", [0.0, 0.2])
def test_gains_are_robust_to_noise_and_outliers(strays):
    rng = np.random.default_rng(3)
    truth = rng.uniform(0.6, 1.4, (6, 3))
    truth /= np.exp(np.log(truth).mean(axis=0))
    albedo = rng.uniform(40, 150, (3000, 3))
    colors = albedo * truth[:, None, :] * rng.normal(1.0, 0.03, (6, 3000, 3))
    wrong = rng.random((6, 3000)) < strays
    colors[wrong] = rng.uniform(0, 255, (wrong.sum(), 3))
    first = np.arange(3000) * 5 // 3000  # a chain: each triangle is seen by two photos next to each other
    seen = np.zeros((6, 3000), bool)
    seen[first, np.arange(3000)] = seen[first + 1, np.arange(3000)] = True
    found = photo_gains(sightings(seen, np.clip(colors, 0, 255).astype(np.uint8)))
    np.testing.assert_allclose(found, truth, rtol=0.08 if strays else 0.03)


def test_photos_without_common_triangles_keep_their_exposure():
    colors = np.full((3, 100, 3), 100, np.uint8)
    colors[2] = 200
    seen = np.zeros((3, 100), bool)
    seen[:2, :50] = seen[2, 50:] = True
    np.testing.assert_allclose(photo_gains(sightings(seen, colors)), 1.0)


def test_outliers_are_areas_not_specks():
    mesh = facets(box(16))
    rng = np.random.default_rng(5)
    count = len(mesh.faces)
    colors = (120 + rng.normal(0, 5, (4, count, 3))).astype(np.uint8)
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    person = np.linalg.norm(centers - [1.0, 0.1, 0.1], axis=1) < 0.35
    colors[2, person] = (20, 160, 220)
    speck = int(np.argmax(centers[:, 1]))
    colors[1, speck] = 200
    seen = np.ones((4, count), bool)
    found = outlier_mask(sightings(seen, colors), np.ones((4, 3)), mesh.neighbors).reshape(seen.shape)
    assert found[2, person].all()
    assert 0 < found[2].sum() - person.sum() < 0.6 * person.sum()  # a rim around it, no more
    assert not found[[0, 1, 3]].any()
    two = outlier_mask(sightings(seen[:2], colors[1:3]), np.ones((2, 3)), mesh.neighbors)
    assert not two.any()
