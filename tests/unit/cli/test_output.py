"""Text is folded to 80 columns, without colors; the browser is opened only with a screen."""

import io
import threading
import webbrowser

import pytest

from sfm_app.cli import output
from sfm_app.cli.output import (
    file_lines,
    fold_lines,
    open_browser,
    print_lines,
    print_text,
    size_text,
    table,
    terminal_width,
)

LONG = "the photos contradict it: " + ", ".join(f"photo_{k:03}.jpg" for k in range(40))


class Screen(io.StringIO):
    def isatty(self):
        return True


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
    assert fold_lines([line], 9) == folded


def test_folding_keeps_every_word(capsys):
    lines = [f"label       {LONG}", LONG, f"  {LONG}", "A sentence that ends here.  " + LONG]
    folded = fold_lines(lines)
    print_text(lines)

    assert capsys.readouterr().out.splitlines() == folded
    assert max(map(len, folded)) <= 80 and len(folded) > 3 * len(lines)
    assert " ".join(folded).split() == " ".join(lines).split()
    assert folded[1].startswith(12 * " " + "photo_")
    assert folded[-1].startswith("photo_")  # too far to the right for a label


@pytest.mark.parametrize(("columns", "expected"), [(120, 100), (70, 70), (20, 40)])
def test_the_width_is_that_of_the_terminal_within_bounds(monkeypatch, columns, expected):
    monkeypatch.setenv("COLUMNS", str(columns))

    assert terminal_width(Screen()) == expected
    assert terminal_width(io.StringIO()) is None


def test_unprintable_characters_are_escaped(capsys):
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


@pytest.mark.parametrize(
    ("size", "text"), [(0, "0 bytes"), (999, "999 bytes"), (355_764, "356 kB"), (15_133_688, "15.1 MB")]
)
def test_sizes_have_a_unit(size, text):
    assert size_text(size) == text


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
        return open_browser("http://127.0.0.1:1/")

    return call


@pytest.mark.parametrize(
    ("platform", "variables", "opens"),
    [("linux", {}, False), ("linux", {"DISPLAY": ":0"}, True), ("linux", {"WAYLAND_DISPLAY": "w"}, True),
     ("linux", {"BROWSER": "code-open"}, True), ("darwin", {}, True)],
)  # fmt: skip
def test_no_text_browser_takes_over_the_terminal(open_page, platform, variables, opens):
    pages = []

    assert open_page(lambda address: pages.append(address) or True, platform, **variables) is opens
    assert len(pages) == opens


def test_a_machine_without_a_browser_is_no_error(open_page):
    def fail(_):
        raise webbrowser.Error("none")

    assert open_page(fail, DISPLAY=":0") is False
    assert open_page(lambda _: False, DISPLAY=":0") is False


def test_a_browser_that_blocks_does_not_block_the_program(open_page, monkeypatch):
    closed = threading.Event()
    monkeypatch.setattr(output, "BROWSER_WAIT_S", 0.05)

    assert open_page(lambda _: closed.wait(60), BROWSER="viewer %s") is True
    assert not closed.is_set()
    closed.set()
