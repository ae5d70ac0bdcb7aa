"""Progress of a run, text folded to 80 columns, and the browser, which is opened only with a screen."""

import io
import re
import threading
import time
import webbrowser

import pytest
from rich.console import Console

from sfm_app.cli import output
from sfm_app.cli.terminal import Terminal
from sfm_app.pipeline import NAMES

LONG = "the photos contradict it: " + ", ".join(f"photo_{k:03}.jpg" for k in range(40))


class Screen(io.StringIO):
    def isatty(self):
        return True


def check_text(text, path=""):
    """Check that no line is longer than 80 columns, but for a path, and that nothing is colored."""
    assert "\x1b" not in text and text.strip()
    assert [line for line in text.splitlines() if len(line) > 80 and not (path and path in line)] == []


@pytest.fixture
def clock():
    """The time in a list of one."""
    return [0.0]


@pytest.fixture
def shown(clock):
    """A display without a terminal, and its output; without `with`, it does not check for silence by itself."""
    paper = io.StringIO()
    display = Terminal(quiet=False, stream=paper, clock=lambda: clock[0])
    yield display, paper
    display.close()


def test_every_stage_has_a_title_in_order():
    assert tuple(output.STAGE_TITLES) == NAMES


def test_a_short_stage_is_one_line_with_its_seconds(shown):
    display, paper = shown
    display.stage("photos")
    display.start("photos", 10)
    display.advance(10)
    display.finish()
    display.check_silence()
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


def test_the_title_of_a_long_stage_is_printed_after_five_seconds_and_its_seconds_follow(shown, clock):
    display, paper = shown
    display.stage("intrinsics")
    clock[0] = 4.9
    display.check_silence()
    assert paper.getvalue() == ""
    clock[0] = 5.0
    display.check_silence()
    assert paper.getvalue().split() == ["4/10", "camera", "matrix"] and "\n" not in paper.getvalue()
    display.finish_stage(7.0)
    assert paper.getvalue().split() == ["4/10", "camera", "matrix", "7.0", "s"] and paper.getvalue().endswith("s\n")


def test_long_work_prints_its_progress_every_half_minute(shown, clock):
    display, paper = shown
    display.stage("match_graph")
    display.start("matching", 400)
    for step in range(100):
        clock[0] = 1.0 + step
        display.advance()
        display.check_silence()

    title, *lines = paper.getvalue().splitlines()
    assert title.split() == ["2/10", "finding", "and", "matching", "features"]
    assert [line.strip() for line in lines] == [
        "matching: 35 of 400, 6 min left", "matching: 65 of 400, 6 min left", "matching: 95 of 400, 5 min left",
    ]  # fmt: skip


def test_work_of_one_step_prints_its_seconds(shown, clock):
    display, paper = shown
    display.stage("scene")
    display.start("adjusting", 1)
    for clock[0] in (5.0, 36.0):
        display.check_silence()
    assert paper.getvalue().splitlines()[1].strip() == "adjusting: 36 s so far"
    assert display.bars.tasks[0].total is None  # a bar at 0/1 stands still


def test_a_note_stands_below_the_title_in_80_columns(shown):
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


@pytest.mark.parametrize("columns", [80, 60])
def test_bars_fit_into_the_terminal(monkeypatch, columns):
    screen, paper = Screen(), io.StringIO()
    monkeypatch.setenv("TERM", "xterm-256color")
    with Terminal(quiet=False, stream=screen) as display:
        display.stage("depth_maps")
        display.start("matching depths in smaller photos", 10_000)
        display.advance(4_999)
        Console(width=columns, file=paper).print(display.bars.get_renderable())
        display.finish_stage(12.0, 10)
    assert paper.getvalue().count("\n") == 1 and len(paper.getvalue().rstrip()) <= columns
    assert "depth maps" in screen.getvalue() and "12.0 s" in screen.getvalue()


@pytest.fixture
def output_of(monkeypatch):
    """Shows a short run on a stream, and returns the text."""

    def show(stream, *, quiet=False, **variables):
        for name in ("NO_COLOR", "FORCE_COLOR", "CLICOLOR_FORCE", "TTY_COMPATIBLE"):
            monkeypatch.delenv(name, raising=False)
        for name, value in {"TERM": "xterm-256color", "COLORTERM": "truecolor", **variables}.items():
            monkeypatch.setenv(name, value)
        with Terminal(quiet=quiet, stream=stream) as display:
            display.stage("photos")
            display.say("a note")
            display.start("photos", 3)
            display.advance()
            display.check_silence()
            display.finish_stage(12.0, 10)
        return stream.getvalue()

    return show


