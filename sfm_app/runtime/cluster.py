"""Run tasks on a Dask cluster: serialization, checks of the workers, connection and executor.

``python -m sfm_app.runtime.cluster SCHEDULER COUNT FOLDER PARENT`` starts workers on this machine, one process of one
thread each, in a process group of their own: Ctrl-C does not reach it, and it ends with its parent.
ClusterError: no scheduler answers, it is gone, has no workers or unfit ones, or an item ends each worker that tries it.
"""

import contextlib
import hashlib
import io
import logging
import os
import pickle
import platform
import secrets
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, entry_points, version
from itertools import count, islice
from pathlib import Path
from typing import IO, Any, TypeVar

from sfm_app.errors import BackendError, ClusterError, ConfigError
from sfm_app.files import digest_file, replace_atomically
from sfm_app.operating_system import cpu_seconds, end_group, end_own_group, group_options, watch_parent
from sfm_app.settings import LOCAL_ADDRESS, ClusterSettings
from sfm_app.tasks import Shared, Task

logger = logging.getLogger("sfm_app")
Result = TypeVar("Result")


class OPTIONS:
    """Sizes and times of the work on a cluster."""

    look_s: float = 2.0
    """Seconds between two counts of the workers. Chosen by hand."""
    connecting_s: float = 10.0
    """Most seconds for a connection to a scheduler or worker. Chosen by hand."""
    closing_s: float = 5.0
    """Most seconds to leave a scheduler or end workers. Chosen by hand."""
    in_flight: int = 3
    """Calls in flight per thread of the cluster: one runs, one waits, one returns. Chosen by hand."""
    call_s: float = 0.4
    """Seconds that a call should take: short items travel together. Chosen by hand."""
    most_items: int = 32
    """Most items of a call: the cost of a lost worker. Chosen by hand."""


# Serialization. Pickles are read here only, since they may run any code. Their bytes, or the hashes of their files,
# come through the network of the cluster, which has to be trusted as a whole. A file with another hash is refused.

SHARED, PATH = "shared", "path"
"""Kinds of values that are not pickled themselves."""


