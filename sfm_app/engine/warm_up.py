"""Kernels are compiled by a process beside the first run on a machine, while that is busy elsewhere."""

import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator

from sfm_app.jit import WARM
from sfm_app.operating_system import end_group, group_options
from sfm_app.progress import Progress

PARENT = "SFM_APP_WARM_UP_OF"
"""Environment variable of the process: the number of the run for which it compiles."""
MOST_S = 10.0
"""Seconds that its end may take. Chosen by hand."""


@contextlib.contextmanager
def warming_up(progress: Progress) -> Iterator[None]:
    """Compile kernels in the background for the duration of the block, unless that has been done.

    The block does not wait for them: it takes from the cache what is there, and compiles the rest itself.
    """
    if WARM.exists() or PARENT in os.environ:
        yield
        return
    progress.say("first run on this machine: parts of the program are compiled, half a minute more, once")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        command = [sys.executable, "-P", "-m", "sfm_app.warm_up", folder]
        environment, quiet = os.environ | {PARENT: str(os.getpid())}, subprocess.DEVNULL
        process = subprocess.Popen(  # noqa: S603 - our module
            command, env=environment, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, **group_options()
        )
        try:
            yield
        finally:
            end_group(process, MOST_S)
            process.communicate()
