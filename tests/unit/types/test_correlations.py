import numpy as np
import pytest

from sfm_app.types.camera import named_correlations


def test_pairs_of_parameters_have_the_correlation_of_drawn_values():
    root = np.array([[2.0, 0.0, 0.0], [-30.0, 10.0, 0.0], [0.001, 0.0, 0.003]])
    drawn = np.random.default_rng(0).normal(size=(20_000, 3)) @ root.T
    expected = np.corrcoef(drawn.T)

    found = named_correlations(("fx", "cx", "k1"), root @ root.T)

    assert list(found) == ["fx cx", "fx k1", "cx k1"]
    assert list(found.values()) == pytest.approx(expected[np.triu_indices(3, 1)], abs=0.02)


def test_what_is_fixed_or_unknown_depends_on_nothing():
    covariance = np.diag([1.0, 0.0, np.inf, 4.0])
    covariance[0, 3] = covariance[3, 0] = 3.0  # more than a covariance can be: rounding may do so

    assert named_correlations(("a", "b", "c", "d"), covariance) == {"a d": 1.0}
    assert named_correlations((), np.zeros((0, 0))) == {}
