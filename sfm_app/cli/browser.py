"""The browser of whoever sits at this machine."""

import os
import sys
import webbrowser
from pathlib import Path

DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


def open_browser(address: str) -> bool:
    """Open an address in the user's browser, and return whether there is one.

    On a machine without a screen, a browser of text would take over the terminal: there, none is opened.
    """
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in DISPLAYS):
        return False
    try:
        return webbrowser.open(address)
    except (webbrowser.Error, OSError):
        return False


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