class Serializer(contextlib.AbstractContextManager["Serializer"]):
    """Serializes values for processes that share a folder; each shared value is one file until the block ends."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._shared: dict[int, tuple[Shared[Any], Path, str]] = {}

    def __enter__(self) -> "Serializer":
        self.folder.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *error: object) -> None:
        for _, path, _ in self._shared.values():
            path.unlink(missing_ok=True)

    def serialize(self, value: object) -> bytes:
        """Return a value as bytes, in which paths are absolute: workers have another current folder."""
        buffer = io.BytesIO()
        _Pickler(buffer, self).dump(value)
        return buffer.getvalue()

    def share(self, value: Shared[Any]) -> tuple[str, str]:
        """Return path and hash of the file of a shared value; the first call writes it."""
        known = self._shared.get(id(value))
        if known is None:
            path = self.folder / f"shared-{secrets.token_hex(8)}.pickle"
            with replace_atomically(path) as draft, draft.open("wb") as file:
                _Pickler(file, self).dump(value.value)
            # holding the value keeps its id unique
            known = self._shared[id(value)] = value, path, digest_file(path)
        return str(known[1]), known[2]


def deserialize(data: bytes) -> Any:
    """Return a value; OSError if the file of a shared one cannot be read here, or has another hash."""
    return _Unpickler(io.BytesIO(data)).load()


class _Pickler(pickle.Pickler):
    def __init__(self, file: IO[bytes], serializer: Serializer) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._serializer = serializer

    def persistent_id(self, value: object) -> tuple[str, str, str] | None:
        if isinstance(value, Shared):
            return SHARED, *self._serializer.share(value)
        return (PATH, str(value.absolute()), "") if isinstance(value, Path) else None


class _Unpickler(pickle.Unpickler):
    def persistent_load(self, named: tuple[str, str, str]) -> Shared[Any] | Path:
        kind, path, digest = named
        return _read_shared(path, digest) if kind == SHARED else Path(path)


@lru_cache(maxsize=2)  # the shared values of two steps. Chosen by hand
def _read_shared(path: str, digest: str) -> Shared[Any]:
    if digest_file(Path(path)) != digest:
        raise OSError(f"{path} is not the file that was sent")
    with Path(path).open("rb") as file:
        return Shared(_Unpickler(file).load())


# Versions that have to agree on all machines, so that the same seed gives the same bytes.

LIBRARIES = (
    "sfm-app", "numpy", "scipy", "numba", "opencv-contrib-python-headless", "open3d", "open3d-cpu", "pillow",
    "pycolmap", "dask", "distributed",
)  # fmt: skip
"""Packages that compute or transport results."""
PROCESSOR = "processor"
"""Entry that may differ: results then agree as numbers, not as bytes."""


@cache
def worker_versions() -> dict[str, str]:
    """Return versions of Python, plug-ins and libraries, a hash of the program, and the kind of processor."""
    import llvmlite.binding  # numba's: the kind for which kernels are compiled

    plugins = {point.dist.name for point in entry_points(group="sfm_app") if point.dist} - {"sfm-app"}
    digest, root = hashlib.blake2b(digest_size=6), Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py")):  # two checkouts of one version may differ
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return {
        "python": ".".join(platform.python_version_tuple()[:2]),
        **{name: _version(name) for name in (*LIBRARIES, *sorted(plugins))},
        "the program's files": digest.hexdigest(),
        PROCESSOR: str(llvmlite.binding.get_host_cpu_name()),
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


def differences(ours: Mapping[str, str], theirs: Mapping[str, str]) -> list[str]:
    """Return the differing versions, such as "numpy 2.1 instead of 2.0"; processors may differ."""
    names = [name for name in {**ours, **theirs} if name != PROCESSOR and ours.get(name) != theirs.get(name)]
    return [f"{name} {theirs.get(name, 'missing')} instead of {ours.get(name, 'none')}" for name in names]


# The work of a worker: check the versions, apply a task to some items, reply.

MACHINE_ERRORS = (OSError, MemoryError, BackendError)
"""Errors with causes on one machine: a full disk, little memory, a folder that is not mounted."""
_PASSED: set["Probe"] = set()
"""Probes that this process has passed."""


@dataclass(frozen=True, slots=True)
class Probe:
    """Requirements that each worker has to meet: versions, and the shared folder."""

    versions: tuple[tuple[str, str], ...]
    folder: str
    name: str
    """File in it that the coordinator wrote."""


@dataclass(frozen=True, slots=True)
class Reply:
    """Results of a call, and its cost."""

    results: bytes = b""
    """Of the items before the first one that failed, serialized."""
    error: Exception | None = None
    """Of the first item that failed."""
    is_machine_error: bool = False
    unfit: str = ""
    """Why the worker cannot be used; empty if it can."""
    worker: str = ""
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """Of the worker and its finished child processes."""


def answer(probe: Probe, function: bytes, items: bytes) -> Reply:
    """Apply a task to its items, both serialized; errors of the task are part of the reply."""
    if reason := find_misfit(probe):
        from distributed import get_worker

        return Reply(unfit=reason, worker=str(get_worker().address))
    import cv2

    start, spent = time.perf_counter(), cpu_seconds()
    if cv2.getNumThreads() != 1:  # a machine has a worker for each core
        cv2.setNumThreads(1)
    results: list[Any] = []
    error: Exception | None = None
    is_machine_error = False
    try:
        apply = deserialize(function)
        for item in deserialize(items):
            results.append(apply(item))  # noqa: PERF401 - results before an error count
    except Exception as err:  # the coordinator raises it
        error = picklable(err)
        is_machine_error = isinstance(err, MACHINE_ERRORS)
    serialized = Serializer(Path(probe.folder)).serialize(results)
    took, used = time.perf_counter() - start, cpu_seconds() - spent
    return Reply(serialized, error, is_machine_error=is_machine_error, seconds=took, cpu_seconds=used)


def find_misfit(probe: Probe) -> str:
    """Return why this process cannot work for a run; empty if it can."""
    if probe in _PASSED:
        return ""
    if wrong := differences(dict(probe.versions), worker_versions()):
        return "it has " + ", ".join(wrong)
    folder = Path(probe.folder)
    try:
        if (folder / probe.name).read_text(encoding="utf-8") != probe.name:
            return f"it has another {folder.parent}"
        mark = folder / f".{os.getpid()}-{time.monotonic_ns()}"
        mark.touch()
        mark.unlink()
    except OSError as err:
        return f"{folder.parent} cannot be used there: {err.strerror or err}"
    _PASSED.add(probe)
    return ""


def picklable(err: Exception) -> Exception:
    """Return the error, or its text where it cannot be pickled and read again."""
    try:
        if type(pickle.loads(pickle.dumps(err))) is type(err):  # noqa: S301 - its own bytes
            return err
    except Exception:  # noqa: S110 - `__reduce__` and `__init__` may raise anything
        pass
    return RuntimeError(f"{type(err).__name__}: {err}")


# The connection: to a running cluster, or to processes of this machine that end with the run.

RESUME_HINT = "start it again, and the same command resumes; or leave --cluster out"


def local_workers(address: str) -> int:
    """Return the number of processes that an address such as `local:2` asks for; 0 for other addresses."""
    local = LOCAL_ADDRESS.fullmatch(address)
    return int(local[1]) if local else 0


class Cluster:
    """The workers of a cluster, seen from the coordinating process: at most `limit` at once, or all for 0."""

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
        """Return how many tasks can run at once; at least 1."""
        return max(1, self._count_threads())

    def _count_threads(self) -> int:
        """Return the threads of all workers; the scheduler is asked at most every `look_s` seconds."""
        if self.client.status != "running":
            raise self.make_loss_error()
        now = time.monotonic()
        if now - self._looked_at > OPTIONS.look_s:
            self._threads = int(self.client.scheduler_info(n_workers=0).get("total_threads", -1))
            self._looked_at = now
        if self._threads < 0:  # the connection broke
            raise self.make_loss_error()
        return self._threads

    def probe(self) -> Probe:
        """Return the requirements of this run, after checking all present workers."""
        if self._probe is None:
            self.folder.mkdir(parents=True, exist_ok=True)
            name = f"probe-{secrets.token_hex(8)}.txt"
            (self.folder / name).write_text(name, encoding="utf-8", newline="\n")
            probe = Probe(tuple(worker_versions().items()), str(self.folder.resolve()), name)
            reasons = self.ask_all(find_misfit, probe)
            self._refuse({worker: reason for worker, reason in reasons.items() if reason})
            self._probe = probe
        return self._probe

    def check_versions(self) -> list[str]:
        """Return the other kinds of processors among the workers."""
        ours = worker_versions()
        others = self.ask_all(worker_versions)
        wrong = {worker: differences(ours, theirs) for worker, theirs in others.items()}
        self._refuse({worker: "it has " + ", ".join(texts) for worker, texts in wrong.items() if texts})
        return sorted({theirs[PROCESSOR] for theirs in others.values()} - {ours[PROCESSOR]})

    def _refuse(self, unfit: dict[str, str]) -> None:
        for worker, reason in unfit.items():
            raise ClusterError(
                f"the worker {worker} cannot be used: {reason}",
                hint="every machine needs the same installation, and OUT under the same path: see docs/cluster.md",
            )

    def ask_all(self, question: Any, *about: Any) -> dict[str, Any]:
        """Return the answer of each reachable worker, by its address; ClusterError if none has the program."""
        try:
            answers = dict(self.client.run(question, *about, on_error="return"))
        except Exception as err:  # the scheduler itself could not ask
            raise self.make_loss_error() from err
        for worker, reply in list(answers.items()):
            if isinstance(reply, OSError):  # its connection broke: it has left, or it is asked again later
                logger.info("the worker %s does not answer: %s", worker, reply)
                del answers[worker]
            elif isinstance(reply, Exception):
                self._refuse({worker: f"it cannot run the program: {reply}"})
        if not answers:
            raise ClusterError(f"no worker of {self.address} answers", hint=RESUME_HINT)
        return answers

    def submit(self, function: bytes, items: bytes, key: str) -> Any:
        """Send a serialized task and items to some worker, and return Dask's future of its reply; the key is unique."""
        probe = self.probe()
        try:
            return self.client.submit(answer, probe, function, items, key=key, pure=False)
        except Exception as err:  # the client is closed, or its connection broke
            raise self.make_loss_error() from err

    def wait(self, future: Any, what: str) -> Reply | None:
        """Return the reply of a call; None if each worker that tried it ended."""
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
            except Exception as err:  # the worker could not begin
                raise ClusterError(f"{what} cannot run on a worker: {err}", hint="see docs/cluster.md") from err
            self._empty_since = None
            self.cpu_seconds += reply.cpu_seconds
            return reply  # type: ignore[no-any-return]

    def make_loss_error(self) -> ClusterError:
        """Return the error that says that the scheduler is gone."""
        return ClusterError(f"the scheduler of the cluster ({self.address}) is gone", hint=RESUME_HINT)

    def _check_alive(self) -> None:
        if self._count_threads():
            self._empty_since = None
            return
        now = time.monotonic()
        self._empty_since = self._empty_since or now
        if now - self._empty_since > self.settings.wait_s:
            raise ClusterError(
                f"the cluster {self.address} has had no workers for {self.settings.wait_s:.0f} seconds",
                hint="start workers; the same command resumes",
            )


