"""Workers on this machine, one process of one thread each, which end with the process that has started them.

Started as ``python -m sfm_app.runtime.local_workers SCHEDULER COUNT FOLDER PARENT``, a group of its own:
Ctrl-C does not reach it, and whatever it starts ends with it.
"""

import sys

from sfm_app.operating_system import end_own_group, watch_parent


def main(scheduler: str, count: str, scratch: str, parent: str) -> None:
    """Run workers until the process that has started this one ends.

    Args:
        scheduler: its address.
        count: number of workers.
        scratch: folder for what Dask itself writes.
        parent: number of that process.
    """
    import dask
    from distributed.cli.dask_worker import main as run_workers

    dask.config.set({"distributed.worker.profile.enabled": False})  # it looks at all threads a hundred times a second
    watch_parent(int(parent), end_own_group)
    options = {
        "nworkers": count, "nthreads": "1", "memory-limit": "0", "local-directory": scratch, "no-dashboard": "",
        "death-timeout": "60",
    }  # fmt: skip
    run_workers([scheduler, *(f"--{name}={value}" if value else f"--{name}" for name, value in options.items())])


if __name__ == "__main__":
    main(*sys.argv[1:])
