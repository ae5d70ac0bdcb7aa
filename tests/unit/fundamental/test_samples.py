"""Random samples and the number of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.fundamental.samples import (
    CONVERGED,
    SAMPLE_SIZE,
    draw_uniform,
    draw_weighted,
    has_converged,
    random_state,
    required_trials,
    uniform,
)

DRAWS = 20_000


def samples(draw):
    sample = np.empty(SAMPLE_SIZE, dtype=np.int64)
    found = np.empty((DRAWS, SAMPLE_SIZE), dtype=np.int64)
    for row in found:
        draw(sample)
        row[:] = sample
    return found


def test_generator_is_splitmix64():
    # the first outputs for state 0 are those of its authors' reference code
    state = random_state(0)
    expected = [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]
    assert [uniform(state) for _ in range(3)] == [(z >> 11) * 2.0**-53 for z in expected]


def test_uniform_numbers_are_uniform():
    state = random_state(7)
    values = np.array([uniform(state) for _ in range(DRAWS)])
    counts = np.histogram(values, bins=20, range=(0, 1))[0]
    assert counts.sum() == DRAWS
    assert np.abs(counts - DRAWS / 20).max() < 5 * np.sqrt(DRAWS / 20)


def test_uniform_samples_are_distinct_and_fair():
    state = random_state(3)
    found = samples(lambda sample: draw_uniform(state, 20, sample))
    assert all(len(set(row)) == SAMPLE_SIZE for row in found.tolist())
    share = np.bincount(found.ravel(), minlength=20) / DRAWS
    assert np.abs(share - SAMPLE_SIZE / 20).max() < 0.02


def test_weighted_samples_follow_the_weights():
    # the first index of a sample is drawn by the weights alone, the second by the weights without the first
    weights = np.arange(20.0)
    cumulative, state = np.cumsum(weights), random_state(5)
    found = samples(lambda sample: draw_weighted(state, cumulative, sample))
    assert all(len(set(row)) == SAMPLE_SIZE for row in found.tolist())
    assert not (found == 0).any()
    first = np.bincount(found[:, 0], minlength=20) / DRAWS
    assert np.abs(first - weights / weights.sum()).max() < 0.015
    after = found[found[:, 0] == 19, 1]
    second = np.bincount(after, minlength=20)[:19] / len(after)
    assert np.abs(second - weights[:19] / weights[:19].sum()).max() < 0.03


def test_too_few_weights_are_reported():
    sample = np.empty(SAMPLE_SIZE, dtype=np.int64)
    weights = np.zeros(100)
    weights[:6] = 1
    assert not draw_weighted(random_state(0), np.cumsum(weights), sample)
    weights[6] = 1
    assert draw_weighted(random_state(0), np.cumsum(weights), sample)
    assert sorted(sample) == list(range(7))


def test_exactly_as_many_points_as_a_sample_needs():
    sample = np.empty(SAMPLE_SIZE, dtype=np.int64)
    draw_uniform(random_state(1), SAMPLE_SIZE, sample)
    assert sorted(sample) == list(range(7))


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