@contextlib.contextmanager
def connect(settings: ClusterSettings, folder: Path) -> Iterator[Cluster]:
    """Provide the cluster of an address; a cluster on this machine ends with the block."""
    count = local_workers(settings.address)
    try:
        import distributed
    except ImportError:
        raise ConfigError("a cluster needs Dask", hint="pip install 'sfm-app[cluster]'") from None
    known = [name for name in logging.root.manager.loggerDict if name.startswith("distributed.")]
    for name in ("distributed", "tornado", "asyncio", *known):  # this program reports errors in one line
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    import dask

    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.comm.timeouts.connect": f"{OPTIONS.connecting_s:.0f}s"}))
        address = stack.enter_context(_local_scheduler(settings.wait_s)) if count else settings.address
        try:
            client = distributed.Client(address, timeout=settings.wait_s, set_as_default=False)
        except (OSError, ValueError, TypeError) as err:
            logger.info("no scheduler answers", exc_info=err)
            raise ClusterError(f"no scheduler answers at {settings.address}", hint=RESUME_HINT) from err
        stack.callback(_close, client)
        if count:
            stack.enter_context(_start_workers(address, count))
        try:
            client.wait_for_workers(max(1, count), timeout=settings.wait_s)
        except TimeoutError as err:
            raise ClusterError(f"the scheduler {settings.address} has no workers", hint="see docs/cluster.md") from err
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
            scheduler.close(timeout=min(OPTIONS.closing_s, wait_s))


