"""Processes end with those that started them, with and without process groups and a standard input to wait for."""

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from sfm_app import operating_system
from sfm_app.operating_system import (
    Ability,
    crash_name,
    end_at_exit,
    end_group,
    end_own_group,
    group_options,
    has_run_out,
    heed_requests_to_end,
    lacks,
)

pytestmark = pytest.mark.slow

WAYS = [(), (Ability.GROUPS,), (Ability.CLOSED_INPUT,), (Ability.GROUPS, Ability.CLOSED_INPUT)]
SLEEP = "import time; time.sleep(600)"
WORKER = f"""
import subprocess, sys
from sfm_app.operating_system import end_own_group, watch_parent
child = subprocess.Popen([sys.executable, "-c", {SLEEP!r}])
print(child.pid, flush=True)
watch_parent(int(sys.argv[1]), end_own_group)
child.wait()
"""
PARENT = f"""
import os, subprocess, sys, time
from sfm_app.operating_system import group_options
command = [sys.executable, "-c", {WORKER!r}, str(os.getpid())]
worker = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **group_options())
print(worker.pid, int(worker.stdout.readline()), flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("taken", WAYS, ids=lambda taken: "+".join(taken) or "all")
def test_a_group_ends_when_the_one_that_started_it_is_killed(without, taken):
    without(*taken)
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        members = [psutil.Process(int(number)) for number in parent.stdout.readline().split()]
        assert len(members) == 2 and all(runs(member) for member in members)
        parent.kill()
    assert all(ends(member) for member in members)


@pytest.mark.parametrize("taken", WAYS[:2], ids=lambda taken: "+".join(taken) or "all")
def test_a_group_is_ended_as_a_whole(without, taken):
    without(*taken)
    command = [sys.executable, "-c", WORKER, str(os.getpid())]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **group_options()
    ) as worker:
        child = psutil.Process(int(worker.stdout.readline()))
        end_group(worker, 10.0)

    assert worker.returncode != 0 and ends(child)
    end_group(worker, 0.0)  # what has ended stays so


def test_who_watches_a_process_that_is_gone_ends_at_once(without):
    without(Ability.CLOSED_INPUT)
    with subprocess.Popen([sys.executable, "-c", "pass"]) as gone:
        pass
    code = (
        f"import os, time; from sfm_app.operating_system import watch_parent\n"
        f"watch_parent({gone.pid}, lambda: os._exit(7)); time.sleep(60)"
    )

    assert subprocess.run([sys.executable, "-c", code], check=False, stdin=subprocess.DEVNULL).returncode == 7


def test_a_process_without_a_group_ends_itself_last(without, monkeypatch):
    without(Ability.GROUPS)
    killed = []
    monkeypatch.setattr(psutil.Process, "kill", lambda process: killed.append(process.pid))
    monkeypatch.setattr(operating_system.os, "_exit", lambda code: killed.append(f"exit {code}"))
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        end_own_group()
    assert killed == [child.pid, os.getpid(), "exit 1"]


def test_ctrl_c_does_not_reach_a_group(without, monkeypatch):
    assert lacks(Ability.GROUPS) or group_options() == {"start_new_session": True}
    without(Ability.GROUPS)
    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0x200, raising=False)
    assert group_options() == {"creationflags": 0x200}


@pytest.mark.parametrize(
    ("code", "name", "run_out"),
    [
        (0, "", False),
        (1, "", False),
        (-6, "SIGABRT", False),
        (-9, "SIGKILL", True),
        (-64, "SIGRTMAX", False),
        (-99, "signal 99", False),
        (0xC0000005, "access violation", False),
        (0xC0000017, "no memory", True),
        (0xC0001234, "fault 0xc0001234", False),
    ],
)
def test_exit_codes_say_what_happened(code, name, run_out):
    assert (crash_name(code), has_run_out(code)) == (name, run_out)


def runs(process):
    return process.is_running() and process.status() != psutil.STATUS_ZOMBIE


def ends(process):
    """Whether a process is gone, or only waits to be buried, within ten seconds."""
    until = time.monotonic() + 10.0
    while time.monotonic() < until:
        try:
            if not runs(process):
                return True
        except psutil.NoSuchProcess:
            return True
        time.sleep(0.05)
    return False


LIBRARY_EXITS = """
import ctypes, time
from sfm_app.operating_system import end_at_exit
library = ctypes.CDLL(None)
wait = ctypes.CFUNCTYPE(None, ctypes.c_int, ctypes.c_void_p)(lambda code, _: print("cleaning up", flush=True))
library.on_exit(wait, None)
{}
library.exit(7)
"""


@pytest.mark.skipif(lacks(Ability.EXIT_HANDLERS), reason="the C library has no on_exit")
@pytest.mark.parametrize(("first", "said"), [("", "cleaning up"), ("end_at_exit()", "")])
def test_a_process_that_a_library_ends_cleans_nothing_up_while_its_threads_work(first, said):
    done = subprocess.run(
        [sys.executable, "-c", LIBRARY_EXITS.format(first)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout.strip()) == (7, said)


def test_without_exit_handlers_the_c_library_is_left_alone(without, monkeypatch):
    asked = []
    monkeypatch.setattr(operating_system.ctypes, "CDLL", asked.append)
    without(Ability.EXIT_HANDLERS)
    end_at_exit()
    assert asked == []


@pytest.mark.skipif(sys.platform == "win32", reason="signals are another thing there")
def test_a_request_to_end_prints_no_stack():
    """COLMAP has a handler of its own, which does."""
    text = "import os, signal; import sfm_app.colmap.backend; os.kill(os.getpid(), signal.SIGTERM)"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, b"")


@pytest.mark.skipif(sys.platform == "win32", reason="signals are another thing there")
def test_a_request_to_end_is_as_ctrl_c_within_the_program_only():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), heed_requests_to_end():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.5)
    assert signal.getsignal(signal.SIGTERM) is before
