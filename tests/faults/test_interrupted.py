"""Ctrl-C: exit code 130, a line how to go on, and the same command ends with the same bytes."""

import os

import pytest

ALWAYS = {"matching:10"}
POINTS = ["features:10", "matching:10", "undistorting:0", *[f"before:{tenth / 10}" for tenth in range(1, 10)]]

needs_time = pytest.mark.skipif("SFM_APP_FAULTS" not in os.environ, reason="`make faults` tries all points")


@pytest.mark.parametrize("point", [pytest.param(p, marks=() if p in ALWAYS else needs_time) for p in POINTS])
def test_an_interrupted_run_says_how_to_go_on_and_does_so(undisturbed, refused, tmp_path, point):
    when, amount = point.split(":")
    moment = f"{when}:{undisturbed.moment(float(amount)) if when == 'before' else amount}"
    out = tmp_path / "out"

    interrupted = undisturbed.run(out, "interrupt", moment)
    again = undisturbed.run(out)

    refused(interrupted, 130)
    assert "run the same command again to resume" in interrupted.stderr
    assert again.returncode == 0, again.stderr
    assert undisturbed.result(out) == undisturbed.result(undisturbed.out)