@contextlib.contextmanager
def _start_workers(address: str, count: int) -> Iterator[None]:
    """Run worker processes that end with the block, and with this process."""
    with tempfile.TemporaryDirectory(prefix="sfm-app-workers-", ignore_cleanup_errors=True) as scratch:
        command: Sequence[str] = (
            sys.executable, "-P", "-m", "sfm_app.runtime.cluster", address, str(count), scratch, str(os.getpid()),
        )  # fmt: skip
        with subprocess.Popen(  # noqa: S603 - our module
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            **group_options(),
        ) as process:  # fmt: skip
            try:
                yield
            finally:
                end_group(process, OPTIONS.closing_s)


def _close(client: Any) -> None:
    with contextlib.suppress(Exception):
        client.close(timeout=OPTIONS.closing_s)


def run_local_workers(scheduler: str, count: str, scratch: str, parent: str) -> None:
    """Run `count` workers until the process with the number `parent` ends; `scratch` is Dask's folder."""
    import dask
    from distributed.cli.dask_worker import main as run_workers

    dask.config.set({"distributed.worker.profile.enabled": False})  # it samples all threads a hundred times a second
    watch_parent(int(parent), end_own_group)
    options = {
        "nworkers": count, "nthreads": "1", "memory-limit": "0", "local-directory": scratch, "no-dashboard": "",
        "death-timeout": "60",
    }  # fmt: skip
    run_workers([scheduler, *(f"--{name}={value}" if value else f"--{name}" for name, value in options.items())])