@pytest.mark.parametrize("variables", [{}, {"FORCE_COLOR": "1"}])
def test_a_pipe_gets_no_codes(output_of, variables):
    text = output_of(io.StringIO(), **variables)
    assert "\x1b" not in text and "reading photos" in text and "12.0 s" in text
    assert max(map(len, text.splitlines())) <= 80


def test_quiet_prints_nothing(output_of):
    assert output_of(io.StringIO(), quiet=True) == output_of(Screen(), quiet=True) == ""


def test_a_terminal_without_colors_gets_none(output_of):
    styles = r"\x1b\[[0-9;]*m"
    assert re.search(styles, output_of(Screen())) and not re.search(styles, output_of(Screen(), NO_COLOR="1"))


def test_a_dumb_terminal_gets_lines(output_of):
    assert "\x1b" not in output_of(Screen(), TERM="dumb")


@pytest.mark.slow
def test_the_display_checks_for_silence_by_itself(clock):
    paper = io.StringIO()
    with Terminal(quiet=False, stream=paper, clock=lambda: clock[0]) as display:
        display.stage("mesh")
        clock[0] = 5.0
        for _ in range(200):
            if "surface" in paper.getvalue():
                return
            time.sleep(0.1)
    pytest.fail("no title")


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
def test_long_lines_continue_below_their_text(line, folded):
    assert output.fold_lines([line], 9) == folded


def test_folding_keeps_every_word(capsys):
    lines = [f"label       {LONG}", LONG, f"  {LONG}", "A sentence that ends here.  " + LONG]
    folded = output.fold_lines(lines)
    output.print_text(lines)
    assert capsys.readouterr().out.splitlines() == folded
    assert max(map(len, folded)) <= 80 and len(folded) > 3 * len(lines)
    assert " ".join(folded).split() == " ".join(lines).split() and folded[1].startswith(12 * " " + "photo_")
    assert folded[-1].startswith("photo_")  # too far to the right for a label


@pytest.mark.parametrize(("columns", "expected"), [(120, 100), (70, 70), (20, 40)])
def test_the_width_is_that_of_the_terminal_within_bounds(monkeypatch, columns, expected):
    monkeypatch.setenv("COLUMNS", str(columns))
    assert output.terminal_width(Screen()) == expected and output.terminal_width(io.StringIO()) is None


def test_unprintable_characters_are_escaped(capsys):
    output.print_lines(["a\x1b[2Jb\n", "é"])
    assert capsys.readouterr().out == "a\\x1b[2Jb\\n\né\n"
    output.print_lines([])
    assert capsys.readouterr().out == ""


def test_files_stand_with_their_sizes(tmp_path):
    (tmp_path / "some of them").mkdir()
    for name in ("a", "b"):
        (tmp_path / "some of them" / name).write_bytes(bytes(700))
    assert output.file_lines([tmp_path / "some of them"]) == [f"{tmp_path}/some of them  2 files, 1 kB"]
    assert output.table({"a": "one", "long": "two"}) == ["a     one", "long  two"]


@pytest.mark.parametrize(
    ("size", "text"), [(0, "0 bytes"), (999, "999 bytes"), (355_764, "356 kB"), (15_133_688, "15.1 MB")]
)
def test_sizes_have_a_unit(size, text):
    assert output.size_text(size) == text


@pytest.fixture
def open_page(monkeypatch):
    """Opens a page on a platform with some variables and a fake of `webbrowser.open`."""

    def call(opener, platform="linux", **variables):
        monkeypatch.setattr("sys.platform", platform)
        monkeypatch.setattr(webbrowser, "open", opener)
        for name in output.SCREEN_VARIABLES:
            monkeypatch.delenv(name, raising=False)
        for name, value in variables.items():
            monkeypatch.setenv(name, value)
        output.open_browser("http://127.0.0.1:1/")

    return call


@pytest.mark.parametrize(
    ("platform", "variables", "opens"),
    [("linux", {}, False), ("linux", {"DISPLAY": ":0"}, True), ("linux", {"WAYLAND_DISPLAY": "w"}, True),
     ("linux", {"BROWSER": "code-open"}, True), ("darwin", {}, True)],
)  # fmt: skip
def test_no_text_browser_takes_over_the_terminal(open_page, platform, variables, opens):
    pages = []
    open_page(pages.append, platform, **variables)
    assert len(pages) == opens


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_machine_without_a_browser_is_no_error(open_page):
    def fail(_):
        raise webbrowser.Error("none")

    open_page(fail, DISPLAY=":0")


def test_a_browser_that_blocks_does_not_block_the_program(open_page, monkeypatch):
    closed = threading.Event()
    monkeypatch.setattr(output, "BROWSER_WAIT_S", 0.05)
    open_page(lambda _: closed.wait(60), BROWSER="viewer %s")
    assert not closed.is_set()
    closed.set()
