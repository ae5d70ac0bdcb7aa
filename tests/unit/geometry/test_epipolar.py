"""The 8-point algorithm and what follows from F."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.errors import NumericalError
from sfm_app.geometry.epipolar import (
    canonical_cameras,
    cross_matrix,
    eight_point,
    epipoles,
    fundamental_from_pose,
    hartley_normalization,
    nearest_rank_two,
    sampson_distance,
    to_homogeneous,
    to_unit_norm,
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


def test_eight_point_on_eight_matches():
    pair = make_pair(PairOptions(points=8), 1)
    F = eight_point(pair.exact_x1, pair.exact_x2)
    assert same_up_to_sign(F, to_unit_norm(pair.F)) < 1e-6


def test_eight_point_follows_its_weights():
    pair = make_pair(PairOptions(points=100, outliers=0.3), 2)

    weighted = eight_point(pair.x1, pair.x2, weights=pair.is_inlier)
    blind = eight_point(pair.x1, pair.x2)

    good = pair.x1[pair.is_inlier], pair.x2[pair.is_inlier]
    assert np.median(sampson_distance(weighted, *good)) < 2
    assert np.median(sampson_distance(blind, *good)) > 4


def test_eight_point_needs_eight():
    with pytest.raises(NumericalError, match="needs 8 matches, got 7"):
        eight_point(np.random.default_rng(0).normal(size=(7, 2)), np.ones((7, 2)))


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
def test_unit_norm_refuses_what_has_none(F):
    with pytest.raises(NumericalError, match="zero or not finite"):
        to_unit_norm(F)


def test_pose_gives_the_matrix_of_the_synthetic_pair():
    pair = make_pair(PairOptions(points=20), 3)

    F = fundamental_from_pose(pair.K1, pair.K2, pair.R, pair.t)

    assert same_up_to_sign(F, pair.F) < 1e-12
    e1, e2 = epipoles(F)
    assert np.abs(F @ e1).max() < 1e-12
    assert np.abs(F.T @ e2).max() < 1e-12
    center1_in_2 = pair.K2 @ pair.t
    assert np.abs(np.cross(e2, center1_in_2 / np.linalg.norm(center1_in_2))).max() < 1e-9


def test_pose_without_baseline_has_none():
    with pytest.raises(NumericalError, match="zero"):
        fundamental_from_pose(np.eye(3), np.eye(3), np.eye(3), np.zeros(3))


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


def test_canonical_cameras_of_nothing_do_not_exist():
    with pytest.raises(NumericalError, match="zero or not finite"):
        canonical_cameras(np.zeros((3, 3)))
