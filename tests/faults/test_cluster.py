"""A cluster that loses a worker or its scheduler: the same bytes in the end, and one line where nothing can go on."""

import json
import signal
import subprocess
import sys
import time

import psutil
import pytest

from .conftest import QUICK, cases

STAGES = ("photos", "match_graph", "view_graph", "scene", "depth_maps", "mesh", "texture")
LONG_S = 900
"""A run that takes longer hangs: on a busy machine, one has taken 200 s."""

pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")]


def start(folder, out, address):
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells let what they start with & ignore it
    command = [sys.executable, "-m", "sfm_app", "run", str(folder.photos), "-o", str(out), *QUICK]
    return subprocess.Popen([*command, "--cluster", address], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(run, out, text):
    """Wait until the log of a run has a text, or the run has ended."""
    log = out / "log.txt"
    while run.poll() is None and not (log.exists() and text in log.read_text()):
        time.sleep(0.02)


def left_over(out):
    """Files of a run that only its cluster needs."""
    return [path.name for path in out.iterdir() if path.name in (".cluster", ".sift_rows")]


@pytest.mark.parametrize("stage", cases(STAGES, {"depth_maps"}))
def test_a_worker_that_is_killed_changes_no_byte(undisturbed, tmp_path, stage):
    out = tmp_path / "out"
    with start(undisturbed, out, "local:2") as run:
        wait_for(run, out, f"{stage} begins")
        time.sleep(0.3)
        below = psutil.Process(run.pid).children(recursive=True)
        # the processes that do tasks: Dask's nannies start them
        next(process for process in below if "spawn_main" in " ".join(process.cmdline())).kill()
        _, said = run.communicate(timeout=LONG_S)

    assert (run.returncode, said) == (0, "")
    assert undisturbed.result(out) == undisturbed.result(undisturbed.out) and left_over(out) == []
    assert [process for process in below if process.is_running() and process.status() != psutil.STATUS_ZOMBIE] == []


def test_workers_end_with_a_run_that_is_killed(undisturbed, tmp_path):
    with start(undisturbed, tmp_path / "out", "local:2") as run:
        wait_for(run, tmp_path / "out", "match_graph begins")
        below = psutil.Process(run.pid).children(recursive=True)
        run.kill()
        run.communicate(timeout=LONG_S)
    assert len(below) >= 3
    _, alive = psutil.wait_procs(below, timeout=30)
    assert alive == []


def test_an_interrupted_run_ends_its_workers_and_goes_on(undisturbed, refused, tmp_path):
    out = tmp_path / "out"
    with start(undisturbed, out, "local:2") as run:
        wait_for(run, out, "depth_maps begins")
        time.sleep(1.0)
        below = psutil.Process(run.pid).children(recursive=True)
        run.send_signal(signal.SIGINT)
        _, said = run.communicate(timeout=LONG_S)
    refused(subprocess.CompletedProcess((), run.returncode, "", said), 130)
    _, alive = psutil.wait_procs(below, timeout=10)
    assert alive == [] and left_over(out) == []
    undisturbed.finish(out)


@pytest.fixture
def scheduler(tmp_path):
    """A scheduler and two workers in processes of their own, and the scheduler's address."""
    file, started = tmp_path / "scheduler.json", []

    def dask(*command):
        process = subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_" + command[0], *command[1:]],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=tmp_path,
        )  # fmt: skip
        started.append(process)
        return process

    first = dask("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    while not file.exists() or '"address"' not in file.read_text():
        assert first.poll() is None
        time.sleep(0.05)

    address = json.loads(file.read_text())["address"]
    for _ in range(2):
        dask("worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
    yield address, first
    for process in started:
        process.send_signal(signal.SIGKILL)
        process.wait()


@pytest.mark.parametrize("stage", cases(STAGES[1:], {"depth_maps"}))
def test_a_scheduler_that_is_gone_is_one_line_and_the_run_goes_on_elsewhere(
    undisturbed, refused, scheduler, tmp_path, stage
):
    address, process = scheduler
    out = tmp_path / "out"
    with start(undisturbed, out, address) as run:
        wait_for(run, out, f"{stage} begins")
        process.kill()
        _, said = run.communicate(timeout=LONG_S)
    lost = subprocess.CompletedProcess((), run.returncode, "", said)
    if stage not in ("scene", "texture"):  # nothing in them has to travel
        refused(lost, 8)
        assert "the scheduler of the cluster" in said
    undisturbed.finish(out)
    assert left_over(out) == []
