"""Text in 80 columns, and a test that everything a person reads keeps to them, without colors."""

import io
import re
from dataclasses import replace
from functools import partial

import click
import numpy as np
import pytest
from click.testing import CliRunner

from sfm_app.api import Run
from sfm_app.cli import main, output
from sfm_app.cli.commands.making import SCENES
from sfm_app.cli.display import run_lines
from sfm_app.cli.outcome import outcome_lines
from sfm_app.cli.output import file_lines, fold_lines, print_lines, print_text, table
from sfm_app.cli.program import SECTIONS, fail
from sfm_app.demo import DemoResult, demo_lines
from sfm_app.geometry.camera import camera_matrix
from sfm_app.types import Calibration, CameraModel, Intrinsics, Scene

COMMANDS = [name for entries in SECTIONS.values() for name in entries]
LONG = "the photos contradict it: " + ", ".join(f"photo_{k:03}.jpg" for k in range(40))


class Screen(io.StringIO):
    def isatty(self):
        return True


def check_text(text, beyond=()):
    """Check that no line is longer than 80 columns, but for paths, and that nothing is colored."""
    assert "\x1b" not in text and text.strip()
    long = [line for line in text.splitlines() if len(line) > 80 and not any(path in line for path in beyond)]
    assert long == []


@pytest.mark.parametrize(
    ("line", "folded"),
    [
        ("aa bb cc dd", ["aa bb cc", "dd"]),
        ("a   bb cc dd", ["a   bb cc", "    dd"]),
        ("    bb cc dd", ["    bb cc", "    dd"]),
        ("hint: a b c", ["hint: a b", "      c"]),
        ("", [""]),
        ("short", ["short"]),
        ("one-very/long-word", ["one-very/long-word"]),
        ("a b/very/long/path  2 kB", ["a b/very/long/path  2 kB"]),
        ("a b/folder of three  3 files, 1.2 MB", ["a b/folder of three  3 files, 1.2 MB"]),
    ],
)
def test_long_lines_go_on_below_their_text(line, folded):
    assert fold_lines([line], 9) == folded


def test_nothing_is_lost_when_lines_are_folded():
    lines = [f"label       {LONG}", LONG, f"  {LONG}", "A sentence that ends here.  " + LONG]
    folded = fold_lines(lines)

    assert max(map(len, folded)) <= 80 and len(folded) > 3 * len(lines)
    assert " ".join(folded).split() == " ".join(lines).split()
    assert folded[1].startswith(12 * " " + "photo_")
    assert folded[-1].startswith("photo_")  # too far to the right for a label


@pytest.mark.parametrize(("terminal", "expected"), [(120, 100), (70, 70), (20, 40)])
def test_the_width_is_that_of_the_terminal_within_bounds(monkeypatch, terminal, expected):
    monkeypatch.setenv("COLUMNS", str(terminal))

    assert output.columns(Screen()) == expected
    assert output.columns(io.StringIO()) is None


def test_what_could_move_the_cursor_is_escaped(capsys):
    print_lines(["a\x1b[2Jb\n", "é"])
    assert capsys.readouterr().out == "a\\x1b[2Jb\\n\né\n"
    print_lines([])
    assert capsys.readouterr().out == ""


def test_files_stand_with_their_sizes(tmp_path):
    (tmp_path / "some of them").mkdir()
    for name in ("a", "b"):
        (tmp_path / "some of them" / name).write_bytes(bytes(700))

    assert file_lines([tmp_path / "some of them"]) == [f"{tmp_path}/some of them  2 files, 1 kB"]
    assert table({"a": "one", "long": "two"}) == ["a     one", "long  two"]


