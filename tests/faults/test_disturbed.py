"""A run that is killed, interrupted, or loses its disk or its photos: one line, and the next run is right."""

import json
import shutil
import subprocess
import sys

import pytest

from .conftest import QUICK, cases

STEPS = 15
"""Steps between the first file that appears and the last."""
KILLED = [f"{when}:{step}" for when in ("before", "after") for step in range(STEPS + 1)]
KILLED += [f"{what}:{ms}" for what in ("features", "matching", "undistorting") for ms in (0, 60, 400)]
INTERRUPTED = ["features:10", "matching:10", "undistorting:0", *(f"before:{1.5 * tenth}" for tenth in range(1, 10))]
SAYS = {
    "out-gone": "out was removed",
    "out-closed": "cannot write to",
    "photo-gone": "is gone since",
    "photo-changed": "has changed since",
}
CHANGES = [(what, share) for what in SAYS for share in (0.1, 0.3, 0.5, 0.7, 0.9)]
LIMITS_KB = {  # of a file, from the end of a stage on
    "": (2, 60, 400, 1200),
    "match_graph": (20, 200),
    "view_graph": (100, 300),
    "scene": (30, 100, 300),
    "depth_maps": (60, 1000),
    "texture": (60, 120),
}


def moment(folder, point):
    when, amount = point.split(":")
    return f"{when}:{folder.moment(float(amount) / STEPS) if when in ('before', 'after') else amount}"


@pytest.mark.parametrize("point", cases(KILLED, {"after:12", "matching:60"}))
def test_a_killed_run_ends_with_the_same_bytes(undisturbed, tmp_path, point):
    out = tmp_path / "out"
    killed = undisturbed.run(out, "kill", moment(undisturbed, point))
    assert killed.returncode == -9, killed.stderr
    stages = json.loads((out / "manifest.json").read_text())["stages"] if (out / "manifest.json").exists() else {}
    for stage in stages.values():  # the manifest is never ahead of the files
        assert all((out / name).exists() for name in stage["files"])
    undisturbed.finish(out)


@pytest.mark.parametrize("point", cases(INTERRUPTED, {"matching:10"}))
def test_an_interrupted_run_says_how_to_go_on_and_does_so(undisturbed, refused, tmp_path, point):
    interrupted = undisturbed.run(tmp_path / "out", "interrupt", moment(undisturbed, point))
    undisturbed.finish(tmp_path / "out")
    refused(interrupted, 130)
    assert "run the same command again to resume" in interrupted.stderr


@pytest.mark.parametrize(
    ("what", "share"), cases(CHANGES, {("out-gone", 0.5), ("out-closed", 0.5), ("photo-changed", 0.3)})
)
def test_what_changes_under_a_run_is_one_line_and_the_next_run_is_right(undisturbed, refused, tmp_path, what, share):
    folder, out = undisturbed.copied(tmp_path), tmp_path / "out"
    disturbed = folder.run(out, what, f"after:{folder.moment(share)}")
    if what == "out-closed":
        for path in (out, *(below for below in out.rglob("*") if not below.is_symlink())):
            path.chmod(0o700)
    for path in undisturbed.photos.iterdir():  # all is well again
        (folder.photos / path.name).write_bytes(path.read_bytes())
    folder.finish(out)
    refused(disturbed, 3)
    assert SAYS[what] in disturbed.stderr


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
    ("stage", "limit"), cases([(stage, kb) for stage, all_kb in LIMITS_KB.items() for kb in all_kb], {("scene", 30)})
)
def test_a_full_disk_is_one_line_and_the_run_goes_on_when_there_is_room(
    undisturbed, finished, refused, tmp_path, stage, limit
):
    """A limit on the size of files stands for the disk: whoever writes past it gets the same error."""
    finished(stage, tmp_path / "out")
    full = undisturbed.run(tmp_path / "out", moment=f"full:{limit}")
    undisturbed.finish(tmp_path / "out")
    refused(full, 3)
    assert "the disk is full" in full.stderr
