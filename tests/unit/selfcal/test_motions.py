"""Motions that leave the focal open, with matches: a confident wrong camera is the worst outcome."""

import numpy as np
import pytest

from sfm_app.selfcal.zero_curves import calibrate
from sfm_app.settings import CalibrationSettings

OPTIONS = CalibrationSettings()


def off(found, made, k1):
    """Largest error in standard deviations of the answer; 0 where there is none."""
    if not found.identifiable:
        return 0.0
    errors = [*(found.K - made.Ks[0])[[0, 1, 0, 1], [0, 1, 2, 2]], found.radial - k1]
    return np.max(np.abs(errors) / [found.spread[name] for name in ("fx", "fy", "cx", "cy", "k1")])


@pytest.mark.parametrize("motion", ["orbit", "parallel", "onward"])
@pytest.mark.parametrize(("k1", "count"), [(0.0, 4), pytest.param(-0.1, 5, marks=pytest.mark.slow)])
def test_critical_motions_give_a_guess(shots, motion, k1, count):
    made = shots(count, 0, motion=getattr(shots, motion), k1=k1, points=120)
    found = calibrate(made.pairs, OPTIONS, 0)
    assert not found.identifiable
    assert (found.method, found.radial, found.spread, found.held) == ("guess", 0.0, {}, ())
    assert found.reason


@pytest.mark.slow
@pytest.mark.parametrize("motion", ["level", "turning"])
@pytest.mark.parametrize(("k1", "count"), [(0.0, 4), (-0.1, 5)])
def test_nearly_critical_motions_give_no_overstated_answer(shots, motion, k1, count):
    for seed in range(1 if k1 else 3):
        made = shots(count, seed, motion=getattr(shots, motion), k1=k1, points=120)
        assert off(calibrate(made.pairs, OPTIONS, seed), made, k1) < 3


@pytest.mark.slow
def test_a_camera_that_only_turns_on_the_spot_gives_no_wrong_answer(shots):
    # no baseline: every F is one of many that fit
    for seed in range(2):
        made = shots(5, seed, motion=lambda rng, n: [(R, np.array([0, 0, -5.0])) for R, _ in shots.turning(rng, n)])
        assert off(calibrate(made.pairs, OPTIONS, seed), made, 0.0) < 3
