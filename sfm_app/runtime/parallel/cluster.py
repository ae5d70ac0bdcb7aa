"""A Dask cluster: one that runs somewhere, or some processes of this machine that end with the run."""

import contextlib
import logging
import os
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from sfm_app.errors import ClusterError, ConfigError
from sfm_app.operating_system import end_group, group_options
from sfm_app.runtime.parallel.remote_call import Call, Probe, Reply, answer, find_misfit
from sfm_app.runtime.parallel.worker_versions import PROCESSOR, differences, worker_versions
from sfm_app.settings import LOCAL_ADDRESS, ClusterSettings

logger = logging.getLogger("sfm_app")

GOES_ON = "start it again, and the same command goes on where this one stopped; or leave --cluster out"
LOOK_S = 2.0
"""Time between two looks at which workers there are, in seconds. Chosen by hand."""
CONNECTING_S = 10.0
"""Most seconds that a scheduler, or a worker, may take to answer a connection. Chosen by hand."""
CLOSING_S = 5.0
"""Most seconds that it takes to say good-bye to a scheduler. Chosen by hand."""


def local_workers(address: str) -> int:
    """Return how many processes of this machine an address such as `local:2` asks for; 0 for any other."""
    found = LOCAL_ADDRESS.fullmatch(address)
    return int(found[1]) if found else 0


class Cluster:
    """The workers of a cluster, as the process that the user has started sees them.

    Args:
        client: Dask's client.
        folder: for large values on their way, in the output folder.
        settings: how long to wait.
        limit: most workers that may work at once; 0 for all. Those of this machine share its memory.
    """

    def __init__(self, client: Any, folder: Path, settings: ClusterSettings, limit: int = 0) -> None:
        self.client, self.folder, self.settings, self.limit = client, folder, settings, limit
        self.cpu_seconds = 0.0
        self._probe: Probe | None = None
        self._empty_since: float | None = None
        self._threads, self._looked_at = -1, float("-inf")

    @property
    def address(self) -> str:
        """Address of the scheduler."""
        return str(self.settings.address)

    def threads(self) -> int:
        """Return how many tasks can run at once; at least 1.

        Raises:
            ClusterError: the scheduler is gone.
        """
        return max(1, self._count_threads())

    def _count_threads(self) -> int:
        """Return the threads of all workers as of a moment ago; each question takes the scheduler some time."""
        if self.client.status != "running":
            raise self.make_loss_error()
        now = time.monotonic()
        if now - self._looked_at > LOOK_S:
            self._threads = int(self.client.scheduler_info(n_workers=0).get("total_threads", -1))
            self._looked_at = now
        if self._threads < 0:  # the connection broke meanwhile
            raise self.make_loss_error()
        return self._threads

    def probe(self) -> Probe:
        """Return what a worker has to have, after checking that all those that are there have it.

        Raises:
            ClusterError: one of them has other versions, or does not see the output folder.
        """
        if self._probe is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            name = f"probe-{secrets.token_hex(8)}.txt"
            (self.folder / name).write_text(name, encoding="utf-8", newline="\n")
            probe = Probe(tuple(worker_versions().items()), str(self.folder.resolve()), name)
            found = self.ask_all(find_misfit, probe)
            self._refuse({worker: why for worker, why in found.items() if why})
            self._probe = probe
        return self._probe

    def check_versions(self) -> list[str]:
        """Check that all workers have the same versions, and return the other kinds of processors among them.

        Raises:
            ClusterError: one has not.
        """
        ours = worker_versions()
        found = self.ask_all(worker_versions)
        wrong = {worker: differences(ours, theirs) for worker, theirs in found.items()}
        self._refuse({worker: "it has " + ", ".join(what) for worker, what in wrong.items() if what})
        return sorted({theirs[PROCESSOR] for theirs in found.values()} - {ours[PROCESSOR]})

    def _refuse(self, unfit: dict[str, str]) -> None:
        for worker, why in unfit.items():
            raise ClusterError(
                f"the worker {worker} cannot be used: {why}",
                hint="every machine needs the same installation, and OUT under the same path: see docs/cluster.md",
            )

    def ask_all(self, question: Any, *about: Any) -> dict[str, Any]:
        """Return the answer of each worker by its address, without those that cannot be reached at the moment.

        Raises:
            ClusterError: none answers, or one does not have the program.
        """
        try:
            found = dict(self.client.run(question, *about, on_error="return"))
        except Exception as err:  # of whatever kind: the scheduler itself could not ask
            raise self.make_loss_error() from err
        for worker, said in list(found.items()):
            if isinstance(said, OSError):  # its connection broke: it has left, or it will be back and be asked again
                logger.info("the worker %s does not answer: %s", worker, said)
                del found[worker]
            elif isinstance(said, Exception):
                self._refuse({worker: f"it cannot run the program: {said}"})
        if not found:
            raise ClusterError(f"no worker of {self.address} answers", hint=GOES_ON)
        return found

    def submit(self, call: Call, key: str) -> Any:
        """Send a call to some worker, and return Dask's future of its reply.

        Args:
            call: what to do.
            key: name that is new.
        """
        try:
            return self.client.submit(answer, call, key=key, pure=False)
        except Exception as err:  # the client is closed, or its connection broke
            raise self.make_loss_error() from err

    def wait(self, future: Any, what: str) -> Reply | None:
        """Return the reply of a call, None where it has ended every worker that it met.

        Args:
            future: of the call.
            what: is done, for messages.

        Raises:
            ClusterError: the scheduler is gone, or it has had no workers for too long.
        """
        from concurrent.futures import CancelledError

        from distributed import KilledWorker
        from distributed.comm import CommClosedError

        while True:
            try:
                reply = future.result(timeout=1.0)
            except TimeoutError:
                self._check_alive()
                continue
            except (CancelledError, CommClosedError) as err:
                raise self.make_loss_error() from err
            except KilledWorker:
                return None
            except Exception as err:  # the worker could not even begin
                raise ClusterError(f"{what} cannot run on a worker: {err}", hint="see docs/cluster.md") from err
            self._empty_since = None
            self.cpu_seconds += reply.cpu_seconds
            return reply  # type: ignore[no-any-return]

    def leave_out(self, address: str) -> None:
        """Remove a worker that cannot be used.

        Args:
            address: of the worker.
        """
        with contextlib.suppress(Exception):  # it may be gone already
            self.client.retire_workers([address], close_workers=True)

    def make_loss_error(self) -> ClusterError:
        """Return the error that says that the scheduler is gone."""
        return ClusterError(f"the scheduler of the cluster ({self.address}) is gone", hint=GOES_ON)

    def _check_alive(self) -> None:
        if self._count_threads():
            self._empty_since = None
            return
        now = time.monotonic()
        self._empty_since = self._empty_since or now
        if now - self._empty_since > self.settings.wait_s:
            raise ClusterError(
                f"the cluster {self.address} has had no workers for {self.settings.wait_s:.0f} seconds",
                hint="start workers; the same command goes on where this one stopped",
            )


