"""A picture at the end where a terminal shows one, and nothing anywhere else."""

import io
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

from sfm_app.cli.ending import picture
from sfm_app.cli.ending.picture import COLUMNS, ROWS, print_picture
from sfm_app.errors import InputError
from sfm_app.settings import Settings


@dataclass
class FakeRun:
    """A run whose picture is asked for."""

    pixels: np.ndarray | None
    error: Exception | None = None
    scene: str | None = "a scene"
    asked: list[bool] = field(default_factory=list)

    def picture(self):
        self.asked.append(True)
        if self.error:
            raise self.error
        return self.pixels


@pytest.fixture
def run():
    return FakeRun(np.full((300, 400, 4), 255, np.uint8))


@pytest.fixture
def screen(monkeypatch):
    place = io.StringIO()
    place.isatty = lambda: True
    monkeypatch.setattr(picture, "sys", SimpleNamespace(stdout=place))
    for name in ("TMUX", "NO_COLOR", "KITTY_WINDOW_ID", "TERM_PROGRAM", "LC_TERMINAL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("COLORTERM", "truecolor")
    return place


@pytest.mark.parametrize(("lines", "columns", "rows"), [(50, 80, ROWS), (24, 80, 20), (12, 80, 8), (50, 42, 15)])
def test_the_picture_leaves_room_for_the_text(screen, monkeypatch, run, lines, columns, rows):
    monkeypatch.setenv("LINES", str(lines))
    monkeypatch.setenv("COLUMNS", str(columns))
    print_picture(run, Settings(), quiet=False)

    assert ROWS <= 24 and COLUMNS < 80
    assert screen.getvalue().count("\n") == rows
    assert screen.getvalue().count("▀") == rows * min(columns - 2, COLUMNS, round(rows * 8 / 3))


def test_it_can_be_turned_off(screen, run):
    print_picture(run, Settings.from_mapping({"picture": False}), quiet=False)
    print_picture(run, Settings(), quiet=True)

    assert screen.getvalue() == "" and run.asked == []


def test_a_pipe_gets_none_and_nothing_is_rendered_for_it(screen, run):
    screen.isatty = lambda: False
    print_picture(run, Settings(), quiet=False)

    assert screen.getvalue() == "" and run.asked == []


@pytest.mark.parametrize(
    "run",
    [
        FakeRun(None),
        FakeRun(np.zeros((30, 40, 4), np.uint8)),
        FakeRun(None, scene=None),
        FakeRun(None, InputError("no run", hint="")),
        FakeRun(None, OSError("gone")),
    ],
)
def test_a_run_without_a_picture_ends_without_one(screen, run):
    print_picture(run, Settings(), quiet=False)

    assert screen.getvalue() == ""
