"""A picture of the model in the terminal, where it can show one."""

import logging
import shutil
import sys

from sfm_app.api import Run
from sfm_app.cli.ending.graphics import draw, graphics_of
from sfm_app.errors import SfmError
from sfm_app.numerical import FAILURES
from sfm_app.settings import Settings

logger = logging.getLogger("sfm_app")

ROWS, COLUMNS = 20, 72
"""Most lines and columns of a picture: the text below stays on the screen with it. Chosen by hand."""


def print_picture(run: Run, settings: Settings, *, quiet: bool) -> None:
    """Show a picture of what was found on stdout, if that is a terminal that can.

    Args:
        run: that has placed photos.
        settings: their `picture` may turn it off.
        quiet: whether nothing but results is wanted.
    """
    kind = graphics_of(sys.stdout)
    if quiet or not settings.picture or kind is None or run.scene is None:
        return
    room = shutil.get_terminal_size((80, 24))
    try:
        picture = run.picture()
    except (*FAILURES, SfmError, OSError, KeyError) as err:  # the result is there without it
        logger.info("no picture of the model", exc_info=err)
        return
    if picture is not None and picture[..., 3].any():
        sys.stdout.write(draw(picture, kind, min(ROWS, room.lines - 4), min(COLUMNS, room.columns - 2)))
        sys.stdout.flush()
