"""What every calibrator checks first."""

import numpy as np
import pytest

from sfm_app.selfcal import pair_weights
from sfm_app.selfcal.pairs import prepare
from sfm_app.types import CameraPairs

FRAME = {"unit_px": 1000.0, "origin_px": (500.0, 375.0)}


def test_weights_rise_with_the_inliers_up_to_one():
    np.testing.assert_allclose(pair_weights([0, 150, 300, 9000]), [0, 0.5, 1, 1])


def test_epipolar_geometry_survives_the_change_of_units(views):
    made = views(3, noise=0.0)
    pairs = prepare(CameraPairs.from_Fs(made.Fs, made.size, made.weights), **FRAME)
    to_units = np.array([[1e-3, 0, -0.5], [0, 1e-3, -0.375], [0, 0, 1]])
    rng = np.random.default_rng(0)
    x1, x2 = (np.column_stack([rng.uniform(0, 700, (20, 2)), np.ones(20)]) for _ in range(2))
    in_px = np.einsum("ni,pij,nj->pn", x2, made.Fs, x1)
    in_units = np.einsum("ni,pij,nj->pn", x2 @ to_units.T, pairs.F, x1 @ to_units.T)
    scale = in_units / in_px  # one per pair
    np.testing.assert_allclose(scale, np.broadcast_to(scale[:, :1], scale.shape), rtol=1e-6)


def test_parts_belong_to_the_matrix(views):
    made = views(4, noise=0.05)
    pairs = prepare(CameraPairs.from_Fs(made.Fs, made.size, made.weights), **FRAME)
    s = np.linalg.svd(pairs.F, compute_uv=False)
    assert len(pairs) == 6
    assert np.all(s[:, 2] < 1e-15)
    np.testing.assert_allclose(pairs.product, s[:, 0] * s[:, 1])
    np.testing.assert_allclose(np.einsum("pij,pj->pi", pairs.F, pairs.e1), 0, atol=1e-15)
    np.testing.assert_allclose(np.einsum("pij,pi->pj", pairs.F, pairs.e2), 0, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(pairs.e1, axis=1), 1)
    np.testing.assert_allclose(np.linalg.norm(pairs.e2, axis=1), 1)


@pytest.mark.parametrize("scale", [1e-200, -1.0, 1e200])
def test_scale_does_not_matter(views, scale):
    made = views(3)
    plain = prepare(CameraPairs.from_Fs(made.Fs, made.size, made.weights), **FRAME)
    scaled = prepare(CameraPairs.from_Fs(scale * made.Fs, made.size, made.weights), **FRAME)
    np.testing.assert_allclose(np.abs(scaled.F), np.abs(plain.F), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(scaled.product, plain.product)


def test_pairs_without_weight_are_left_out(views):
    made = views(3)
    pairs = prepare(CameraPairs.from_Fs(made.Fs, made.size, [1.0, 0.0, 0.5]), **FRAME)
    np.testing.assert_array_equal(pairs.weights, [1, 0.5])
    assert len(pairs) == 2


def test_repeated_matrices_count_once(views):
    made = views(3)
    Fs = np.concatenate([made.Fs, -3 * made.Fs, made.Fs.transpose(0, 2, 1), 1e9 * made.Fs])
    pairs = prepare(CameraPairs.from_Fs(Fs, made.size, np.arange(1.0, 13)), **FRAME)
    np.testing.assert_array_equal(pairs.weights, [1, 2, 3])
    assert (
        len(prepare(CameraPairs.from_Fs(made.Fs + 1e-6 * np.abs(made.Fs).max(), made.size, made.weights), **FRAME)) == 3
    )


def test_no_pairs_are_fine():
    assert len(prepare(CameraPairs.from_Fs([], (4, 3), []), **FRAME)) == 0


F = np.eye(3)[None]


@pytest.mark.parametrize(
    ("Fs", "weights", "size", "message"),
    [
        (np.eye(3), [1.0], (4, 3), "shape"),
        (np.ones((2, 3, 4)), [1.0, 1.0], (4, 3), "shape"),
        (F, [1.0, 1.0], (4, 3), "one per fundamental matrix"),
        (F, 1.0, (4, 3), "one per fundamental matrix"),
        (np.full((1, 3, 3), np.nan), [1.0], (4, 3), "finite"),
        (np.full((1, 3, 3), np.inf), [1.0], (4, 3), "finite"),
        (F, [np.nan], (4, 3), "weights"),
        (F, [-1.0], (4, 3), "weights"),
        (np.zeros((1, 3, 3)), [1.0], (4, 3), "zero"),
        (F, [1.0], (0, 3), "size"),
        (F, [1.0], (4, np.nan), "size"),
    ],
)
def test_malformed_input_is_refused(Fs, weights, size, message):
    with pytest.raises(ValueError, match=message):
        prepare(CameraPairs.from_Fs(Fs, size, weights), **FRAME)
