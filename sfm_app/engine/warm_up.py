"""A process that compiles kernels beside the first run on a machine."""

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
"""Environment variable of the process: the process id of its run."""


@contextlib.contextmanager
def warming_up(progress: Progress) -> Iterator[None]:
    """Compile kernels in the background during the block, unless `WARM` exists.

    The block does not wait: it compiles the kernels that the cache lacks itself.
    """
    if WARM.exists() or PARENT in os.environ:
        yield
        return
    progress.say("first run on this machine: compiling the kernels takes half a minute more, once")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        command = [sys.executable, "-P", "-m", "sfm_app.warm_up", folder]
        environment, quiet = os.environ | {PARENT: str(os.getpid())}, subprocess.DEVNULL
        process = subprocess.Popen(  # noqa: S603 - our module
            command, env=environment, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet, **group_options()
        )
        try:
            yield
        finally:
            end_group(process, 10.0)  # seconds; by hand
            process.communicate()
