"""Tasks on a cluster of this machine: the same results in the same order, even if workers are killed."""

import os
import pickle
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from sfm_app.errors import ClusterError, ConfigError, InputError
from sfm_app.progress import Progress
from sfm_app.runtime import cluster
from sfm_app.runtime.cluster import (
    PROCESSOR,
    Cluster,
    Probe,
    Serializer,
    describe_item,
    deserialize,
    differences,
    find_misfit,
    local_workers,
    picklable,
    worker_versions,
)
from sfm_app.runtime.parallel import make_executor, open_executor, ordered_map, threads_elsewhere
from sfm_app.settings import ClusterSettings, Settings
from sfm_app.tasks import Shared, Task

TASKS = """
import os, signal, time
import numpy as np
from pathlib import Path
from sfm_app.errors import InputError

def double(x):
    time.sleep(0.05 if x == 0 else 0)
    return 2 * x, os.getpid()

def add(shared, folder, x):
    return float(shared.value[x]), str(folder)

def large(x):
    return np.full(200_000, x, np.float64)

def refuse(x):
    if x == 3:
        raise InputError("photo 3 is gone", hint="bring it back")
    return x

def only_here(pid, x):
    if os.getpid() != pid:
        raise OSError("no such disk")
    return x

def die_once(folder, x):
    if x == 4 and not (Path(folder) / "died").exists():
        (Path(folder) / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return x

def die_always(x):
    if x == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return x
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a module of tasks that workers can import, and the output folder of a run."""
    folder = tmp_path_factory.mktemp("cluster")
    (folder / "tasks_of_a_test.py").write_text(textwrap.dedent(TASKS))
    return folder


@pytest.fixture(scope="module")
def tasks(place):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(place)
        patch.setenv("PYTHONPATH", os.pathsep.join([str(place), os.environ.get("PYTHONPATH", "")]))
        import tasks_of_a_test

        yield tasks_of_a_test


@pytest.fixture(scope="module")
def two(place, tasks):
    """The executor of a run with two workers."""
    settings = Settings.from_mapping({"cluster": {"address": "local:2"}})
    with open_executor(settings, place / "out" / ".cluster", Progress()) as (executor, workers):
        assert (workers, threads_elsewhere(executor)) == (2, 2)
        yield executor
    assert not (place / "out" / ".cluster").exists()
    rest = [child for child in psutil.Process().children(recursive=True) if "runtime.cluster" in str(child.cmdline())]
    assert rest == []


@pytest.mark.slow
def test_results_keep_their_order_and_come_from_other_processes(two, tasks):
    results = list(ordered_map(two, Task(tasks.double), range(40), ahead=2))
    assert [value for value, _ in results] == [2 * x for x in range(40)]
    assert os.getpid() not in {pid for _, pid in results}


@pytest.mark.slow
def test_functions_that_are_no_tasks_stay_in_this_process(two):
    items = []
    assert list(ordered_map(two, items.append, range(5), ahead=2)) == [None] * 5
    assert sorted(items) == [0, 1, 2, 3, 4]


@pytest.mark.slow
def test_shared_values_travel_as_files_that_do_not_stay(two, tasks, place, monkeypatch):
    monkeypatch.chdir(place)
    values = np.arange(100_000, dtype=np.float64)
    results = list(ordered_map(two, Task(tasks.add, Shared(values), Path("photos")), range(9), ahead=2))
    assert results == [(float(x), str(place / "photos")) for x in range(9)]
    arrays = list(ordered_map(two, Task(tasks.large), range(3), ahead=2))
    assert [array[0] for array in arrays] == [0, 1, 2]
    assert {path.name.split("-")[0] for path in (place / "out" / ".cluster").iterdir()} == {"probe"}


@pytest.mark.slow
def test_an_error_of_a_task_is_raised_as_it_is(two, tasks):
    results = ordered_map(two, Task(tasks.refuse), range(8), ahead=2)
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(InputError, match="photo 3 is gone") as caught:
        next(results)
    assert caught.value.hint == "bring it back"


@pytest.mark.slow
def test_this_process_repeats_tasks_that_fail_on_a_machine(two, tasks):
    assert list(ordered_map(two, Task(tasks.only_here, os.getpid()), range(6), ahead=2)) == list(range(6))


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_a_killed_worker_costs_its_own_tasks_only(two, tasks, tmp_path):
    assert list(ordered_map(two, Task(tasks.die_once, str(tmp_path)), range(12), ahead=2)) == list(range(12))
    assert (tmp_path / "died").exists()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_a_task_that_ends_every_worker_is_named(two, tasks):
    results = ordered_map(two, Task(tasks.die_always), range(4), ahead=2)
    with pytest.raises(ClusterError, match="die_always of 1 ended every worker"):
        list(results)


@pytest.mark.slow
def test_a_narrower_executor_has_the_same_cluster(two, tasks):
    with make_executor(1, like=two) as narrow:
        assert narrow.count_in_flight() == 1
        assert [value for value, _ in ordered_map(narrow, Task(tasks.double), range(5), ahead=2)] == [0, 2, 4, 6, 8]


@pytest.mark.slow
def test_no_scheduler_is_one_line(tmp_path):
    settings = Settings.from_mapping({"cluster": {"address": "127.0.0.1:1", "wait_s": 0.5}})
    with (
        pytest.raises(ClusterError, match=r"no scheduler answers at 127\.0\.0\.1:1"),
        open_executor(settings, tmp_path, Progress()),
    ):
        pass


def test_a_missing_dask_is_an_error_with_the_command_to_install_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(ConfigError, match="Dask") as caught,
        cluster.connect(ClusterSettings(address="local:2"), tmp_path),
    ):
        pass
    assert caught.value.hint == "pip install 'sfm-app[cluster]'"


