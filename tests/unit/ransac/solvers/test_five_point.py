import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.fundamental.solvers import solve_five_point
from sfm_app.geometry.epipolar import cross_matrix


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
