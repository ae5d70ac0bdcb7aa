"""The four error measures of an epipolar geometry."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares, minimize

from sfm_app.geometry.distances import (
    algebraic_distance,
    nearest_exact_matches,
    reprojection_distance,
    sampson_distance,
    symmetric_epipolar_distance,
)
from sfm_app.geometry.epipolar import canonical_cameras, cross_matrix, homogeneous
from sfm_app.synthetic.correspondences import PairOptions, make_pair

SEEDS = st.integers(0, 2**31)
MEASURES = [algebraic_distance, symmetric_epipolar_distance, sampson_distance, reprojection_distance]


def test_distances_by_hand():
    # epipolar lines y = const: F of a pure shift along x; the match is 3 px off
    F = cross_matrix([1, 0, 0])
    x1, x2 = [[10.0, 20.0]], [[40.0, 23.0]]

    assert sampson_distance(F, x1, x2) == pytest.approx([3 / np.sqrt(2)])
    assert symmetric_epipolar_distance(F, x1, x2) == pytest.approx([3])


@given(seed=SEEDS, scale=st.floats(-1e6, 1e6).filter(lambda s: abs(s) > 1e-6))
def test_sampson_distance_ignores_the_scale_and_the_order_of_the_views(seed, scale):
    rng = np.random.default_rng(seed)
    F, x1, x2 = rng.normal(size=(3, 3)), rng.uniform(0, 10, (5, 2)), rng.uniform(0, 10, (5, 2))

    expected = sampson_distance(F, x1, x2)

    assert (expected > 0).all()
    np.testing.assert_allclose(sampson_distance(scale * F, x1, x2), expected, rtol=1e-6)
    np.testing.assert_allclose(sampson_distance(F.T, x2, x1), expected, rtol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_sampson_distance_is_the_distance_to_the_nearest_exact_match(seed):
    pair = make_pair(PairOptions(points=20, sigma_px=0.5), seed)
    distance = sampson_distance(pair.F, pair.x1, pair.x2)
    gradient = np.empty((20, 4))  # of the algebraic error over (x1, x2), by central differences
    for k in range(4):
        step = np.eye(4)[k] * 1e-3
        ahead, behind = (
            np.einsum("ni,ij,nj->n", homogeneous(pair.x2 + s * step[2:]), pair.F, homogeneous(pair.x1 + s * step[:2]))
            for s in (1, -1)
        )
        gradient[:, k] = (ahead - behind) / 2e-3
    algebraic = np.einsum("ni,ij,nj->n", homogeneous(pair.x2), pair.F, homogeneous(pair.x1))

    np.testing.assert_allclose(distance, np.abs(algebraic) / np.linalg.norm(gradient, axis=1), rtol=1e-6)
    assert 0.2 < np.sqrt(np.mean(distance**2)) < 0.8


def test_vanishing_lines_are_infinitely_far():
    assert sampson_distance(np.zeros((3, 3)), [[1, 2]], [[3, 4]]) == [np.inf]
    assert symmetric_epipolar_distance(np.zeros((3, 3)), [[1, 2]], [[3, 4]]) == [np.inf]


@pytest.mark.parametrize("function", [sampson_distance, symmetric_epipolar_distance])
@pytest.mark.parametrize(
    ("F", "x1", "x2", "message"),
    [
        (np.eye(2), [[1, 2]], [[1, 2]], r"F must have shape \(3, 3\)"),
        (np.eye(3), [1, 2], [[1, 2]], r"shape \(N, 2\)"),
        (np.eye(3), [[1, 2]], [[1, 2], [3, 4]], "pair up"),
    ],
)
def test_wrong_shapes_are_refused(function, F, x1, x2, message):
    with pytest.raises(ValueError, match=message):
        function(F, x1, x2)