@pytest.fixture
def finished(tmp_path):
    """A run with everything that is worth a line."""
    K = camera_matrix(500.0, 510.0, 480.0, 410.0)
    guess = Calibration(K, 1000, 800, "guess", False, LONG)
    refined = CameraModel("OPENCV", (501.0, 510.0, 480.0, 410.0, -0.1, 0, 0, 0), K, 1000, 800, {"fx": 0.754})
    for name in ("report.html", "model.glb", "model.ply"):
        (tmp_path / name).write_bytes(bytes(2000))
    counts = {
        "photos": {
            "usable": 4, "unusable": {f"file {k}.txt": "not a photo" for k in range(30)}, "notes": {"a.jpg": [LONG]},
        },
        "view_graph": {"kept": 5, "rejected": {f"reason {k} of some length": k for k in range(12)}},
        "scale": {"unit": "meter", "deviation_percent": 0.1, "source": LONG, "contradictions": [LONG], "problems": []},
        "mesh": {"triangles": 12_345},
        "files": {"bytes": {"model.ply": 2, "model.glb": 2}, "pages_px": [[4096, 4096]] * 6, "jpeg_quality": 90},
    }  # fmt: skip
    stages = {name: {"counts": part, "seconds": 60.0} for name, part in counts.items()}
    poses = {name: np.eye(3, 4) for name in ("a.jpg", "b.jpg")}
    scene = Scene(tmp_path, poses, {"c.jpg": LONG}, {"one": refined}, 10, 20, 0.312)
    known = Intrinsics({"one": guess}, dict.fromkeys(poses, "one"))
    return Run(tmp_path, known, scene, None, tmp_path / "model.glb", {"stages": stages}, tmp_path / "report.html")


@pytest.mark.parametrize("lines_of", [run_lines, partial(outcome_lines, seconds=0.7)], ids=["all", "outcome"])
@pytest.mark.parametrize("until", ["photos", "camera", "scene", "mesh"])
def test_what_came_of_a_run_fits(capsys, finished, lines_of, until):
    less = {"mesh": {}, "scene": {"mesh_path": None}, "camera": {"mesh_path": None, "scene": None}}
    print_text(lines_of(replace(finished, **less.get(until, {"mesh_path": None, "scene": None, "calibration": None}))))

    check_text(capsys.readouterr().out, beyond=[str(finished.out)])


@pytest.mark.parametrize("scene", SCENES)
def test_what_came_of_a_demo_fits(capsys, scene):
    K = camera_matrix(1008.0, 1007.99, 508.8, 1307.2).tolist()
    files = ["demo/model/report.html", "demo/model/model.glb", "demo/model/model.ply", f"demo-{scene}/model.png"]
    print_text(
        demo_lines(
            DemoResult(20, 19, K, K, K, 10.012, 0.005, 0.03, 0.017, 0.022, 99.5, 96.2, 199_999, [], 50.0, 130.0, files)
        )
    )

    printed = capsys.readouterr().out
    check_text(printed)
    assert len(printed.splitlines()) <= 7


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_fits(command):
    found = CliRunner().invoke(main, [*command.split(), "--help"])

    assert found.exit_code == 0
    check_text(found.stdout)


def test_errors_are_one_line_each_where_a_program_reads_them(capsys):
    with pytest.raises(SystemExit) as ended:
        fail(LONG, f"{LONG}\nsecond", 3)

    lines = capsys.readouterr().err.splitlines()
    assert ended.value.code == 3 and lines == [f"error: {LONG}", f"hint: {LONG}", "second"]


def test_errors_fit_on_a_terminal(monkeypatch):
    screen = Screen()
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("sfm_app.cli.program.sys.stderr", screen)
    monkeypatch.setattr(click, "echo", lambda text, **_: screen.write(f"{text}\n"))
    with pytest.raises(SystemExit):
        fail(f"\x1b[31m{LONG}", LONG, 3)

    check_text(screen.getvalue())
    assert len(re.findall(r"^(error|hint): ", screen.getvalue(), re.MULTILINE)) == 2


@pytest.mark.parametrize("arguments", [["ran"], ["run"], ["measure", "x"], ["run", "nowhere"]])
def test_wrong_commands_are_answered_in_80_columns(tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    check_text(CliRunner().invoke(main, arguments).stderr)
