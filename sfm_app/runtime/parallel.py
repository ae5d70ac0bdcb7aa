"""All parallel work goes through one concurrent.futures.Executor."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def worker_count(wanted: int) -> int:
    """Return how many workers `wanted` stands for; 0 is one per core that this process may use."""
    if wanted > 0:
        return wanted
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def make_executor(workers: int) -> Executor:
    """Give threads: the heavy work (numba kernels, OpenCV, COLMAP) releases the GIL, and nothing has to be pickled."""
    return ThreadPoolExecutor(max_workers=workers, thread_name_prefix="sfm")


def ordered_map(
    executor: Executor, function: Callable[[Item], Result], items: Iterable[Item], ahead: int
) -> Iterator[Result]:
    """Yield results in the order of the items, with few under way, so that memory stays bounded.

    When the caller stops early or an item fails, what has not begun is cancelled.

    Args:
        executor, function: its workers apply the function to each item.
        items: drawn only as they are needed.
        ahead: most items under way; at least 1.
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
