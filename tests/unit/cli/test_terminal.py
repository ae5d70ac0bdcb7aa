"""What is seen of a run that goes on: one line per stage, and no long silence."""

import io
import re

import pytest
from rich.console import Console

from sfm_app.cli import terminal
from sfm_app.cli.terminal import Terminal, per_minute
from sfm_app.pipeline import NAMES


class Screen(io.StringIO):
    """A terminal that keeps what is written to it."""

    def isatty(self):
        return True


@pytest.fixture
def clock(monkeypatch):
    """The seconds that pass, in a list of one."""
    now = [0.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture
def shown(clock, monkeypatch):
    """A display without a terminal, and what it has printed."""
    paper = io.StringIO()
    monkeypatch.setattr(terminal, "LOOK_EVERY_S", 1000.0)
    shown = Terminal(quiet=False)
    shown.console.file = paper
    shown.bars.get_time = lambda: clock[0]
    yield shown, paper
    shown.close()


def test_every_stage_has_a_title_in_order():
    assert tuple(terminal.STAGE_TITLES) == NAMES


def test_a_short_stage_is_one_line_with_its_seconds(shown):
    display, paper = shown
    display.stage("photos")
    display.start("photos", 10)
    display.advance(10)
    display.finish()
    display.look()
    assert paper.getvalue() == ""

    display.finish_stage(0.42, 10)
    display.stage("match_graph", "up to date")
    display.stage("view_graph", "again: as asked")
    display.finish_stage(300.0, 100)
    assert [line.split() for line in paper.getvalue().splitlines()] == [
        ["1/10", "reading", "photos", "0.4", "s"],
        ["2/10", "finding", "and", "matching", "features", "(up", "to", "date)"],
        ["3/10", "fundamental", "matrices", "(again:", "as", "asked)", "300.0", "s,", "20", "photos", "per", "minute"],
    ]


def test_a_long_stage_is_named_after_five_seconds_and_its_seconds_follow_on_the_line(shown, clock):
    display, paper = shown
    display.stage("intrinsics")
    clock[0] = 4.9
    display.look()
    assert paper.getvalue() == ""
    clock[0] = 5.0
    display.look()
    assert paper.getvalue().split() == ["4/10", "camera", "matrix"] and "\n" not in paper.getvalue()

    display.finish_stage(7.0)
    assert paper.getvalue().split() == ["4/10", "camera", "matrix", "7.0", "s"] and paper.getvalue().endswith("s\n")


def test_a_long_work_says_every_half_minute_how_far_it_is(shown, clock):
    display, paper = shown
    display.stage("match_graph")
    display.start("matching", 400)
    for step in range(100):
        clock[0] = 1.0 + step
        display.advance()
        display.look()

    title, *lines = paper.getvalue().splitlines()
    assert title.split() == ["2/10", "finding", "and", "matching", "features"]
    assert [line.strip() for line in lines] == [
        "matching: 35 of 400, 6 min left", "matching: 65 of 400, 6 min left", "matching: 95 of 400, 5 min left",
    ]  # fmt: skip


def test_work_that_cannot_be_measured_is_named(shown, clock):
    display, paper = shown
    display.stage("scene")
    display.start("adjusting", 1)
    for now in (5.0, 36.0):
        clock[0] = now
        display.look()

    assert paper.getvalue().splitlines()[1].strip() == "adjusting: goes on, 36 s so far"
    assert display.bars.tasks[0].total is None  # a bar at 0/1 stands still


def test_what_is_said_stands_below_the_title_in_80_columns(shown):
    display, paper = shown
    display.stage("photos")
    display.say("11 photos, 55 pairs: about 2 minutes, more for hard photos; up to 1.6 GB with 2 workers [of 2]")
    display.finish_stage(1.0)

    title, first, second, end = paper.getvalue().splitlines()
    assert title.strip() == "1/10 reading photos" and end.strip() == "1.0 s"
    assert (first[:7], second[:7]) == ("      1", "      w") and max(map(len, (first, second))) <= 80
    assert "[of 2]" in second


def test_names_cannot_move_the_cursor(shown):
    display, paper = shown
    display.stage("photos", "again: \x1b[2J")
    display.say("left out: a\x1b[2Jb\n")
    display.finish_stage(1.0)

    assert "\x1b" not in paper.getvalue() and "left out: a\\x1b[2Jb\\n" in paper.getvalue()


def test_nothing_is_shown_when_quiet(monkeypatch):
    assert printed(monkeypatch, io.StringIO(), quiet=True) == ""
    assert printed(monkeypatch, io.StringIO()) != ""


@pytest.mark.parametrize("columns", [80, 60])
def test_bars_fit_into_the_terminal(monkeypatch, columns):
    screen = Screen()
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setattr(terminal.sys, "stderr", screen)
    with Terminal(quiet=False) as display:
        display.stage("depth_maps")
        display.start("matching depths in smaller photos", 10_000)
        display.advance(4_999)
        paper = Console(width=columns, file=io.StringIO())
        paper.print(display.bars.get_renderable())
        display.finish_stage(12.0, 10)

    assert paper.file.getvalue().count("\n") == 1 and len(paper.file.getvalue().rstrip()) <= columns
    assert "depth maps" in screen.getvalue() and "12.0 s" in screen.getvalue()


def test_slow_work_has_two_digits():
    assert [per_minute(1.0), per_minute(0.05), per_minute(0.17)] == ["60", "3.0", "10"]


def printed(monkeypatch, paper, *, quiet=False, **environment):
    """What a short run shows, with these variables."""
    for name in ("NO_COLOR", "FORCE_COLOR", "CLICOLOR_FORCE", "TTY_COMPATIBLE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in {"TERM": "xterm-256color", "COLORTERM": "truecolor", **environment}.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(terminal.sys, "stderr", paper)
    with Terminal(quiet=quiet) as display:
        display.stage("photos")
        display.say("a note")
        display.start("photos", 3)
        display.advance()
        display.look()
        display.finish_stage(12.0, 10)
    return paper.getvalue()


@pytest.mark.parametrize("forced", [{}, {"FORCE_COLOR": "1"}])
def test_a_pipe_gets_no_codes(monkeypatch, forced):
    text = printed(monkeypatch, io.StringIO(), **forced)

    assert "\x1b" not in text and "reading photos" in text and "12.0 s" in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_terminal_without_colors_gets_none(monkeypatch):
    styles = r"\x1b\[[0-9;]*m"
    assert re.search(styles, printed(monkeypatch, Screen()))
    assert not re.search(styles, printed(monkeypatch, Screen(), NO_COLOR="1"))


def test_a_dumb_terminal_gets_lines(monkeypatch):
    assert "\x1b" not in printed(monkeypatch, Screen(), TERM="dumb")
