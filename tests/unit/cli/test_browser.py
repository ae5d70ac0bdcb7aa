"""The browser is opened where there is a screen."""

import threading
import webbrowser

import pytest

from sfm_app.cli import browser


@pytest.mark.parametrize(
    ("platform", "screens", "opens"),
    [("linux", {}, False), ("linux", {"DISPLAY": ":0"}, True), ("linux", {"WAYLAND_DISPLAY": "w"}, True),
     ("linux", {"BROWSER": "code-open"}, True),
     ("darwin", {}, True)],
)  # fmt: skip
def test_no_browser_of_text_takes_over_a_terminal(monkeypatch, platform, screens, opens):
    opened = []
    monkeypatch.setattr(browser.sys, "platform", platform)
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    for name in browser.SIGNS:
        monkeypatch.delenv(name, raising=False)
    for name, value in screens.items():
        monkeypatch.setenv(name, value)

    assert browser.open_browser("http://127.0.0.1:1/") is opens
    assert len(opened) == opens


def test_a_machine_without_a_browser_is_no_error(monkeypatch):
    def fail(address):
        raise webbrowser.Error("none")

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", fail)

    assert browser.open_browser("http://127.0.0.1:1/") is False


def test_a_browser_that_stays_open_holds_nobody_up(monkeypatch):
    closed = threading.Event()
    monkeypatch.setenv("BROWSER", "viewer %s")
    monkeypatch.setattr(webbrowser, "open", lambda _: closed.wait(60))
    monkeypatch.setattr(browser, "OPENING_S", 0.05)

    assert browser.open_browser("http://127.0.0.1:1/") is True
    assert not closed.is_set()
    closed.set()
