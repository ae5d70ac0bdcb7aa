"""All parallel work goes through one concurrent.futures.Executor."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def worker_count(wanted: int) -> int:
    """Return the number of workers; 0 stands for one per core that this process may use."""
    if wanted > 0:
        return wanted
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def make_executor(workers: int) -> Executor:
    """Make a thread pool: the heavy work (numba, OpenCV, COLMAP) releases the GIL, and nothing has to be pickled."""
    return ThreadPoolExecutor(max_workers=workers, thread_name_prefix="sfm")


def ordered_map(
    executor: Executor, function: Callable[[Item], Result], items: Iterable[Item], ahead: int
) -> Iterator[Result]:
    """Yield results in the order of the items, with few of them in flight, so that memory stays bounded.

    When the caller stops early or an item fails, the calls that have not begun are canceled.

    Args:
        executor, function: its workers apply the function to each item.
        items: drawn only as they are needed.
        ahead: most items in flight; at least 1.
    """
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
