"""A disk that is full at any stage: one line, and the same command goes on when there is room again.

A limit on the size of files stands for the disk: whoever writes past it is told so, as by a full disk.
"""

import os
import shutil
import subprocess
import sys

import pytest

from .conftest import QUICK

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on the size of files")
needs_time = pytest.mark.skipif("SFM_APP_FAULTS" not in os.environ, reason="`make faults` tries all of them")

FIRST = {  # last finished stage, and kilobytes that a file may have from then on
    "": (2, 60, 400, 1500),
    "match_graph": (20, 200),
    "view_graph": (100, 300),
    "scene": (30, 100, 300),
    "depth_maps": (60, 1000),
    "texture": (60, 150),
}
ALWAYS = {("scene", 30)}
CASES = [(stage, limit) for stage, limits in FIRST.items() for limit in limits]


@pytest.fixture(scope="session")
def finished(undisturbed, tmp_path_factory):
    """Output folders of runs that ended after a stage."""
    place, made = tmp_path_factory.mktemp("finished"), {}

    def until(stage, out):
        if stage and stage not in made:
            made[stage] = place / stage
            command = [sys.executable, "-m", "sfm_app", "run", str(undisturbed.photos), "-o", str(made[stage]), *QUICK]
            subprocess.run([*command, "--until", stage], check=True, capture_output=True)
        if stage:
            shutil.copytree(made[stage], out, symlinks=True)

    return until


@pytest.mark.parametrize(
    ("stage", "limit"), [pytest.param(*case, marks=() if case in ALWAYS else needs_time) for case in CASES]
)
def test_a_full_disk_is_one_line_and_the_run_goes_on_when_there_is_room(
    undisturbed, finished, refused, tmp_path, stage, limit
):
    out = tmp_path / "out"
    finished(stage, out)

    full = undisturbed.run(out, moment=f"full:{limit}")
    again = undisturbed.run(out)

    refused(full, 3)
    assert "the disk is full" in full.stderr
    assert again.returncode == 0, again.stderr
    assert undisturbed.result(out) == undisturbed.result(undisturbed.out)
