"""The log in the output folder."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

from sfm_app.runtime.context import RunContext

logger = logging.getLogger("sfm_app")
LOGGERS = (logger, logging.getLogger("py.warnings"))
"""Those written to the log; the program sends warnings of Python to the second."""


class LogFile(logging.FileHandler):
    """A log file that ignores write errors: the run itself reports a full disk."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Do nothing: the run itself reports a full disk."""


@contextmanager
def log_to_file(run: RunContext) -> Iterator[None]:
    """Keep a log in the output folder, with the traceback of whatever ends the run."""
    handler = LogFile(run.workspace.log, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
    for each in LOGGERS:
        each.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    except BaseException:
        logger.exception("the run ended here")
        raise
    finally:
        for each in LOGGERS:
            each.removeHandler(handler)
        handler.close()
