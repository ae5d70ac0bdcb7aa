"""The constraint in closed form against E = K'FK itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.selfcal.consensus import singular_value_ratio
from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis.curves import center_polynomials, focal_polynomials
from sfm_app.types import CameraPairs

seeds = st.integers(0, 2**32 - 1)


def random_pairs(seed, count=3):
    rng = np.random.default_rng(seed)
    return prepare(
        CameraPairs.from_Fs(rng.normal(size=(count, 3, 3)), (1, 1), np.ones(count)), unit_px=1.0, origin_px=(0.0, 0.0)
    )


def essential(F, fx, fy, u, v):
    K = np.array([[fx, 0, u], [0, fy, v], [0, 0, 1]])
    return K.T @ F @ K


def thesis_5_25(E):
    S = E @ E.T
    return 2 * np.trace(S @ S) - np.trace(S) ** 2


def ratio(pairs, i, *camera):
    return singular_value_ratio(pairs.packed_rows[i], *camera)


@settings(max_examples=60, deadline=None)
@given(seeds, st.floats(0.2, 5), st.floats(0.2, 5), st.floats(-1, 1), st.floats(-1, 1))
def test_ratio_is_that_of_the_singular_values(seed, fx, fy, u, v):
    pairs = random_pairs(seed)
    for i in range(len(pairs)):
        s = np.linalg.svd(essential(pairs.F[i], fx, fy, u, v), compute_uv=False)
        assert ratio(pairs, i, fx, fy, u, v) == pytest.approx((s[0] - s[1]) / (s[0] + s[1]), abs=2e-7)


@settings(max_examples=40, deadline=None)
@given(seeds, st.floats(0.2, 3), st.floats(0.2, 3), st.floats(-1, 1), st.floats(-1, 1))
def test_polynomials_are_thesis_5_25(seed, fx, fy, u, v):
    pairs = random_pairs(seed)
    in_fy = focal_polynomials(pairs, np.array([fx]), (u, v))[:, 0] @ (fy**2) ** np.arange(5)
    in_v = center_polynomials(pairs, np.array([u]), (fx, fy))[:, 0] @ v ** np.arange(9)
    for i in range(len(pairs)):
        E = essential(pairs.F[i], fx, fy, u, v)
        size = np.trace(E @ E.T) ** 2
        assert in_fy[i] == pytest.approx(thesis_5_25(E), abs=1e-9 * size + 1e-12)
        assert in_v[i] == pytest.approx(thesis_5_25(E), abs=1e-9 * size + 1e-12)


def test_every_swept_sample_has_its_polynomial():
    pairs = random_pairs(1)
    sweep = np.array([0.5, 1.0, 2.0])
    for whole, one in (
        (focal_polynomials(pairs, sweep, (0.1, 0.2)), focal_polynomials(pairs, sweep[1:2], (0.1, 0.2))),
        (center_polynomials(pairs, sweep, (1.0, 1.1)), center_polynomials(pairs, sweep[1:2], (1.0, 1.1))),
    ):
        assert whole.shape[:2] == (3, 3)
        np.testing.assert_array_equal(whole[:, 1], one[:, 0])
        assert np.all(np.ptp(whole, axis=1).max(axis=1) > 0)


def test_the_true_camera_satisfies_the_constraint(views):
    made = views(4, noise=0.0, focal=900, aspect=1.2, center=(420, 400))
    pairs = prepare(CameraPairs.from_Fs(made.Fs, made.size, made.weights), unit_px=1000.0, origin_px=(0.0, 0.0))
    K = made.K / 1000
    for i in range(len(pairs)):
        assert ratio(pairs, i, K[0, 0], K[1, 1], K[0, 2], K[1, 2]) < 1e-6
        assert ratio(pairs, i, 1.3 * K[0, 0], 1.3 * K[1, 1], K[0, 2], K[1, 2]) > 1e-3


def test_translation_satisfies_it_with_any_camera(views):
    made = views(3, noise=0.0, motion=views.translation)
    pairs = prepare(CameraPairs.from_Fs(made.Fs, made.size, made.weights), unit_px=1000.0, origin_px=(0.0, 0.0))
    assert ratio(pairs, 0, 0.4, 2.0, 0.9, -0.3) < 1e-6
    assert not np.any(focal_polynomials(pairs, np.array([0.3, 1.0, 3.0]), (0.5, 0.4)))
    assert not np.any(center_polynomials(pairs, np.array([0.3, 1.0]), (1.0, 1.1)))


def test_a_matrix_of_rank_one_is_as_far_from_it_as_can_be():
    pairs = prepare(
        CameraPairs.from_Fs(np.outer([1, 2, 3], [4, 5, 6])[None], (1, 1), [1.0]), unit_px=1.0, origin_px=(0.0, 0.0)
    )
    assert ratio(pairs, 0, 1.0, 1.0, 0.0, 0.0) == pytest.approx(1)
