"""One concurrent.futures.Executor for all work, and its results in the order of the items."""

import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TypeVar

import scipy.linalg  # noqa: F401 - its library is limited only once it is loaded
from threadpoolctl import threadpool_limits

from sfm_app.operating_system import usable_cores
from sfm_app.progress import Progress
from sfm_app.runtime.cluster import ClusterExecutor, connect, local_workers
from sfm_app.settings import Settings
from sfm_app.tasks import Task

Item = TypeVar("Item")
Result = TypeVar("Result")


def worker_count(setting: int) -> int:
    """Return the number of workers; 0 stands for one per core that this process may use."""
    return setting if setting > 0 else usable_cores()


def make_executor(workers: int, like: Executor | None = None) -> Executor:
    """Make a thread pool, which shares the cluster of `like`: numba, OpenCV and COLMAP release the GIL."""
    if isinstance(like, ClusterExecutor):
        return ClusterExecutor(like.cluster, workers)
    return ThreadPoolExecutor(max_workers=workers, thread_name_prefix="sfm")


@contextmanager
def open_executor(settings: Settings, folder: Path, progress: Progress) -> Iterator[tuple[Executor, int]]:
    """Provide the executor of a run, and its number of workers; both end with the block, and `folder` is removed.

    Linear algebra has one thread meanwhile: several that wait for one another make a Cholesky factorization of 650
    unknowns take a second instead of 7 ms, and sums depend on their number.
    """
    with threadpool_limits(1, user_api="blas"), ExitStack() as stack:
        if settings.cluster.address:
            executor = stack.enter_context(_cluster_executor(settings, folder, progress))
            yield executor, executor.workers
        else:
            workers = worker_count(settings.workers)
            yield stack.enter_context(make_executor(workers)), workers


@contextmanager
def _cluster_executor(settings: Settings, folder: Path, progress: Progress) -> Iterator[ClusterExecutor]:
    workers = local_workers(settings.cluster.address) or worker_count(settings.workers)
    if not local_workers(settings.cluster.address):
        address, wait_s = settings.cluster.address, settings.cluster.wait_s
        progress.say(f"connecting to the cluster {address}; this may take {wait_s:.0f} seconds")
    with connect(settings.cluster, folder) as cluster:
        others = cluster.check_versions()
        progress.say(f"the cluster {cluster.address} has {cluster.threads()} workers")
        if others:
            progress.say(f"workers with other processors ({', '.join(others)}): results may differ in the last digits")
        try:
            with ClusterExecutor(cluster, workers) as executor:
                yield executor
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def ordered_map(
    executor: Executor, function: Callable[[Item], Result], items: Iterable[Item], ahead: int
) -> Iterator[Result]:
    """Yield results in the order of the items, with at most `ahead` of them in flight, so that memory stays bounded.

    If the caller stops early or an item fails, calls that have not begun are canceled. Only a `Task` leaves this
    process, and a cluster chooses its own number in flight.
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
    """Return how many tasks other processes do at once for an executor; 0 without such processes."""
    return executor.cluster.threads() if isinstance(executor, ClusterExecutor) else 0


def cpu_seconds_elsewhere(executor: Executor) -> float:
    """Return the CPU seconds of all tasks that other processes have finished for an executor."""
    return executor.cluster.cpu_seconds if isinstance(executor, ClusterExecutor) else 0.0
