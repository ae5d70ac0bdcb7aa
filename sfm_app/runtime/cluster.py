"""A Dask cluster: its workers, and tasks and values on their way to them."""

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
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, entry_points, version
from itertools import count, islice
from pathlib import Path
from typing import IO, Any, TypeVar

from sfm_app.errors import BackendError, ClusterError, ConfigError
from sfm_app.files import replace_atomically
from sfm_app.operating_system import cpu_seconds, end_group, group_options
from sfm_app.settings import LOCAL_ADDRESS, ClusterSettings
from sfm_app.tasks import Shared, Task

# Values on their way between processes: small ones as bytes, large ones as files of a folder that all can read.
#
# This is the only place where pickles are read, since they may run anything. Their bytes, or the hashes of their
# files, come through the network of the cluster, which has to be trusted as a whole. A file that is not the one
# that was sent is refused.

SMALL_BYTES = 500_000
"""Larger values travel as files. Chosen by hand: the scheduler passes on what is smaller."""
KEPT = 2
"""Shared values that a worker keeps in memory: those of this step, and of one beside it. Chosen by hand."""
SHARED, PATH = "shared", "path"
"""What is not pickled itself."""


@dataclass(frozen=True, slots=True)
class Parcel:
    """A pickled value."""

    data: bytes
    path: str = ""
    """File that has the value instead; empty where `data` has it."""
    digest: str = ""
    """Hash of the file."""


class Packer:
    """Packs values for other processes; each shared value becomes a file once, and is removed with the packer.

    Args:
        folder: all processes read and write it under this path.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._shared: dict[int, tuple[Shared[Any], Path, str]] = {}

    def pack(self, value: object) -> Parcel:
        """Return a value as a parcel."""
        buffer = io.BytesIO()
        _Pickler(buffer, self).dump(value)
        data = buffer.getvalue()
        if len(data) <= SMALL_BYTES:
            return Parcel(data)
        path = self.folder / f"parcel-{secrets.token_hex(8)}.pickle"
        with replace_atomically(path) as beside:
            beside.write_bytes(data)
        return Parcel(b"", str(path), hashlib.blake2b(data).hexdigest())

    def share(self, value: Shared[Any]) -> tuple[str, str]:
        """Return the path and the hash of the file of a shared value; it is written if it is not yet there."""
        known = self._shared.get(id(value))
        if known is None:
            path = self.folder / f"shared-{secrets.token_hex(8)}.pickle"
            with replace_atomically(path) as beside, beside.open("wb") as file:
                _Pickler(file, self).dump(value.value)
            # the value is held, so that its id stays its own
            known = self._shared[id(value)] = value, path, _digest(path)
        return str(known[1]), known[2]

    def remove_shared(self) -> None:
        """Remove the files of shared values."""
        for _, path, _ in self._shared.values():
            path.unlink(missing_ok=True)
        self._shared.clear()


@contextmanager
def packing(folder: Path) -> Iterator[Packer]:
    """Provide a packer, and remove the files of shared values at the end of the block.

    Args:
        folder: where the files go; created if it is missing.
    """
    folder.mkdir(parents=True, exist_ok=True)
    packer = Packer(folder)
    try:
        yield packer
    finally:
        packer.remove_shared()


def unpack(parcel: Parcel, *, remove: bool = False) -> Any:
    """Return the value of a parcel.

    Args:
        parcel: from `Packer.pack`.
        remove: whether its file is no longer needed.

    Raises:
        OSError: the file cannot be read here, or is not the one that was sent.
    """
    if not parcel.path:
        return _Unpickler(io.BytesIO(parcel.data)).load()
    value = _load(parcel.path, parcel.digest)
    if remove:
        Path(parcel.path).unlink(missing_ok=True)
    return value


def survives_travel(value: object) -> bool:
    """Return whether a value has the same type after it was pickled and read again."""
    try:
        return type(pickle.loads(pickle.dumps(value))) is type(value)  # noqa: S301 - its own bytes
    except Exception:  # `__reduce__` and `__init__` may raise anything
        return False


class _Pickler(pickle.Pickler):
    """Leaves shared values out, and makes paths absolute: workers have another current folder."""

    def __init__(self, file: IO[bytes], packer: Packer) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self._packer = packer

    def persistent_id(self, value: object) -> tuple[str, str, str] | None:
        if isinstance(value, Shared):
            return SHARED, *self._packer.share(value)
        return (PATH, str(value.absolute()), "") if isinstance(value, Path) else None


class _Unpickler(pickle.Unpickler):
    def persistent_load(self, named: tuple[str, str, str]) -> Shared[Any] | Path:
        kind, path, digest = named
        return _read_shared(path, digest) if kind == SHARED else Path(path)


@lru_cache(maxsize=KEPT)
def _read_shared(path: str, digest: str) -> Shared[Any]:
    return Shared(_load(path, digest))


def _load(path: str, digest: str) -> Any:
    """Return the value in a file, if it is the one that was sent."""
    if _digest(Path(path)) != digest:
        raise OSError(f"{path} is not the file that was sent")
    with Path(path).open("rb") as file:
        return _Unpickler(file).load()


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "blake2b").hexdigest()


# What has to be the same on all machines, so that the same seed gives the same bytes.

LIBRARIES = (
    "sfm-app", "numpy", "scipy", "numba", "opencv-contrib-python-headless", "open3d", "open3d-cpu", "pillow",
    "pycolmap", "dask", "distributed",
)  # fmt: skip
"""Packages that compute results, or that the machines talk through."""
PROCESSOR = "processor"
"""Name of the one entry that may differ: results then agree as numbers, but not byte by byte."""


@cache
def worker_versions() -> dict[str, str]:
    """Return the versions of Python, of the program and its plug-ins, of libraries, and the kind of processor."""
    plugins = {point.dist.name: point.dist.version for point in entry_points(group="sfm_app") if point.dist}
    return {
        "python": ".".join(platform.python_version_tuple()[:2]),
        **{name: _version(name) for name in LIBRARIES},
        **{name: found for name, found in sorted(plugins.items()) if name != "sfm-app"},
        "the program's files": _digest_program(),
        PROCESSOR: _processor(),
    }


def differences(ours: Mapping[str, str], theirs: Mapping[str, str]) -> list[str]:
    """Return what differs between two machines, as texts such as "numpy 2.1 instead of 2.0"; the processor may.

    Args:
        ours: versions of this machine.
        theirs: versions of a worker.
    """
    names = [name for name in {**ours, **theirs} if name != PROCESSOR and ours.get(name) != theirs.get(name)]
    return [f"{name} {theirs.get(name, 'missing')} instead of {ours.get(name, 'none')}" for name in names]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "missing"


def _digest_program() -> str:
    """Return a hash of the program's source, which two checkouts of the same version may differ in."""
    found, root = hashlib.blake2b(digest_size=6), Path(__file__).parents[2]
    for path in sorted(root.rglob("*.py")):
        found.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return found.hexdigest()


