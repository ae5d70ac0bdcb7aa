"""Parts of COLMAP in processes of their own: what they say, how they fail, and that they end."""

import contextlib
import importlib
import os
import signal
import subprocess
import sys
import time
from functools import partial
from types import SimpleNamespace

import psutil
import pytest

from sfm_app.colmap.worker_process import run_worker, start_worker
from sfm_app.errors import BackendError
from sfm_app.operating_system import Ability

pytestmark = pytest.mark.slow
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")

CHILD = """
import os, signal, sys, time
from sfm_app.colmap.worker_process import ProgressReporter, report

def work(number=0):
    {work}
"""


@pytest.fixture
def child(tmp_path, monkeypatch):
    """A function of a module that a process of its own can import."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    monkeypatch.syspath_prepend(tmp_path)

    def make(work):
        (tmp_path / "some_child.py").write_text(CHILD.format(work=work))
        monkeypatch.delitem(sys.modules, "some_child", raising=False)
        return importlib.import_module("some_child").work

    return make


def test_a_process_returns_the_result_of_its_call_and_not_what_libraries_print(child):
    work = "print('hello'); os.system('echo hello'); return {(1, 2): 2 * number}"
    assert run_worker(partial(child(work), 21), "working") == {(1, 2): 42}


def test_nothing_is_imported_from_the_current_folder(child, tmp_path, monkeypatch):
    work = child("return 'well'")
    for name in ("json", "zlib", "numpy", "pycolmap"):
        (tmp_path / "here").mkdir(exist_ok=True)
        (tmp_path / "here" / f"{name}.py").write_text("raise SystemExit('got in')")
    monkeypatch.chdir(tmp_path / "here")
    assert run_worker(work, "working") == "well"


def test_progress_comes_through(child):
    seen = []
    progress = SimpleNamespace(
        start=lambda *begun: seen.append(begun), advance=seen.append, finish=lambda: seen.append("end")
    )
    work = child("bar = ProgressReporter(); bar.start('photos', 7); bar.advance(3); bar.finish(); return 5")
    assert run_worker(work, "working", progress) == 5
    assert seen[:3] == [("photos", 7), 3, "end"]


@pytest.mark.parametrize(
    ("work", "message"),
    [
        ("raise ValueError('first line\\nat last')", "COLMAP failed while working: at last"),
        ("sys.stderr.write('x' * 1_000_000); sys.stderr.write('\\nthe end'); sys.exit(3)", "working: the end"),
        pytest.param("os.abort()", r"COLMAP failed while working: it crashed \(SIGABRT\)", marks=POSIX),
        ("os._exit(7)", "COLMAP failed while working: it ended with 7"),
        pytest.param(
            "os.kill(os.getpid(), signal.SIGKILL)",
            "the system killed COLMAP while working, perhaps because memory ran out",
            marks=POSIX,
        ),
    ],
)
def test_a_process_that_fails_is_an_error_with_its_last_line(child, work, message):
    with pytest.raises(BackendError, match=message):
        run_worker(child(work), "working")


def test_a_process_is_ended_with_the_block(child):
    with start_worker(child("report(begun=True); time.sleep(600)")) as process:
        next(process.messages())
        assert not process.has_ended(0.0)
    assert process.process.returncode == (1 if sys.platform == "win32" else -signal.SIGKILL)


@pytest.mark.parametrize("taken", [(), (Ability.CLOSED_INPUT,)], ids=["input", "number"])
def test_a_process_ends_when_the_one_that_started_it_is_killed(child, without, taken):
    without(*taken)
    parent = (
        "from sfm_app.colmap.worker_process import start_worker\n"
        "from some_child import work\n"
        "with start_worker(work) as process:\n"
        "    for message in process.messages(): print(message['me'], flush=True)"
    )
    child("report(me=os.getpid()); time.sleep(600)")
    with subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE, text=True) as process:
        orphan = int(process.stdout.readline())
        process.kill()

    until = time.monotonic() + 10.0
    with contextlib.suppress(psutil.NoSuchProcess):
        while psutil.Process(orphan).status() != psutil.STATUS_ZOMBIE:  # which only waits to be buried
            assert time.monotonic() < until
            time.sleep(0.05)
