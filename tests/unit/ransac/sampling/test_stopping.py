"""Stopping rules."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.fundamental.samples import CONVERGED, has_converged, required_trials


@pytest.mark.parametrize(
    ("share", "confidence", "expected"),
    [(0.5, 0.99, 587.2), (0.8, 0.99, 19.5), (1.0, 0.99, 1.0), (0.0, 0.99, np.inf), (1e-60, 0.99, np.inf)],
)
def test_known_trial_counts(share, confidence, expected):
    assert required_trials(share**7, confidence) == pytest.approx(expected, rel=5e-3)


@given(share=st.floats(0.1, 0.99), confidence=st.floats(0.5, 0.9999))
def test_so_many_trials_miss_with_the_wanted_probability(share, confidence):
    trials = required_trials(share**7, confidence)
    assert (1 - share**7) ** trials == pytest.approx(1 - confidence, rel=1e-6)


@given(n=st.integers(1, 5000), scale=st.floats(0.01, 100))
def test_equal_priors_have_converged_whatever_their_scale(n, scale):
    p = np.random.default_rng(n).uniform(0.1, 1, n)
    assert has_converged(p, scale * p)


def test_moved_mass_is_counted_twice():
    before = np.ones(1000)
    after = before.copy()
    after[:500] = 0.0
    assert not has_converged(before, after)  # sums to 1
    after[:500] = 1 - CONVERGED * 0.9
    assert has_converged(before, after)
    assert not has_converged(before, after, limit=CONVERGED / 4)
