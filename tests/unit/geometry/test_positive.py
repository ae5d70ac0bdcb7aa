import numpy as np
import pytest

from sfm_app.geometry.positive import inverse_of_positive, solve_positive


@pytest.mark.parametrize("n", [1, 7, 8, 9, 37])
def test_positive_systems_are_solved(n):
    rng = np.random.default_rng(n)
    A = rng.normal(size=(n + 5, n))
    S, B = A.T @ A, rng.normal(size=(n, 3))

    assert S @ solve_positive(S, B) == pytest.approx(B, abs=1e-8)
    inverse = inverse_of_positive(S)
    assert inverse @ S == pytest.approx(np.eye(n), abs=1e-8)
    assert np.array_equal(inverse, inverse.T)


def test_the_arguments_stay_as_they_are():
    S, B = np.diag([1.0, 2.0, 4.0]), np.eye(3)
    solve_positive(S, B)

    assert np.array_equal(S, np.diag([1.0, 2.0, 4.0])) and np.array_equal(B, np.eye(3))
