"""Epipolar geometry: F, E, distances, poses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sfm_app.errors import NumericalError
from sfm_app.geometry.epipolar import (
    algebraic_distance,
    canonical_cameras,
    cross_matrix,
    decompose_essential,
    eight_point,
    epipoles,
    essential_from_fundamental,
    fundamental_from_pose,
    hartley_normalization,
    nearest_exact_matches,
    nearest_rank_two,
    relative_pose,
    reprojection_distance,
    sampson_distance,
    symmetric_epipolar_distance,
    to_homogeneous,
    to_unit_norm,
    triangulate,
    triangulation_angle_deg,
    two_view_seed,
)
from sfm_app.synthetic.correspondences import PairOptions, make_pair

SEEDS = st.integers(0, 2**31)


def same_up_to_sign(F, G):
    return min(np.abs(F - G).max(), np.abs(F + G).max())


@given(seed=SEEDS, shift=st.floats(-1e4, 1e4), scale=st.floats(1e-3, 1e3))
def test_hartley_normalization_centers_and_scales(seed, shift, scale):
    x = np.random.default_rng(seed).normal(size=(30, 2)) * scale + shift
    y = to_homogeneous(x) @ hartley_normalization(x).T
    assert np.abs(y[:, :2].mean(axis=0)).max() < 1e-6
    assert np.hypot(y[:, 0], y[:, 1]).mean() == pytest.approx(np.sqrt(2))


@pytest.mark.parametrize("x", [np.empty((0, 2)), np.full((5, 2), 1e5)])
def test_points_without_extent_cannot_be_normalized(x):
    with pytest.raises(NumericalError, match=r"no points|coincide"):
        hartley_normalization(x)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_eight_point_finds_the_exact_matrix(seed):
    pair = make_pair(PairOptions(points=30), seed)
    F = eight_point(pair.exact_x1, pair.exact_x2)
    assert sampson_distance(F, pair.exact_x1, pair.exact_x2).max() < 1e-6
    assert abs(np.linalg.det(F)) < 1e-12
    assert np.linalg.norm(F) == pytest.approx(1)


def test_eight_point_follows_its_weights():
    pair = make_pair(PairOptions(points=100, outliers=0.3), 2)
    weighted = eight_point(pair.x1, pair.x2, weights=pair.is_inlier)
    blind = eight_point(pair.x1, pair.x2)
    good = pair.x1[pair.is_inlier], pair.x2[pair.is_inlier]
    assert np.median(sampson_distance(weighted, *good)) < 2
    assert np.median(sampson_distance(blind, *good)) > 4


def test_eight_point_needs_eight_and_fits_them():
    pair = make_pair(PairOptions(points=8), 1)
    assert same_up_to_sign(eight_point(pair.exact_x1, pair.exact_x2), to_unit_norm(pair.F)) < 1e-6
    with pytest.raises(NumericalError, match="needs 8 matches, got 7"):
        eight_point(pair.x1[:7], pair.x2[:7])


@given(seed=SEEDS)
def test_no_rank_two_matrix_is_nearer(seed):
    rng = np.random.default_rng(seed)
    F = rng.normal(size=(3, 3))
    G = nearest_rank_two(F)
    other = nearest_rank_two(G + 0.1 * rng.normal(size=(3, 3)))
    assert np.linalg.svd(G, compute_uv=False)[2] < 1e-12
    assert np.linalg.norm(F - G) == pytest.approx(np.linalg.svd(F, compute_uv=False)[2])
    assert np.linalg.norm(F - other) >= np.linalg.norm(F - G) - 1e-12


@given(seed=SEEDS, scale=st.floats(-1e6, 1e6).filter(lambda s: abs(s) > 1e-6))
def test_unit_norm_forgets_scale_and_sign(seed, scale):
    F = np.random.default_rng(seed).normal(size=(3, 3))
    G = to_unit_norm(scale * F)
    np.testing.assert_allclose(G, to_unit_norm(F), rtol=1e-9)
    assert np.linalg.norm(G) == pytest.approx(1)
    assert G.flat[np.argmax(np.abs(G))] > 0


@pytest.mark.parametrize("F", [np.zeros((3, 3)), np.full((3, 3), np.nan), np.full((3, 3), np.inf)])
def test_matrices_without_norm_are_refused(F):
    for function in (to_unit_norm, canonical_cameras):
        with pytest.raises(NumericalError, match="zero or not finite"):
            function(F)
    with pytest.raises(NumericalError, match="zero"):
        fundamental_from_pose(np.eye(3), np.eye(3), np.eye(3), np.zeros(3))


def test_pose_gives_the_matrix_of_the_synthetic_pair():
    pair = make_pair(PairOptions(points=20), 3)
    F = fundamental_from_pose(pair.K1, pair.K2, pair.R, pair.t)
    assert same_up_to_sign(F, pair.F) < 1e-12
    e1, e2 = epipoles(F)
    assert np.abs(F @ e1).max() < 1e-12
    assert np.abs(F.T @ e2).max() < 1e-12
    center1_in_2 = pair.K2 @ pair.t
    assert np.abs(np.cross(e2, center1_in_2 / np.linalg.norm(center1_in_2))).max() < 1e-9


@pytest.mark.parametrize("scale", [1.0, -40.0])
def test_canonical_cameras_have_the_matrix_they_come_from(scale):
    rng = np.random.default_rng(0)
    F = to_unit_norm(nearest_rank_two(rng.normal(size=(3, 3))))
    P1, P2 = canonical_cameras(scale * F)
    np.testing.assert_array_equal(P1, np.eye(3, 4))
    assert same_up_to_sign(to_unit_norm(cross_matrix(P2[:, 3]) @ P2[:, :3]), F) < 1e-12
    X = rng.normal(size=(20, 4))
    assert np.abs(np.einsum("ni,ij,nj->n", X @ P2.T, F, X @ P1.T)).max() < 1e-12
    s = np.linalg.svd(F, compute_uv=False)
    np.testing.assert_allclose(np.linalg.svd(P2[:, :3], compute_uv=False), [s[0], np.sqrt(s[0] * s[1]), s[1]])


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


def test_sampson_distance_is_the_first_order_of_the_reprojection_distance_and_all_of_it_for_an_affine_matrix():
    pair = make_pair(PairOptions(points=200, sigma_px=1), 4)
    differences = []
    for share in (1.0, 0.1):
        near = [exact + share * (x - exact) for x, exact in ((pair.x1, pair.exact_x1), (pair.x2, pair.exact_x2))]
        differences.append(np.abs(sampson_distance(pair.F, *near) - reprojection_distance(pair.F, *near)).max())
    assert 0 < differences[0] < 1e-2
    assert differences[1] == pytest.approx(differences[0] / 100, rel=0.3)
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


def test_matrices_that_no_match_fits_are_infinitely_far():
    for measure in MEASURES:
        nothing = np.diag([0.0, 0, 1]) if measure is reprojection_distance else np.zeros((3, 3))
        assert measure(nothing, [[1, 2]], [[3, 4]]) == [np.inf]
        assert measure(nothing, np.empty((0, 2)), np.empty((0, 2))).shape == (0,)


angle = st.floats(-0.6, 0.6)
component = st.floats(-1, 1)


def scene(seed, R, t, n=60):
    """Points before both cameras, and their normalized projections."""
    rng = np.random.default_rng(seed)
    X = rng.uniform([-2, -2, 5], [2, 2, 9], (n, 3))
    Y = X @ R.T + t
    keep = Y[:, 2] > 0.5
    X, Y = X[keep], Y[keep]
    return X, X[:, :2] / X[:, 2:], Y[:, :2] / Y[:, 2:]


@given(st.tuples(angle, angle, angle), st.tuples(component, component, component), st.integers(0, 1000))
def test_the_pose_comes_back_from_the_essential_matrix(angles, t, seed):
    t = np.array(t)
    if np.linalg.norm(t) < 0.1:
        t = np.array([1.0, 0, 0])
    t /= np.linalg.norm(t)
    R = Rotation.from_euler("xyz", angles).as_matrix()
    X, x1, x2 = scene(seed, R, t)
    found_R, found_t = relative_pose(-3.0 * cross_matrix(t) @ R, x1, x2)
    assert np.allclose(found_R, R, atol=1e-6)
    assert np.allclose(found_t, t, atol=1e-6)
    both = two_view_seed(-3.0 * cross_matrix(t) @ R, x1, x2)
    assert both.in_front == 1.0 and np.allclose(both.points, X, rtol=1e-3, atol=1e-3)


@given(st.tuples(angle, angle, angle), st.tuples(component, component, st.floats(0.1, 1)))
def test_all_four_poses_are_rotations_of_the_same_essential_matrix(angles, t):
    R = Rotation.from_euler("xyz", angles).as_matrix()
    E = cross_matrix(np.array(t) / np.linalg.norm(t)) @ R
    for R_i, t_i in decompose_essential(E):
        assert np.isclose(np.linalg.det(R_i), 1)
        again = cross_matrix(t_i) @ R_i
        assert np.allclose(again, E, atol=1e-8) or np.allclose(again, -E, atol=1e-8)


def test_essential_matrix_has_two_equal_singular_values():
    K1, K2 = np.diag([700.0, 710, 1]), np.diag([900.0, 890, 1])
    E = cross_matrix([0.3, 0.1, 1.0]) @ Rotation.from_euler("y", 0.2).as_matrix()
    F = np.linalg.inv(K2).T @ E @ np.linalg.inv(K1)
    rng = np.random.default_rng(0)
    found = essential_from_fundamental(F * (1 + 1e-3 * rng.normal(size=(3, 3))), K1, K2)
    assert np.allclose(np.linalg.svd(found)[1], [1, 1, 0], atol=1e-12)
    exact = essential_from_fundamental(5 * F, K1, K2)
    assert np.allclose(exact / exact[0, 1], E / E[0, 1], atol=1e-9)


def test_triangulation_and_angles_of_parallel_and_perpendicular_rays():
    center = np.array([1.0, 0, 0])
    X = triangulate(np.eye(3, 4), np.column_stack([np.eye(3), -center]), np.zeros((1, 2)), np.zeros((1, 2)))
    assert np.abs(X).max() > 1e9
    infinite = np.array([[np.inf, 0, 1], [np.nan, 1, 1], [1e200, 1e190, 1e200]])
    assert triangulation_angle_deg(np.vstack([X, infinite]), np.zeros(3), center) == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-6, 8.0, 90.0, 135.0])
def test_angles_are_exact(angle_deg):
    angle = np.radians(angle_deg)
    centers = np.array([1.0, 0, 0]), np.array([np.cos(angle), np.sin(angle), 0])
    np.testing.assert_allclose(triangulation_angle_deg(np.zeros((1, 3)), *centers), angle_deg, rtol=1e-9)


def test_a_seed_tells_a_narrow_and_a_contradictory_pair():
    def seed(t, flip=0):
        t = np.array(t)
        _, x1, x2 = scene(1, np.eye(3), t)
        x1[:flip], x2[:flip] = x2[:flip].copy(), x1[:flip].copy()  # swapped matches lie behind the cameras
        return two_view_seed(3.0 * cross_matrix(t), x1, x2)

    wide, narrow, contradictory = seed([-1.0, 0, 0]), seed([-0.05, 0, 0]), seed([-1.0, 0, 0], flip=20)

    assert 7 < wide.angle_deg < 12 and wide.in_front == 1
    assert 0.3 < narrow.angle_deg < 0.6
    assert contradictory.in_front == pytest.approx(1 - 20 / 60, abs=0.05)


def test_points_at_infinity_are_in_front_of_no_camera(monkeypatch):
    points = np.array([[np.inf] * 3, [0.1, 0.2, 3.0]])
    monkeypatch.setattr("sfm_app.geometry.epipolar.triangulate", lambda *_: points)
    seed = two_view_seed(cross_matrix([0.0, 0.0, 1.0]), np.zeros((2, 2)), np.zeros((2, 2)))
    assert seed.in_front == 0.5 and not seed.usable[0]
