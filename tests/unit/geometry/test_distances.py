"""The four error measures of an epipolar geometry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import least_squares

from sfm_app.geometry.epipolar import (
    algebraic_distance,
    canonical_cameras,
    cross_matrix,
    epipoles,
    nearest_exact_matches,
    nearest_rank_two,
    reprojection_distance,
    sampson_distance,
    symmetric_epipolar_distance,
    to_homogeneous,
)
from sfm_app.synthetic.correspondences import PairOptions, make_pair

SEEDS = st.integers(0, 2**31)
MEASURES = [algebraic_distance, symmetric_epipolar_distance, sampson_distance, reprojection_distance]


def test_distances_by_hand():
    # epipolar lines y = const: F of a pure shift along x; the match is 3 px off
    F = cross_matrix([1, 0, 0])
    x1, x2 = [[10.0, 20.0]], [[40.0, 23.0]]

    assert sampson_distance(F, x1, x2) == pytest.approx([3 / np.sqrt(2)])
    assert symmetric_epipolar_distance(F, x1, x2) == pytest.approx([3])
    assert reprojection_distance(F, x1, x2) == pytest.approx([3 / np.sqrt(2)])
    assert algebraic_distance(F, x1, x2) == pytest.approx([3 / np.sqrt(2)])


@pytest.mark.parametrize("seed", range(3))
def test_sampson_distance_is_the_distance_to_the_nearest_exact_match(seed):
    pair = make_pair(PairOptions(points=20, sigma_px=0.5), seed)
    distance = sampson_distance(pair.F, pair.x1, pair.x2)
    gradient = np.empty((20, 4))  # of the algebraic error over (x1, x2), by central differences
    for k in range(4):
        step = np.eye(4)[k] * 1e-3
        ahead, behind = (
            np.einsum(
                "ni,ij,nj->n", to_homogeneous(pair.x2 + s * step[2:]), pair.F, to_homogeneous(pair.x1 + s * step[:2])
            )
            for s in (1, -1)
        )
        gradient[:, k] = (ahead - behind) / 2e-3
    algebraic = np.einsum("ni,ij,nj->n", to_homogeneous(pair.x2), pair.F, to_homogeneous(pair.x1))

    np.testing.assert_allclose(distance, np.abs(algebraic) / np.linalg.norm(gradient, axis=1), rtol=1e-6)
    assert 0.2 < np.sqrt(np.mean(distance**2)) < 0.8


def test_vanishing_lines_are_infinitely_far():
    assert sampson_distance(np.zeros((3, 3)), [[1, 2]], [[3, 4]]) == [np.inf]
    assert symmetric_epipolar_distance(np.zeros((3, 3)), [[1, 2]], [[3, 4]]) == [np.inf]


@pytest.mark.parametrize("function", MEASURES)
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


def random_case(seed, count=40):
    """Any F of rank 2, with matches far off: all four measures differ."""
    rng = np.random.default_rng(seed)
    return nearest_rank_two(rng.normal(size=(3, 3))), rng.normal(size=(count, 2)), rng.normal(size=(count, 2))


@given(seed=SEEDS, scale=st.floats(-1e6, 1e6).filter(lambda s: abs(s) > 1e-6))
def test_measures_ignore_the_scale_of_the_matrix_and_the_order_of_the_views(seed, scale):
    F, x1, x2 = random_case(seed, 5)
    for measure in MEASURES:
        expected = measure(F, x1, x2)
        assert (expected > 0).all()
        np.testing.assert_allclose(measure(scale * F, x1, x2), expected, rtol=1e-6)
        np.testing.assert_allclose(measure(F.T, x2, x1), expected, rtol=1e-6)


def test_algebraic_distance_is_a_row_of_the_design_matrix_times_the_unit_vector():
    F, x1, x2 = random_case(3)
    design = np.einsum("ni,nj->nij", to_homogeneous(x2), to_homogeneous(x1)).reshape(-1, 9)
    np.testing.assert_allclose(algebraic_distance(F, x1, x2), np.abs(design @ F.ravel()) / np.linalg.norm(F))
    assert algebraic_distance(np.zeros((3, 3)), [[1, 2]], [[3, 4]]) == [np.inf]


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize("seed", range(3))
def test_exact_matches_are_at_no_distance(measure, seed):
    pair = make_pair(PairOptions(points=50), seed)
    unit = 1e-6 if measure is algebraic_distance else 1
    assert measure(pair.F, pair.exact_x1, pair.exact_x2).max() < 1e-9 / unit
    assert np.median(measure(pair.F, pair.x1, pair.x2)) > 1e-2 * unit


@pytest.mark.parametrize("seed", range(4))
def test_reprojection_distance_is_the_least_over_the_pencil_of_epipolar_lines(seed):
    F, x1, x2 = random_case(seed)
    e1 = epipoles(F)[0]
    across = np.linalg.svd(e1.reshape(1, 3))[2][1:]
    angle = np.linspace(0, np.pi, 20001)[:, None]
    lines1 = np.cos(angle) * across[0] + np.sin(angle) * across[1]
    lines2 = np.cross(lines1, e1) @ F.T
    squared = sum(
        (to_homogeneous(x) @ lines.T) ** 2 / (lines[:, :2] ** 2).sum(axis=1)
        for x, lines in ((x1, lines1), (x2, lines2))
    )
    swept = np.sqrt(squared.min(axis=1))

    found = reprojection_distance(F, x1, x2)

    assert (found <= swept + 1e-12).all()
    np.testing.assert_allclose(found, swept, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("frame", [0, 1])
def test_reprojection_distance_is_the_least_over_the_point_in_every_projective_frame(frame):
    F, x1, x2 = random_case(7, 4)
    H = np.eye(4) + frame * np.random.default_rng(1).normal(size=(4, 4)) / 3
    P1, P2 = (P @ H for P in canonical_cameras(F))

    def error(X, k):
        return np.hstack([(P @ X)[:2] / (P @ X)[2] - x for P, x in ((P1, x1[k]), (P2, x2[k]))])

    rng = np.random.default_rng(2)
    least = [
        min(np.sqrt(2 * least_squares(error, rng.normal(size=4), args=(k,)).cost) for _ in range(12)) for k in range(4)
    ]

    np.testing.assert_allclose(reprojection_distance(F, x1, x2), least, rtol=1e-5)


def test_nearest_exact_matches_are_exact_and_as_near_as_the_distance_says():
    F, x1, x2 = random_case(11, 300)
    exact1, exact2 = nearest_exact_matches(F, x1, x2)
    assert np.abs(np.einsum("ni,ij,nj->n", to_homogeneous(exact2), F, to_homogeneous(exact1))).max() < 1e-12
    moved = np.linalg.norm(np.hstack([exact1 - x1, exact2 - x2]), axis=1)
    np.testing.assert_allclose(reprojection_distance(F, x1, x2), moved)
    assert moved.max() > 0.1


def test_sampson_distance_is_the_first_order_of_the_reprojection_distance():
    pair = make_pair(PairOptions(points=200, sigma_px=1), 4)
    differences = []
    for share in (1.0, 0.1):
        near = [exact + share * (x - exact) for x, exact in ((pair.x1, pair.exact_x1), (pair.x2, pair.exact_x2))]
        sampson, exact = sampson_distance(pair.F, *near), reprojection_distance(pair.F, *near)
        differences.append(np.abs(sampson - exact).max())
    assert 0 < differences[0] < 1e-2
    assert differences[1] == pytest.approx(differences[0] / 100, rel=0.3)


def test_sampson_and_reprojection_agree_for_an_affine_matrix():
    F, x1, x2 = random_case(5)
    F[:2, :2] = 0
    np.testing.assert_allclose(reprojection_distance(F, x1, x2), sampson_distance(F, x1, x2), rtol=1e-12)


def test_a_match_between_two_nearest_ones_has_their_distance():
    # x1 x2 + y1 y2 = 1 per coordinate pair: from the origin, both epipolar lines are at infinity
    F = np.diag([1.0, 0.5, -1.0])
    assert reprojection_distance(F, [[0, 0]], [[0, 0]]) == pytest.approx([np.sqrt(2)])
    exact1, exact2 = nearest_exact_matches(F, [[0, 0]], [[0, 0]])
    np.testing.assert_allclose(exact1, exact2, atol=1e-6)
    assert reprojection_distance(F, [[1e-9, 0]], [[1e-9, 0]]) == pytest.approx([np.sqrt(2)])


def test_what_no_match_fits_is_infinitely_far():
    nothing = np.zeros((3, 3))
    nothing[2, 2] = 1
    assert reprojection_distance(nothing, [[1, 2]], [[3, 4]]) == [np.inf]
    assert reprojection_distance(nothing, np.empty((0, 2)), np.empty((0, 2))).shape == (0,)
