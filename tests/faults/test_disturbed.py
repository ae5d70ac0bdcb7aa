"""Folders that change while a run is at work: one line, and the next run is as if nothing had been."""

import os

import pytest

SAYS = {
    "out-gone": "out was removed",
    "out-closed": "cannot write to",
    "photo-gone": "is gone since",
    "photo-changed": "has changed since",
}
ALWAYS = {("out-gone", 0.5), ("out-closed", 0.5), ("photo-gone", 0.3), ("photo-changed", 0.3)}
CASES = [(what, share) for what in SAYS for share in (0.1, 0.3, 0.5, 0.7, 0.9)]

needs_time = pytest.mark.skipif("SFM_APP_FAULTS" not in os.environ, reason="`make faults` tries all of them")


@pytest.mark.parametrize(
    ("what", "share"), [pytest.param(*case, marks=() if case in ALWAYS else needs_time) for case in CASES]
)
def test_what_changes_under_a_run_is_one_line_and_the_next_run_is_right(undisturbed, refused, tmp_path, what, share):
    folder, out = undisturbed.copied(tmp_path), tmp_path / "out"

    disturbed = folder.run(out, what, f"after:{folder.moment(share)}")
    if what == "out-closed":
        for path in (out, *(below for below in out.rglob("*") if not below.is_symlink())):
            path.chmod(0o700)
    for path in undisturbed.photos.iterdir():  # all is well again
        (folder.photos / path.name).write_bytes(path.read_bytes())
    again = folder.run(out)

    refused(disturbed, 3)
    assert SAYS[what] in disturbed.stderr
    assert again.returncode == 0, again.stderr
    assert undisturbed.result(out) == undisturbed.result(undisturbed.out)