@pytest.mark.parametrize("address", ["local:0", "local:", "localhost", "http://a/b:1", "a b:1", "local:2000"])
def test_a_malformed_address_is_refused(address):
    with pytest.raises(ConfigError, match="address"):
        Settings.from_mapping({"cluster": {"address": address}})


def test_addresses():
    known = ["", "local:3", "10.0.0.1:8786", "tcp://host:8786", "tls://host:1"]
    for address in known:
        Settings.from_mapping({"cluster": {"address": address}})
    assert [local_workers(address) for address in known] == [0, 3, 0, 0, 0]


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return Path.touch, (Path(self.path),)


def test_paths_are_absolute_elsewhere(tmp_path):
    with Serializer(tmp_path) as serializer:
        values, path = deserialize(serializer.serialize([np.arange(10), Path("here")]))
    np.testing.assert_array_equal(values, np.arange(10))
    assert path == Path("here").absolute()


def test_a_shared_file_that_was_exchanged_is_not_unpickled(tmp_path):
    sprung = tmp_path / "sprung"
    with Serializer(tmp_path / "values") as serializer:
        value = serializer.serialize([Shared(np.arange(10))])
        (file,) = (tmp_path / "values").iterdir()
        assert deserialize(serializer.serialize([Shared(5)]))[0].value == 5
        file.write_bytes(pickle.dumps(Trap(sprung)))
        with pytest.raises(OSError, match="not the file that was sent"):
            deserialize(value)
    assert not sprung.exists()
    pickle.loads(pickle.dumps(Trap(sprung)))  # noqa: S301
    assert sprung.exists()  # the trap works


def test_a_shared_value_is_written_once_and_read_once(tmp_path):
    shared = Shared(list(range(1000)))
    with Serializer(tmp_path) as serializer:
        values = [serializer.serialize((shared, number)) for number in range(3)]
        assert len(list(tmp_path.iterdir())) == 1
        (first, _), (second, number) = deserialize(values[0]), deserialize(values[1])
        assert first is second
        assert (first.value, number) == (shared.value, 1)
    assert list(tmp_path.iterdir()) == []


def test_a_worker_with_other_versions_or_another_folder_does_not_fit(tmp_path):
    (tmp_path / "probe").write_text("probe")
    fitting = Probe(tuple(worker_versions().items()), str(tmp_path), "probe")
    older = Probe((*fitting.versions, ("numpy", "1.0")), str(tmp_path), "probe")
    elsewhere = Probe(fitting.versions, str(tmp_path / "missing" / "folder"), "probe")
    assert find_misfit(fitting) == ""
    assert f"numpy {np.__version__} instead of 1.0" in find_misfit(older)
    assert "cannot be used there" in find_misfit(elsewhere)


def test_other_processors_are_no_difference():
    ours = worker_versions()
    assert differences(ours, {**ours, PROCESSOR: "z80"}) == []
    assert differences(ours, {**ours, "a-plugin": "2"}) == ["a-plugin 2 instead of none"]


class FakeClient:
    """A client with one worker, which answers as told."""

    def __init__(self, answer=None, status="running", workers=1):
        self.answer, self.status, self.workers = answer, status, workers

    def run(self, *_, **__):
        return {"tcp://10.0.0.7:4000": self.answer}

    def scheduler_info(self, **_):
        return {"total_threads": self.workers}


class Late:
    """A reply that does not come."""

    def result(self, **_):
        raise TimeoutError


def test_a_worker_that_differs_is_refused_by_name(tmp_path):
    results = Cluster(FakeClient({**worker_versions(), "numpy": "1.0"}), tmp_path, ClusterSettings(address="host:8786"))
    with pytest.raises(ClusterError, match=r"10\.0\.0\.7:4000 cannot be used: it has numpy 1\.0 instead of"):
        results.check_versions()


@pytest.mark.parametrize(
    ("client", "says"),
    [(FakeClient(status="connecting"), "the scheduler of the cluster .* is gone"),
     (FakeClient(workers=0), "has had no workers for 0 seconds")],
)  # fmt: skip
def test_nobody_waits_forever(tmp_path, client, says):
    results = Cluster(client, tmp_path, ClusterSettings(address="host:8786", wait_s=0.001))
    start = time.monotonic()
    with pytest.raises(ClusterError, match=says):
        results.wait(Late(), "waiting")
    assert time.monotonic() - start < 5


def test_errors_that_cannot_travel_become_text():
    class LocalError(Exception):
        pass

    assert isinstance(picklable(InputError("gone", "look")), InputError)
    assert "LocalError" in str(picklable(LocalError("odd")))


def test_items_are_named_shortly():
    class Photo:
        name = "a.jpg"

    assert [describe_item(item) for item in (Photo(), (1, 2), "b", 1.5)] == ["a.jpg", "(1, 2)", "b", "float"]


def test_a_worker_that_cannot_be_reached_is_left_out_and_one_without_the_program_is_not(tmp_path):
    settings = ClusterSettings(address="host:8786")
    both = FakeClient()
    both.run = lambda *_, **__: {"a:1": worker_versions(), "b:2": OSError("timed out")}
    assert list(Cluster(both, tmp_path, settings).ask_all(worker_versions)) == ["a:1"]
    with pytest.raises(ClusterError, match="no worker of host:8786 answers"):
        Cluster(FakeClient(OSError("timed out")), tmp_path, settings).ask_all(worker_versions)
    with pytest.raises(ClusterError, match=r"10\.0\.0\.7:4000 cannot be used: it cannot run the program: No module"):
        Cluster(FakeClient(ModuleNotFoundError("No module")), tmp_path, settings).ask_all(worker_versions)