# The executor: tasks go to the cluster, other functions to threads of this process.


@dataclass(slots=True, eq=False)
class _Flight:
    items: list[Any]
    future: Any = field(default=None)


class ClusterExecutor(ThreadPoolExecutor):
    """Threads of this process, and a cluster for tasks; on this machine, `workers` is also the most tasks at once."""

    def __init__(self, cluster: Cluster, workers: int) -> None:
        super().__init__(max_workers=workers, thread_name_prefix="sfm")
        self.cluster, self.workers = cluster, workers

    def spread(self, task: Task[Result], items: Iterable[Any]) -> Iterator[Result]:
        """Yield the results of a task in the order of the items, which are drawn only as they are needed.

        Another worker repeats a call whose worker is lost. This process repeats items that fail with a machine error.
        """
        with Serializer(self.cluster.folder) as serializer:
            yield from _Spreading(self, task, serializer).results(iter(items))

    def count_in_flight(self) -> int:
        """Return the most calls in flight; on this machine, planned memory limits them."""
        threads = self.cluster.threads()
        return self.workers if self.cluster.limit > self.workers else OPTIONS.in_flight * threads


class _Spreading:
    def __init__(self, executor: ClusterExecutor, task: Task[Any], serializer: Serializer) -> None:
        self.executor, self.cluster, self.task, self.serializer = executor, executor.cluster, task, serializer
        self.function = serializer.serialize(task)
        self.name = getattr(task.func, "__name__", "task").lstrip("_")
        self._keys = (f"sfm-{self.name}-{secrets.token_hex(6)}-{number}" for number in count())
        self._size = 1

    def results(self, items: Iterator[Any]) -> Iterator[Any]:
        """Yield results in the order of the items; calls in flight are canceled if the caller stops."""
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
            with contextlib.suppress(Exception):  # the scheduler may be gone
                self.cluster.client.cancel([flight.future for flight in flights], force=True)

    def _send(self, items: list[Any]) -> _Flight:
        future = self.cluster.submit(self.function, self.serializer.serialize(items), next(self._keys))
        return _Flight(items, future)

    def _land(self, flight: _Flight, *, again: bool = False) -> Iterator[Any]:
        """Yield the results of a call; if it lost its workers, its items are sent once more (`again`), each alone."""
        reply = self._wait(flight)
        if reply is None and again:
            raise ClusterError(
                f"{self.name} of {describe_item(flight.items[0])} ended every worker that tried: perhaps their memory "
                "was full",
                hint="give workers more memory, or use --quality draft; the same command resumes",
            )
        if reply is None:  # calls that waited on the lost workers count as lost, too: find the one to blame
            for item in flight.items:
                yield from self._land(self._send([item]), again=True)
            return
        done = deserialize(reply.results)
        if done:
            best = OPTIONS.call_s * len(done) / max(reply.seconds, 1e-6)
            self._size = max(1, min(OPTIONS.most_items, int(best), 2 * self._size))
        yield from done
        if reply.error is not None and reply.is_machine_error:
            logger.info("this process does %s, since a worker failed: %s", self.name, reply.error, exc_info=reply.error)
            for item in flight.items[len(done) :]:
                yield self.executor.submit(self.task, item).result()
        elif reply.error is not None:
            raise reply.error

    def _wait(self, flight: _Flight) -> Reply | None:
        """Return the reply of a call; an unfit worker is removed, and the call is sent again."""
        while True:
            reply = self.cluster.wait(flight.future, self.name)
            if reply is None or not reply.unfit:
                return reply
            logger.info("the program removes a worker: %s", reply.unfit)
            with contextlib.suppress(Exception):  # it may be gone already
                self.cluster.client.retire_workers([reply.worker], close_workers=True)
            flight.future = self._send(flight.items).future


def describe_item(item: object) -> str:
    """Return a short name of an item of a task."""
    name = getattr(item, "name", None) or getattr(item, "pair", None)
    if name is None and isinstance(item, str | int | tuple):
        name = item
    return str(name)[:80] if name is not None else type(item).__name__


if __name__ == "__main__":
    run_local_workers(*sys.argv[1:])
