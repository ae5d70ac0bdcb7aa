"""Design matrix, eigenvalues, and the solvers of minimal samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sfm_app.fundamental.points import prepare
from sfm_app.fundamental.solvers import (
    LANES,
    decompose_symmetric,
    design_row,
    is_oriented,
    quadratic_forms,
    real_cubic_roots,
    solve_five_point,
    solve_sample,
    weighted_gram,
)
from sfm_app.geometry.epipolar import cross_matrix, nearest_rank_two
from sfm_app.synthetic.correspondences import PairOptions, make_pair

SIZES = [2, 7, LANES - 1, LANES, LANES + 1, 3 * LANES, 200]


def dense(points):
    h1, h2 = (np.column_stack([points[:, k : k + 2], np.ones(len(points))]) for k in (0, 2))
    return (h2[:, :, None] * h1[:, None, :]).reshape(-1, 9)


def matches(count):
    return np.asfortranarray(np.random.default_rng(count).normal(size=(count, 4)))


def test_a_row_is_the_constraint():
    rng = np.random.default_rng(0)
    point, F, row = rng.normal(size=4), rng.normal(size=(3, 3)), np.empty(9)
    design_row(point, row)
    assert row @ F.reshape(9) == pytest.approx(np.append(point[2:], 1) @ F @ np.append(point[:2], 1))
    np.testing.assert_allclose(row, dense(point[None])[0])


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_gram_is_the_weighted_product(count, share):
    points, rng = matches(count), np.random.default_rng(count)
    weights = rng.uniform(size=count) * (rng.uniform(size=count) < share)
    A = dense(points)
    gram = weighted_gram(points, weights)
    np.testing.assert_allclose(gram, (A.T * weights) @ A, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(gram, gram.T)


def test_matches_without_weight_may_be_anything():
    points, weights = matches(100), np.ones(100)
    weights[40:45] = 0
    expected = weighted_gram(points, weights)
    points[40:45] = np.nan
    np.testing.assert_array_equal(weighted_gram(points, weights), expected)


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("directions", [1, 8])
def test_forms_are_squared_lengths(count, directions):
    points = matches(count)
    whitening = np.random.default_rng(directions).normal(size=(9, directions))
    forms = quadratic_forms(points, whitening)
    np.testing.assert_allclose(forms, ((dense(points) @ whitening) ** 2).sum(axis=1), rtol=1e-12, atol=1e-12)


def eigen(matrix):
    size = len(matrix)
    values, vectors = np.empty(size), np.empty((size, size))
    decompose_symmetric(matrix.copy(), values, vectors)
    return values, vectors


def check(matrix, expected):
    values, vectors = eigen(matrix)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(values, np.sort(expected), rtol=0, atol=1e-14 * len(matrix) * scale)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(len(matrix)), atol=1e-13)
    np.testing.assert_allclose(matrix @ vectors, vectors * values, rtol=0, atol=1e-13 * len(matrix) * scale)


@pytest.mark.parametrize("size", range(2, 10))
@pytest.mark.parametrize("seed", range(3))
def test_values_and_vectors_are_those_of_numpy(size, seed):
    A = np.random.default_rng([size, seed]).normal(size=(size, size))
    matrix = A + A.T
    expected = np.linalg.eigh(matrix)
    check(matrix, expected.eigenvalues)
    # with signs free: every vector is the same direction
    np.testing.assert_allclose(np.abs((eigen(matrix)[1] * expected.eigenvectors).sum(axis=0)), 1, atol=1e-9)


@pytest.mark.parametrize(
    "values", [[1, 1], [0, 0, 5], [2, 2, 2], [-3, -3, 1, 1], [0] * 5 + [1] * 4, [1e-12, 1e-6, 1, 1e6], [0, 0, 0]]
)
def test_repeated_and_far_apart_values(values):
    for seed in range(5):
        Q = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(values),) * 2))[0]
        matrix = Q * np.array(values, dtype=float) @ Q.T
        check((matrix + matrix.T) / 2, np.array(values, dtype=float))


def test_what_is_not_finite_ends():
    values, _ = eigen(np.full((9, 9), np.nan))
    assert np.isnan(values).all()


@pytest.mark.parametrize("scale", [1e-60, 1e60])
def test_scale_does_not_matter(scale):
    A = np.random.default_rng(1).normal(size=(9, 9))
    plain, scaled = eigen(A @ A.T), eigen(scale * (A @ A.T))
    np.testing.assert_allclose(scaled[0], scale * plain[0], rtol=1e-10)
    np.testing.assert_allclose(scaled[1], plain[1], atol=1e-10)


ROOTS = st.floats(-10, 10)


def exact_sample(seed):
    pair = make_pair(PairOptions(points=8), seed)
    m = prepare(pair.exact_x1[:7], pair.exact_x2[:7], seed)
    return pair, m


def solve(points):
    models = np.zeros((3, 9))
    count = solve_sample(points, np.arange(7), models)
    return models[:count]


@settings(max_examples=200, deadline=None)
@given(seed=st.integers(0, 100_000))
def test_solutions_pass_through_the_sample_and_hold_the_truth(seed):
    pair, m = exact_sample(seed)

    models = solve(m.points)

    assert len(models) in (1, 3)
    row = np.empty(9)
    for f in models:
        assert np.linalg.norm(f) == pytest.approx(1, abs=1e-9)
        assert abs(np.linalg.det(f.reshape(3, 3))) < 1e-9
        for point in m.points:
            design_row(point, row)
            assert abs(row @ f) < 1e-8
    true = pair.F / np.linalg.norm(pair.F) * np.sign(pair.F.flat[np.argmax(np.abs(pair.F))])
    errors = [np.abs(m.to_pixels(f.reshape(3, 3)) - true).max() for f in models]
    assert min(errors) < 1e-4


@pytest.mark.parametrize("case", ["repeated", "coplanar", "collinear"])
def test_dependent_samples_have_no_solution(case):
    rng = np.random.default_rng(4)
    points = np.asfortranarray(rng.normal(size=(7, 4)))
    if case == "repeated":
        points[6] = points[2]
    if case == "coplanar":
        h = np.column_stack([points[:, :2], np.ones(7)]) @ np.array([[1, 0.1, 0], [0.2, 0.9, 0.3], [0.1, 0.05, 1]]).T
        points[:, 2:] = h[:, :2] / h[:, 2:]
    if case == "collinear":
        points[:, 1], points[:, 3] = points[:, 0], 0.5 * points[:, 2]
    assert len(solve(points)) == 0
    assert solve_sample(points[:4].repeat(2, axis=0).copy(order="F"), np.arange(8), np.empty((3, 9))) == 0


@settings(deadline=None)
@given(a=ROOTS, b=ROOTS, c=ROOTS, lead=st.floats(0.1, 10))
def test_three_real_roots_are_found(a, b, c, lead):
    p = lead * np.poly([a, b, c])[::-1]
    roots = np.empty(3)
    count = real_cubic_roots(*p, roots)
    # close roots are ill-conditioned, so what counts is that the polynomial vanishes there
    assert count in (1, 3)
    assert np.abs(np.polyval(p[::-1], roots[:count])).max() < 1e-9 * lead * (1 + np.abs([a, b, c]).max()) ** 3
    if min(abs(a - b), abs(b - c), abs(c - a)) > 0.1:
        assert count == 3
        np.testing.assert_allclose(np.sort(roots), np.sort([a, b, c]), atol=1e-6)


@settings(deadline=None)
@given(a=ROOTS, real=ROOTS, imaginary=st.floats(0.1, 10))
def test_one_real_root_is_found(a, real, imaginary):
    p = np.poly([a, real + 1j * imaginary, real - 1j * imaginary]).real[::-1]
    roots = np.empty(3)
    assert real_cubic_roots(*p, roots) == 1
    assert roots[0] == pytest.approx(a, abs=1e-6)


def test_a_quadratic_is_no_cubic():
    assert real_cubic_roots(1.0, 2.0, 3.0, 0.0, np.empty(3)) == 0


def test_real_cameras_are_oriented_and_a_point_behind_is_not():
    rng = np.random.default_rng(0)
    for _ in range(50):
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        R *= np.linalg.det(R)
        X2 = np.column_stack([rng.uniform(-1, 1, (7, 2)), np.ones(7)]) * rng.uniform(2, 4, (7, 1))
        t = rng.normal(size=3)
        X1 = (X2 - t) @ R  # X2 = R X1 + t
        points = np.asfortranarray(np.column_stack([X1[:, :2] / X1[:, 2:], X2[:, :2] / X2[:, 2:]]))
        front = X1[:, 2] > 0
        f = (cross_matrix(t) @ R).reshape(9)
        assert is_oriented(points, np.arange(7), f) == (front.all() or not front.any())
        assert is_oriented(points, np.arange(7), -f) == (front.all() or not front.any())


def test_eight_exact_matches_give_the_one_model():
    pair = make_pair(PairOptions(points=40, sigma_px=0), 3)
    m, models = prepare(pair.x1, pair.x2, 0), np.empty((3, 9))
    for start in range(0, 32, 8):
        assert solve_sample(m.points, np.arange(start, start + 8), models) == 1
        F = m.to_pixels(models[0].reshape(3, 3))
        np.testing.assert_allclose(F, pair.F * np.sign((F * pair.F).sum()), atol=1e-8)


@pytest.mark.parametrize("seed", range(8))
def test_eight_noisy_matches_give_the_nearest_matrix_of_rank_two(seed):
    points, models = np.asfortranarray(np.random.default_rng(seed).normal(size=(8, 4))), np.empty((3, 9))
    design = np.empty((8, 9))
    for k in range(8):
        design_row(points[k], design[k])
    linear = np.linalg.svd(design)[2][8].reshape(3, 3)
    expected = nearest_rank_two(linear)

    assert solve_sample(points, np.arange(8), models) == 1

    F = models[0].reshape(3, 3)
    assert np.linalg.norm(F) == pytest.approx(1)
    assert np.linalg.svd(F, compute_uv=False)[2] < 1e-14
    weakest = np.linalg.svd(linear, compute_uv=False)
    # two singular values that are nearly equal: either direction will do
    sharp = weakest[2] < 0.8 * weakest[1]
    np.testing.assert_allclose(abs((F * expected).sum()) / np.linalg.norm(expected), 1, atol=1e-12 if sharp else 0.05)


def samples(seed, count=20):
    """Rays in all directions, seen from two places."""
    rng = np.random.default_rng(seed)
    R, t = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    X = rng.normal(size=(count, 5, 3)) * 3.0
    Y = X @ R.T + t
    p, q = (Z / np.linalg.norm(Z, axis=2, keepdims=True) for Z in (X, Y))
    E = cross_matrix(t) @ R
    return p, q, E / np.linalg.norm(E)


@pytest.mark.parametrize("seed", range(5))
def test_the_true_matrix_is_among_the_solutions_of_every_sample(seed):
    p, q, E = samples(seed)
    for first, second in zip(p, q, strict=True):
        found = solve_five_point(first[None], second[None])
        away = np.minimum(np.linalg.norm(found - E, axis=(1, 2)), np.linalg.norm(found + E, axis=(1, 2)))
        assert 1 <= len(found) <= 10
        assert away.min() < 1e-6


def test_every_solution_is_an_essential_matrix_through_its_sample():
    p, q, _ = samples(1, count=1)
    for E in solve_five_point(p, q):
        values = np.linalg.svd(E, compute_uv=False)
        assert values[0] == pytest.approx(values[1], rel=1e-6) and values[2] < 1e-7
        assert np.abs(np.einsum("ni,ij,nj->n", q[0], E, p[0])).max() < 1e-7


def test_five_times_the_same_ray_gives_nothing_or_numbers():
    p = np.tile([0.0, 0.0, 1.0], (3, 5, 1))
    assert np.isfinite(solve_five_point(p, p)).all()
