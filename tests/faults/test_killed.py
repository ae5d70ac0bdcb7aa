"""`kill -9`, then the same command again: the same bytes as a run that nobody disturbed."""

import json
import os

import pytest

KILLED = -9
STEPS = 15
"""So many steps lie between the first file that appears and the last."""
ALWAYS = {"after:12", "matching:60"}
IN_COLMAP = [f"{what}:{ms}" for what in ("features", "matching", "undistorting") for ms in (0, 60, 400)]

needs_time = pytest.mark.skipif("SFM_APP_FAULTS" not in os.environ, reason="`make faults` tries all points")


POINTS = [f"{when}:{step}" for when in ("before", "after") for step in range(STEPS + 1)] + IN_COLMAP


@pytest.mark.parametrize("point", [pytest.param(p, marks=() if p in ALWAYS else needs_time) for p in POINTS])
def test_a_killed_run_ends_with_the_same_bytes(undisturbed, tmp_path, point):
    when, amount = point.split(":")
    if when in ("before", "after"):
        amount = str(undisturbed.moment(int(amount) / STEPS))
    out = tmp_path / "out"

    killed = undisturbed.run(out, "kill", f"{when}:{amount}")
    assert killed.returncode == KILLED, killed.stderr
    stages = json.loads((out / "manifest.json").read_text())["stages"] if (out / "manifest.json").exists() else {}
    for stage in stages.values():  # the manifest is never ahead of the files
        assert all((out / name).exists() for name in stage["files"])
    again = undisturbed.run(out)

    assert again.returncode == 0, again.stderr
    assert undisturbed.result(out) == undisturbed.result(undisturbed.out)
