"""One concurrent.futures.Executor for all work, and its results in the order of the items."""

import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from sfm_app.operating_system import usable_cores
from sfm_app.progress import Progress
from sfm_app.runtime.cluster import ClusterExecutor, connect, local_workers
from sfm_app.settings import Settings
from sfm_app.tasks import Task

Item = TypeVar("Item")
Result = TypeVar("Result")


def worker_count(wanted: int) -> int:
    """Return the number of workers; 0 stands for one per core that this process may use."""
    return wanted if wanted > 0 else usable_cores()


def make_executor(workers: int, like: Executor | None = None) -> Executor:
    """Make a thread pool: the heavy work (numba, OpenCV, COLMAP) releases the GIL, and nothing has to be pickled.

    Args:
        workers: threads.
        like: where it sends tasks to a cluster, the new one does so, too.
    """
    if isinstance(like, ClusterExecutor):
        return ClusterExecutor(like.cluster, workers)
    return ThreadPoolExecutor(max_workers=workers, thread_name_prefix="sfm")


@contextmanager
def open_executor(settings: Settings, folder: Path, progress: Progress) -> Iterator[tuple[Executor, int]]:
    """Provide the executor of a run, and its number of workers; both end with the block.

    Args:
        settings: number of workers, and the cluster, if any.
        folder: for large values on their way to the cluster, in the output folder; removed at the end.
        progress: shows with whom the run works.

    Raises:
        ConfigError: Dask is not installed.
        ClusterError: the cluster does not answer, or it has workers that cannot be used.
    """
    if not settings.cluster.address:
        workers = worker_count(settings.workers)
        with make_executor(workers) as threads:
            yield threads, workers
        return
    workers = local_workers(settings.cluster.address) or worker_count(settings.workers)
    if not local_workers(settings.cluster.address):
        waits = f"it may take {settings.cluster.wait_s:.0f} seconds to answer"
        progress.say(f"looking for the cluster {settings.cluster.address}; {waits}")
    with connect(settings.cluster, folder) as cluster:
        others = cluster.check_versions()
        progress.say(f"{cluster.threads()} workers of the cluster {cluster.address}")
        if others:
            progress.say(f"workers with other processors ({', '.join(others)}): results may differ in the last digits")
        try:
            with ClusterExecutor(cluster, workers) as executor:
                yield executor, workers
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def ordered_map(
    executor: Executor, function: Callable[[Item], Result], items: Iterable[Item], ahead: int
) -> Iterator[Result]:
    """Yield results in the order of the items, with few of them in flight, so that memory stays bounded.

    When the caller stops early or an item fails, the calls that have not begun are canceled.

    Args:
        executor, function: its workers apply the function to each item; only a `Task` leaves this process.
        items: drawn only as they are needed.
        ahead: most items in flight; at least 1. On a cluster, its size decides.

    Raises:
        ClusterError: the cluster is gone, or a task ends every worker that it meets.
    """
    if isinstance(executor, ClusterExecutor) and isinstance(function, Task):
        yield from executor.spread(function, items)
        return
    waiting: list[Future[Result]] = []
    try:
        for item in items:
            waiting.append(executor.submit(function, item))
            if len(waiting) >= ahead:
                yield waiting.pop(0).result()
        while waiting:
            yield waiting.pop(0).result()
    finally:
        for future in waiting:
            future.cancel()


def threads_elsewhere(executor: Executor) -> int:
    """Return how many tasks other processes do at once for an executor; 0 where it has none."""
    return executor.cluster.threads() if isinstance(executor, ClusterExecutor) else 0


def cpu_seconds_elsewhere(executor: Executor) -> float:
    """Return the CPU seconds of all tasks so far that other processes have done for an executor."""
    return executor.cluster.cpu_seconds if isinstance(executor, ClusterExecutor) else 0.0
