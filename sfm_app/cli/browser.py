"""The browser of whoever sits at this machine."""

import os
import sys
import webbrowser
from pathlib import Path
from threading import Thread

SIGNS = ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER")
"""Variables of which one is set where there is a screen, or a way to one from elsewhere, as editors set it."""
OPENING_S = 2.0
"""Longest time that opening is waited for. Chosen by hand."""


def open_browser(address: str) -> bool:
    """Open an address in the user's browser, and return whether there is one.

    On a machine without a screen, a browser of text would take over the terminal: there, none is opened, unless one is
    asked for. Some commands last as long as the browser; they are not waited for.
    """
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in SIGNS):
        return False
    found = [True]

    def call() -> None:
        try:
            found[0] = webbrowser.open(address)
        except (webbrowser.Error, OSError):
            found[0] = False

    opening = Thread(target=call, daemon=True)
    opening.start()
    opening.join(OPENING_S)
    return found[0]


def open_report(path: Path | None, wanted: bool | None, *, quiet: bool) -> None:
    """Open a report in the browser, where one is wanted and there is somebody to look at it.

    Args:
        path: of the report; None where there is none.
        wanted: as asked for; None: on a terminal, but not where `CI` is set.
        quiet: whether nothing but results is wanted.
    """
    if wanted is None:
        wanted = not quiet and sys.stdout.isatty() and not os.environ.get("CI")
    if wanted and path is not None:
        open_browser(path.resolve().as_uri())