@contextlib.contextmanager
def connect(settings: ClusterSettings, folder: Path) -> Iterator[Cluster]:
    """Provide the cluster of an address; one on this machine is made, and ends with the block in any case.

    Args:
        settings: its address, `HOST:PORT` or `local:N`.
        folder: for large values on their way, in the output folder.

    Raises:
        ConfigError: Dask is not installed, or the address is none.
        ClusterError: no scheduler answers, or it has no workers.
    """
    count = local_workers(settings.address)
    try:
        import distributed
    except ImportError:
        raise ConfigError(
            "a cluster needs Dask, which is not installed", hint="pip install 'sfm-app[cluster]'"
        ) from None
    _quiet()
    import dask

    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.comm.timeouts.connect": f"{CONNECTING_S:.0f}s"}))
        address = stack.enter_context(_local_scheduler(settings.wait_s)) if count else settings.address
        try:
            client = distributed.Client(address, timeout=settings.wait_s, set_as_default=False)
        except (OSError, ValueError, TypeError) as err:
            logger.info("no scheduler answers", exc_info=err)
            raise ClusterError(f"no scheduler answers at {settings.address}", hint=GOES_ON) from err
        stack.callback(_close, client)
        if count:
            stack.enter_context(_start_workers(address, count))
        try:
            client.wait_for_workers(max(1, count), timeout=settings.wait_s)
        except TimeoutError as err:
            raise ClusterError(
                f"the scheduler {settings.address} has no workers", hint="start some: see docs/cluster.md"
            ) from err
        yield Cluster(client, folder, settings, limit=count)


@contextlib.contextmanager
def _local_scheduler(wait_s: float) -> Iterator[str]:
    """Provide the address of a scheduler within this process."""
    from distributed import LocalCluster

    try:
        scheduler = LocalCluster(
            n_workers=0, processes=False, dashboard_address="127.0.0.1:0", host="127.0.0.1", protocol="tcp",
            silence_logs=logging.CRITICAL, scheduler_kwargs={"dashboard": False},
        )  # fmt: skip
    except (OSError, RuntimeError) as err:
        raise ClusterError(f"no cluster starts on this machine: {err}", hint="leave --cluster out") from err
    try:
        yield str(scheduler.scheduler_address)
    finally:
        with contextlib.suppress(Exception):
            scheduler.close(timeout=min(CLOSING_S, wait_s))


@contextlib.contextmanager
def _start_workers(address: str, count: int) -> Iterator[None]:
    """Run workers in processes that end with the block, and with this process, however that ends."""
    with tempfile.TemporaryDirectory(prefix="sfm-app-workers-", ignore_cleanup_errors=True) as scratch:
        command: Sequence[str] = (
            sys.executable, "-P", "-m", "sfm_app.runtime.parallel.local_workers", address, str(count), scratch,
            str(os.getpid()),
        )  # fmt: skip
        with subprocess.Popen(  # noqa: S603 - our module
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            **group_options(),
        ) as process:  # fmt: skip
            try:
                yield
            finally:
                end_group(process, CLOSING_S)


def _close(client: Any) -> None:
    """Leave a scheduler, also one that is gone."""
    with contextlib.suppress(Exception):
        client.close(timeout=CLOSING_S)


def _quiet() -> None:
    """Keep Dask's own messages off the terminal: what matters is said in one line by this program."""
    known = [name for name in logging.root.manager.loggerDict if name.startswith("distributed.")]
    for name in ("distributed", "tornado", "asyncio", *known):
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
