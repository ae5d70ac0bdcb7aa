"""Workers on this machine, one process of one thread each, which end with the process that has started them.

Started as ``python -m sfm_app.runtime.parallel.local_workers SCHEDULER COUNT FOLDER`` in a process group of its own:
Ctrl-C does not reach it, and whatever it starts ends with it.
"""

import os
import signal
import sys
import threading


def main(scheduler: str, count: str, scratch: str) -> None:
    """Run workers until the standard input is closed.

    Args:
        scheduler: its address.
        count: number of workers.
        scratch: folder for what Dask itself writes.
    """
    import dask
    from distributed.cli.dask_worker import main as run_workers

    dask.config.set({"distributed.worker.profile.enabled": False})  # it looks at all threads a hundred times a second
    threading.Thread(target=_end_with_parent, daemon=True).start()
    options = {
        "nworkers": count, "nthreads": "1", "memory-limit": "0", "local-directory": scratch, "no-dashboard": "",
        "death-timeout": "60",
    }  # fmt: skip
    run_workers([scheduler, *(f"--{name}={value}" if value else f"--{name}" for name, value in options.items())])


def _end_with_parent() -> None:
    while os.read(sys.stdin.fileno(), 1):
        pass
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    main(*sys.argv[1:])
