import io
import time

import pytest
from rich.console import Console

from sfm_app.cli import terminal
from sfm_app.cli.terminal import Terminal, per_minute


@pytest.fixture
def clock(monkeypatch):
    """The seconds that pass, in a list of one."""
    now = [0.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now[0])
    return now


@pytest.fixture
def shown(clock):
    """A display without a terminal, and what it has printed."""
    paper = io.StringIO()
    shown = Terminal(quiet=False)
    shown.console = Console(file=paper, width=120, highlight=False)
    shown.bars.live.console = shown.console
    shown.bars.get_time = lambda: clock[0]
    return shown, paper


def test_a_long_work_says_every_minute_how_far_it_is(shown, clock):
    display, paper = shown
    display.start("matching", 400)
    for step in range(200):
        clock[0] = 1.0 + step
        display.advance()

    lines = paper.getvalue().splitlines()
    assert len(lines) == 3
    assert lines[0].split() == ["matching", "60", "of", "400,", "60/min,", "6", "min", "left"]
    assert lines[2].split() == ["matching", "180", "of", "400,", "60/min,", "4", "min", "left"]


def test_a_short_work_says_nothing(shown, clock):
    display, paper = shown
    display.start("matching", 10)
    for step in range(10):
        clock[0] = 5.0 * step
        display.advance()
    display.finish()
    display.advance()  # after the end

    assert paper.getvalue() == ""


def test_the_end_of_a_stage_tells_its_speed_where_it_took_long(shown):
    display, paper = shown
    display.finish_stage(2.0, 100)
    display.finish_stage(300.0, 100)
    display.finish_stage(300.0)

    assert [line.strip() for line in paper.getvalue().splitlines()] == [
        "2.0 s", "300.0 s, 20 photos per minute", "300.0 s",
    ]  # fmt: skip


def test_slow_work_has_two_digits():
    assert [per_minute(1.0), per_minute(0.05), per_minute(0.17)] == ["60", "3.0", "10"]


def test_work_that_cannot_be_measured_is_named_once_it_takes_long(shown, monkeypatch):
    display, paper = shown
    monkeypatch.setattr(terminal, "LINE_EVERY_S", 0.1)
    for label, seconds in (("adjusting", 0.5), ("joining", 0.0)):
        display.start(label, 1)
        time.sleep(seconds)
        display.advance()
        display.finish()
    time.sleep(0.3)

    assert paper.getvalue().split() == ["adjusting"]
