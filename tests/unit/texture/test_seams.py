"""Blending and leveling at seams, and the squares of triangles without a photo."""

import numpy as np
import pytest
from painted_box import sightings, strip

from sfm_app.texture.charts import rectangle_sizes, square_texels, squares
from sfm_app.texture.seams import blend_weights, level_seams, solve_ties


def test_weights_blend_near_the_seam_only():
    mesh = strip(12)
    chosen = np.tile((np.arange(12) >= 6).astype(np.int32), 2)
    blend = blend_weights(chosen, sightings(np.ones((2, 24))), mesh)
    sums = np.bincount(blend.vertex, blend.weight)
    np.testing.assert_allclose(sums, 1.0, atol=1e-6)
    first = np.zeros(26)
    first[blend.vertex[blend.photo_rows(0)]] = blend.weight[blend.photo_rows(0)]
    assert first[6] == pytest.approx(0.5, abs=0.1)
    assert (first[:2] == 1.0).all()
    assert (first[11:13] == 0.0).all()
    assert (np.diff(first[:13]) <= 1e-9).all()


def test_leveling_takes_the_step_out_of_a_seam():
    mesh = strip(40)
    chosen = np.tile((np.arange(40) >= 20).astype(np.int32), 2)
    colors = np.empty((2, 80, 3), np.uint8)
    colors[0], colors[1] = 100, 120
    gains, seen = np.ones((2, 3)), sightings(np.ones((2, 80)), colors)
    blend = level_seams(blend_weights(chosen, seen, mesh), seen, gains, mesh)
    both = np.intersect1d(blend.vertex[blend.photo_rows(0)], blend.vertex[blend.photo_rows(1)])
    for vertex in both:
        one, other = (blend.offset[blend.photo_rows(p)][blend.vertex[blend.photo_rows(p)] == vertex] for p in (0, 1))
        np.testing.assert_allclose(100 + one, 120 + other, atol=1.5)
    assert len(both) > 4


def test_ties_are_solved_as_by_elimination():
    rng = np.random.default_rng(8)
    one, other = rng.integers(0, 30, (2, 90))
    one, other = one[one != other], other[one != other]
    weights = rng.uniform(0.5, 2.0, len(one))
    right = rng.normal(size=(30, 3))
    matrix = 0.5 * np.eye(30)
    for i, j, w in zip(one, other, weights, strict=True):
        matrix[[i, j], [i, j]] += w
        matrix[i, j] -= w
        matrix[j, i] -= w
    found = solve_ties(one, other, weights, 0.5, right)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), atol=0.02)


def test_squares_show_three_colors_exactly():
    rng = np.random.default_rng(2)
    colors = rng.uniform(60, 190, (5, 3, 3))
    texels = square_texels(colors).astype(float)
    np.testing.assert_allclose(texels[:, 0, 0], colors[:, 0], atol=0.5)
    middle = texels[:, 0, 0] + (texels[:, 0, 1] - texels[:, 0, 0]) / 3 + (texels[:, 1, 0] - texels[:, 0, 0]) / 3
    np.testing.assert_allclose(middle, colors.mean(axis=1), atol=1.0)


def test_squares_never_share_a_texel():
    sizes = rectangle_sizes(9000)
    places = np.array([[k, 0, 0] for k in range(len(sizes))], np.int32)
    found = squares(places, sizes, 9000)
    assert len(np.unique(found, axis=0)) == 9000
    for k, (width, height) in enumerate(sizes):
        here = found[found[:, 0] == k]
        assert (here[:, 1].max() + 2, here[:, 2].max() + 2) == (width, height)
