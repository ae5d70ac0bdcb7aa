"""The readout of a shutter on synthetic walks."""

import numpy as np
import pytest

from sfm_app.bundle.lens_parts import LensPriors
from sfm_app.bundle.normal_equations import apply_step, best_step, reduce
from sfm_app.bundle.rolling_shutter import estimate_readout

pytestmark = pytest.mark.slow

SCALE_PX = 0.5
ALL = np.array([[True] * 5 + [False] * 2])


def priors(bundle):
    return LensPriors.from_cameras(bundle.params, bundle.family, np.array([[1280.0, 720.0]]), ALL)


def ignore_shutter(bundle):
    """The bundle after an adjustment that knows of no shutter."""
    for _ in range(8):
        reduced = reduce(bundle, SCALE_PX)
        bundle = best_step(bundle, reduced, bundle.params, SCALE_PX)
    return bundle


def measure(film, **how):
    bundle = ignore_shutter(film.bundle)
    return estimate_readout(bundle, film.rows, priors(bundle), ALL, SCALE_PX, **how)


@pytest.mark.parametrize(
    ("readout_s", "speed", "swing_deg_s"), [(0.01, 1.4, 30.0), (0.03, 1.4, 0.0), (-0.02, 0.7, 90.0)]
)
def test_the_readout_is_found_as_accurately_as_said(film, readout_s, speed, swing_deg_s):
    found = measure(film(readout_s, frames=20, speed=speed, swing_deg_s=swing_deg_s))

    assert found.readout == pytest.approx(readout_s, rel=0.15)
    assert abs(found.readout - readout_s) < 2.0 * found.deviation
    assert 0.005 * abs(readout_s) < found.deviation < abs(readout_s) / 3.0


@pytest.mark.parametrize("seed", range(2))
def test_a_global_shutter_has_no_readout(film, seed):
    found = measure(film(0.0, frames=20, swing_deg_s=30.0, seed=seed))

    assert abs(found.readout) < found.deviation
    assert 1e-5 < found.deviation < 0.003


def test_straight_on_with_parallel_views_tells_nothing(film):
    """A shutter that sees such a walk shears the scene, and nothing contradicts it."""
    found = measure(film(0.03, frames=20, shake=0.0))

    assert found.deviation > 0.01


def test_poses_are_those_of_the_middle_rows(film):
    bent = film(0.03, frames=20, swing_deg_s=60.0)
    true, ignored = bent.bundle, ignore_shutter(bent.bundle)

    found = estimate_readout(ignored, bent.rows, priors(ignored), ALL, SCALE_PX)

    errors = [np.median(turn_errors_deg(one.R, true.R)) for one in (ignored, found.bundle)]
    assert errors[0] > 0.2
    assert errors[1] < 0.25 * errors[0]


def turn_errors_deg(R, S):
    """Of relative rotations of photos a second apart."""
    ours, true = (np.einsum("nij,nkj->nik", one[10:], one[:-10]) for one in (R, S))
    traces = np.einsum("nij,nij->n", ours, true)
    return np.degrees(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))


def test_a_known_readout_is_kept(film):
    found = measure(film(0.02, frames=12, swing_deg_s=60.0), known=0.02)

    assert found.readout == 0.02 and found.deviation == 0.0


def test_an_earlier_estimate_shortens_the_way(film):
    walk = film(0.02, frames=12, swing_deg_s=60.0)
    first = measure(walk)

    again = estimate_readout(first.bundle, walk.rows, priors(first.bundle), ALL, SCALE_PX, first)

    assert again.readout == pytest.approx(first.readout, abs=0.3 * first.deviation)


def test_the_same_bundle_gives_the_same_numbers(film):
    walk = film(0.02, frames=12, swing_deg_s=60.0)

    first, second = measure(walk), measure(walk)

    assert first.readout == second.readout and np.array_equal(first.bundle.R, second.bundle.R)


def test_points_far_off_do_not_stop_it(film):
    walk = film(0.02, frames=12, swing_deg_s=60.0)
    away = np.zeros_like(walk.bundle.X)
    away[:5] = 1e9
    bundle = apply_step(walk.bundle, walk.bundle.params, np.zeros((12, 6)), away)

    found = estimate_readout(bundle, walk.rows, priors(bundle), ALL, SCALE_PX)

    assert found.readout == pytest.approx(0.02, rel=0.15)
