"""Parts of COLMAP in processes of their own: what they say, how they fail, and that they end."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from sfm_app.colmap.worker_process import relay, start_worker
from sfm_app.errors import BackendError
from sfm_app.operating_system import Ability

pytestmark = pytest.mark.slow
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such signals")

CHILD = """
import os, signal, sys, time
from sfm_app.colmap.worker_process import ProgressReporter, report, serve

def work(task):
    {work}

serve(work)
"""


@pytest.fixture
def child(tmp_path, monkeypatch):
    """A module that does something in a process of its own, by its name."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))

    def make(work):
        (tmp_path / "some_child.py").write_text(CHILD.format(work=work))
        return "some_child"

    return make


def call(module, **task):
    with start_worker(module, task) as process:
        found = list(process.messages())
        process.check("working")
    return found


def test_a_process_gets_its_task_and_reports_what_it_found_and_not_what_libraries_print(child):
    work = "print('hello'); os.system('echo hello'); report(twice=2 * task['number'])"
    assert call(child(work), number=21) == [{"twice": 42}]


def test_nothing_is_imported_from_the_current_folder(child, tmp_path, monkeypatch):
    for name in ("json", "zlib", "numpy", "pycolmap"):
        (tmp_path / "here").mkdir(exist_ok=True)
        (tmp_path / "here" / f"{name}.py").write_text("raise SystemExit('got in')")
    monkeypatch.chdir(tmp_path / "here")
    assert call(child("report(well=True)")) == [{"well": True}]


def test_progress_comes_through(child):
    class Seen(list):
        def start(self, label, total):
            self.append((label, total))

        def advance(self, steps=1):
            self.append(steps)

        def finish(self):
            self.append("end")

    seen = Seen()
    module = child(
        "bar = ProgressReporter(); bar.start('photos', 7); bar.advance(3); bar.finish(); report(a=1); report(b=2)"
    )

    with start_worker(module, {}) as process:
        found = relay(process, seen)

    assert (seen[:3], found) == ([("photos", 7), 3, "end"], {"a": 1, "b": 2})


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
        call(child(work))


def test_a_process_is_ended_with_the_block(child):
    with start_worker(child("report(begun=True); time.sleep(600)"), {}) as process:
        next(process.messages())
        assert not process.has_ended(0.0)
    assert process.process.returncode == (1 if sys.platform == "win32" else -signal.SIGKILL)


@pytest.mark.parametrize("taken", [(), (Ability.CLOSED_INPUT,)], ids=["input", "number"])
def test_a_process_ends_when_the_one_that_started_it_is_killed(child, without, taken):
    without(*taken)
    parent = (
        "import sys; from sfm_app.colmap.worker_process import start_worker\n"
        "with start_worker(sys.argv[1], {}) as process:\n"
        "    for message in process.messages(): print(message['me'], flush=True)"
    )
    command = [sys.executable, "-c", parent, child("report(me=os.getpid()); time.sleep(600)")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        orphan = int(process.stdout.readline())
        process.kill()

    until = time.monotonic() + 10.0
    with contextlib.suppress(psutil.NoSuchProcess):
        while psutil.Process(orphan).status() != psutil.STATUS_ZOMBIE:  # which only waits to be buried
            assert time.monotonic() < until
            time.sleep(0.05)