def _processor() -> str:
    import llvmlite.binding  # numba's: the kind for which kernels are compiled

    return str(llvmlite.binding.get_host_cpu_name())


# What a worker of the cluster does: checks that it fits, applies a task to some items, and reports.

OF_THE_MACHINE = (OSError, MemoryError, BackendError)
"""Errors that a machine may be to blame for: a full disk, little memory, a folder that is not mounted."""
_FITS: set["Probe"] = set()
"""Probes that this process has passed."""


@dataclass(frozen=True, slots=True)
class Probe:
    """What a worker has to have: the same versions, and the same folder."""

    versions: tuple[tuple[str, str], ...]
    folder: str
    """Folder of parcels, in the output folder."""
    name: str
    """File in it that the coordinator has written."""


@dataclass(frozen=True, slots=True)
class Call:
    """A task and some of its items, on the way to a worker."""

    probe: Probe
    function: Parcel
    items: Parcel


@dataclass(frozen=True, slots=True)
class Reply:
    """What a worker has to say of a call."""

    results: Parcel | None = None
    """List of the results of the first items, up to one that failed."""
    error: Exception | None = None
    """Of the first item that failed."""
    is_of_machine: bool = False
    """Whether the error may be the machine's."""
    unfit: str = ""
    """Why the worker cannot be used; it has not begun."""
    worker: str = ""
    """Its address, where it cannot be used."""
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """Of the worker, and of processes that it has waited for."""


def answer(call: Call) -> Reply:
    """Apply a task to its items; errors of the task are part of the reply."""
    if reason := find_misfit(call.probe):
        from distributed import get_worker

        return Reply(unfit=reason, worker=str(get_worker().address))
    start, spent = time.perf_counter(), cpu_seconds()
    _use_one_thread()
    results: list[Any] = []
    error: Exception | None = None
    is_of_machine = False
    try:
        function = unpack(call.function)
        for item in unpack(call.items):
            results.append(function(item))  # noqa: PERF401 - what was done before an error is kept
    except Exception as err:  # of whatever kind: the coordinator raises it
        error = picklable(err)
        is_of_machine = isinstance(err, OF_THE_MACHINE)
    packed = Packer(Path(call.probe.folder)).pack(results)
    took, used = time.perf_counter() - start, cpu_seconds() - spent
    return Reply(packed, error, is_of_machine=is_of_machine, seconds=took, cpu_seconds=used)


def find_misfit(probe: Probe) -> str:
    """Return why this process cannot be a worker of a run; empty where it can."""
    if probe in _FITS:
        return ""
    if wrong := differences(dict(probe.versions), worker_versions()):
        return "it has " + ", ".join(wrong)
    place = Path(probe.folder)
    try:
        if (place / probe.name).read_text(encoding="utf-8") != probe.name:
            return f"it has another {place.parent}"
        mark = place / f".{os.getpid()}-{time.monotonic_ns()}"
        mark.touch()
        mark.unlink()
    except OSError as err:
        return f"{place.parent} cannot be used there: {err.strerror or err}"
    _FITS.add(probe)
    return ""


def picklable(err: Exception) -> Exception:
    """Return an error as it can travel: itself, or its text where it cannot be pickled."""
    return err if survives_travel(err) else RuntimeError(f"{type(err).__name__}: {err}")


def _use_one_thread() -> None:
    """Let OpenCV use one thread, since a machine has a worker for each core."""
    import cv2

    if cv2.getNumThreads() != 1:
        cv2.setNumThreads(1)


# A Dask cluster: one that runs somewhere, or some processes of this machine that end with the run.

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
            sys.executable, "-P", "-m", "sfm_app.runtime.local_workers", address, str(count), scratch,
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


# An executor that sends tasks to a cluster, and does everything else in threads of this process.

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
