"""Steps that are damped until they lower the cost."""

import numpy as np
import pytest

from sfm_app.geometry.least_squares import DampingRange, damped_step

LIMITS = DampingRange(first=1e-4, least=1e-9, most=1e3)


def test_a_good_step_is_taken_at_once_and_the_next_is_bolder():
    assert damped_step(lambda damping: damping, 1e-4, LIMITS) == (1e-4, pytest.approx(1e-5))
    assert damped_step(lambda damping: damping, 1e-9, LIMITS) == (1e-9, 1e-9)


def test_damping_grows_tenfold_until_a_step_lowers_the_cost():
    tried = []

    def attempt(damping):
        tried.append(damping)
        return "found" if damping > 0.5 else None

    found, left = damped_step(attempt, 1e-2, LIMITS)

    assert (found, left) == ("found", pytest.approx(0.1))
    np.testing.assert_allclose(tried, [1e-2, 0.1, 1.0])


def test_it_gives_up_where_no_step_helps():
    found, left = damped_step(lambda _: None, 1.0, LIMITS)
    assert found is None and left >= LIMITS.most
