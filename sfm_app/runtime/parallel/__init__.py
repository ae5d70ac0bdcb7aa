"""All parallel work: threads of this process or, for tasks, the workers of a Dask cluster. Nothing else knows Dask."""

from sfm_app.runtime.parallel.execution import (
    cpu_seconds_elsewhere,
    make_executor,
    open_executor,
    ordered_map,
    threads_elsewhere,
    worker_count,
)

__all__ = [
    "cpu_seconds_elsewhere",
    "make_executor",
    "open_executor",
    "ordered_map",
    "threads_elsewhere",
    "worker_count",
]
