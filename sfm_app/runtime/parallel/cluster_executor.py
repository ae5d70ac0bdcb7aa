"""An executor that sends tasks to a cluster, and does everything else in threads of this process."""

import contextlib
import logging
import secrets
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count, islice
from typing import Any, TypeVar

from sfm_app.errors import ClusterError
from sfm_app.runtime.parallel.cluster import Cluster
from sfm_app.runtime.parallel.parcels import Packer, Parcel, packing, unpack
from sfm_app.runtime.parallel.remote_call import Call, Reply
from sfm_app.tasks import Task

logger = logging.getLogger("sfm_app")

Result = TypeVar("Result")

IN_FLIGHT = 3
"""Calls on their way for each thread of the cluster: one that runs, one that waits beside it, one that comes back."""
CALL_S = 0.4
"""Seconds that a call should take: short items travel together, since each call costs some milliseconds."""
MOST_ITEMS = 32
"""Most items of a call: a worker that is lost costs no more. Chosen by hand, like those before."""


@dataclass(slots=True, eq=False)
class _Flight:
    """Some items on their way."""

    items: list[Any]
    future: Any = field(default=None)


class ClusterExecutor(ThreadPoolExecutor):
    """Threads of this process, and a cluster for tasks.

    Args:
        cluster: does tasks.
        workers: threads, for everything that is no task; and how many tasks may run at once on this machine.
    """

    def __init__(self, cluster: Cluster, workers: int) -> None:
        super().__init__(max_workers=workers, thread_name_prefix="sfm")
        self.cluster, self.workers = cluster, workers

    def spread(self, task: Task[Result], items: Iterable[Any]) -> Iterator[Result]:
        """Yield the results of a task for all items, in their order.

        A call whose worker is lost is done by another. What fails for a reason that may be the machine's is done once
        more in this process.

        Args:
            task: what is done.
            items: drawn only as they are needed.

        Raises:
            ClusterError: the scheduler is gone, or an item ends every worker that it meets.
        """
        with packing(self.cluster.folder) as packer:
            yield from _Spreading(self, task, packer).results(iter(items))

    def count_in_flight(self) -> int:
        """Return how many calls may be on their way; on this machine, the memory is what was planned for."""
        threads = self.cluster.threads()
        narrow = self.cluster.limit > self.workers
        return self.workers if narrow else IN_FLIGHT * threads


class _Spreading:
    """One task on its way through all items."""

    def __init__(self, executor: ClusterExecutor, task: Task[Any], packer: Packer) -> None:
        self.executor, self.cluster, self.task, self.packer = executor, executor.cluster, task, packer
        self.probe = self.cluster.probe()
        self.function: Parcel = packer.pack(task)
        self.name = getattr(task.func, "__name__", "task").lstrip("_")
        self._keys = (f"sfm-{self.name}-{secrets.token_hex(6)}-{number}" for number in count())
        self._size = 1

    def results(self, items: Iterator[Any]) -> Iterator[Any]:
        """Yield results in the order of the items; what is on its way is canceled where the caller stops."""
        flights: deque[_Flight] = deque()
        try:
            while True:
                while len(flights) < self.executor.count_in_flight():
                    batch = list(islice(items, self._size))
                    if not batch:
                        break
                    flights.append(self._send(batch))
                if not flights:
                    return
                yield from self._land(flights[0])
                flights.popleft()
        finally:
            self._cancel(flights)

    def _send(self, items: list[Any]) -> _Flight:
        call = Call(self.probe, self.function, self.packer.pack(items))
        return _Flight(items, self.cluster.submit(call, next(self._keys)))

    def _land(self, flight: _Flight) -> Iterator[Any]:
        """Yield the results of some items, wherever they are computed in the end."""
        reply = self._wait(flight)
        if reply is None:  # they need not be to blame: what waited on the same workers counts as lost with them, too
            for item in flight.items:
                yield from self._land_alone(item)
            return
        done = unpack(reply.results, remove=True) if reply.results is not None else []
        self._adapt(reply, len(done))
        yield from done
        left = flight.items[len(done) :]
        if reply.error is not None and reply.is_of_machine:
            logger.info("%s is done here, since a worker failed: %s", self.name, reply.error, exc_info=reply.error)
            for item in left:
                yield self.executor.submit(self.task, item).result()
        elif reply.error is not None:
            raise reply.error

    def _land_alone(self, item: Any) -> Iterator[Any]:
        """Yield the result of an item that has lost its workers, sent once more and alone."""
        flight = self._send([item])
        reply = self._wait(flight)
        if reply is None:
            raise ClusterError(
                f"{self.name} of {describe_item(item)} ended every worker that tried: perhaps their memory was full",
                hint="give workers more memory, or use --quality draft; the same command goes on",
            )
        if reply.error is not None and not reply.is_of_machine:
            raise reply.error
        if reply.error is not None or reply.results is None:
            yield self.executor.submit(self.task, item).result()
        else:
            yield from unpack(reply.results, remove=True)

    def _wait(self, flight: _Flight) -> Reply | None:
        """Return the reply of a call; a worker that cannot be used is left out, and the call is sent again."""
        while True:
            reply = self.cluster.wait(flight.future, self.name)
            if reply is None or not reply.unfit:
                return reply
            logger.info("a worker is left out: %s", reply.unfit)
            self.cluster.leave_out(reply.worker)
            flight.future = self._send(flight.items).future

    def _adapt(self, reply: Reply, done: int) -> None:
        """Choose how many items travel together from how long they took."""
        if done:
            wanted = CALL_S * done / max(reply.seconds, 1e-6)
            self._size = max(1, min(MOST_ITEMS, int(wanted), 2 * self._size))

    def _cancel(self, flights: Iterable[_Flight]) -> None:
        futures = [flight.future for flight in flights]
        with contextlib.suppress(Exception):  # the scheduler may be gone
            self.cluster.client.cancel(futures, force=True)


def describe_item(item: object) -> str:
    """Return a few words that tell which item of a task it is."""
    name = getattr(item, "name", None) or getattr(item, "pair", None)
    if name is None and isinstance(item, str | int | tuple):
        name = item
    return str(name)[:80] if name is not None else type(item).__name__
