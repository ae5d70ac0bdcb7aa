"""Abilities of systems, links and open files, libraries of wheels, cores, memory, time, and how processes end."""

import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import PIL
import psutil
import pytest

from sfm_app import operating_system as system
from sfm_app.operating_system import VARIABLE, Ability, lacks


@pytest.mark.parametrize(
    ("platform", "has", "misses"),
    [
        ("linux", Ability.CONTAINERS, None), ("darwin", Ability.GROUPS, Ability.CORES),
        ("win32", Ability.LINKS, Ability.CLOSED_INPUT), ("freebsd14", Ability.CLOSED_INPUT, Ability.CONTAINERS),
    ],
)  # fmt: skip
def test_every_system_has_its_own(platform, has, misses):
    found = system.find_abilities(platform, {})
    assert has in found and misses not in found


def test_the_environment_takes_abilities_away(without):
    found = system.find_abilities("linux", {VARIABLE: "links, process groups,"})
    assert set(Ability) - found == {Ability.LINKS, Ability.GROUPS}
    assert system.find_abilities("linux", {VARIABLE: ",".join(Ability)}) == frozenset()
    with pytest.raises(ValueError, match="lnks"):
        system.find_abilities("linux", {VARIABLE: "lnks"})
    before = system.missing_abilities()
    without(Ability.LINKS)
    assert lacks(Ability.LINKS) and set(system.missing_abilities()) == {*before, "links"}


@pytest.fixture
def photo(tmp_path):
    path = tmp_path / "photo.jpg"
    path.write_bytes(b"light")
    return path


@pytest.mark.skipif(os.name == "nt" or lacks(Ability.LINKS), reason="Windows asks for a right")
def test_a_link_leads_to_the_file(photo, tmp_path):
    system.link_or_copy(tmp_path / "place", "photo.jpg", photo)
    assert system.is_link(tmp_path / "place") and (tmp_path / "place").resolve() == photo.resolve()


@pytest.mark.parametrize("refused", [True, False])
def test_without_links_the_bytes_are_copied_and_the_photo_is_safe(photo, tmp_path, without, monkeypatch, refused):
    if refused:  # the system knows links, but not here
        monkeypatch.setattr("pathlib.Path.symlink_to", refuse)
    else:
        without(Ability.LINKS)
    system.link_or_copy(tmp_path / "place", photo, photo)
    assert not system.is_link(tmp_path / "place") and (tmp_path / "place").read_bytes() == b"light"
    (tmp_path / "place").write_bytes(b"dark")
    assert photo.read_bytes() == b"light"


@pytest.mark.parametrize("taken", [(), (Ability.LINKS,)])
def test_an_existing_link_is_not_written_through(photo, tmp_path, without, taken):
    without(*taken)
    (tmp_path / "other.jpg").write_bytes(b"another")
    (tmp_path / "place").symlink_to("other.jpg")
    with pytest.raises(FileExistsError):
        system.link_or_copy(tmp_path / "place", photo, photo)
    assert (tmp_path / "other.jpg").read_bytes() == b"another"


@pytest.mark.parametrize("taken", [(), (Ability.HARD_LINKS,), None])
def test_bytes_are_shared_where_they_can_be(photo, tmp_path, without, monkeypatch, taken):
    if taken is None:  # the system knows links, but not here
        monkeypatch.setattr(os, "link", refuse)
    else:
        without(*taken)
    names = 2 if taken == () and not lacks(Ability.HARD_LINKS) else 1
    system.share_bytes(photo, tmp_path / "other")
    assert (tmp_path / "other").read_bytes() == b"light" and photo.stat().st_nlink == names


def test_a_junction_is_a_link(photo, monkeypatch):
    monkeypatch.setattr(stat, "IO_REPARSE_TAG_MOUNT_POINT", 0xA0000003, raising=False)
    found = SimpleNamespace(st_mode=stat.S_IFDIR, st_reparse_tag=0xA0000003)
    assert system.is_link(SimpleNamespace(lstat=lambda: found))
    assert not system.is_link(photo) and not system.is_link(photo.parent / "nothing")


@pytest.mark.parametrize("act", [system.replace_file, system.move])
def test_moves_wait_for_a_file_that_is_open(photo, tmp_path, without, monkeypatch, act):
    without(Ability.OPEN_FILES)
    slept = block_moves(monkeypatch, times=3)
    act(photo, tmp_path / "new")
    assert (tmp_path / "new").read_bytes() == b"light" and not photo.exists()
    assert slept == list(system.WAITS_S[:3])


def test_a_file_that_is_never_free_is_an_error(photo, tmp_path, without, monkeypatch):
    without(Ability.OPEN_FILES)
    slept = block_moves(monkeypatch, times=100)
    with pytest.raises(PermissionError):
        system.replace_file(photo, tmp_path / "new")
    assert slept == list(system.WAITS_S) and photo.exists()


def test_elsewhere_a_refusal_is_final(photo, tmp_path, monkeypatch):
    monkeypatch.setattr("sfm_app.operating_system.HERE", frozenset(Ability))
    slept = block_moves(monkeypatch, times=1)
    with pytest.raises(PermissionError):
        system.replace_file(photo, tmp_path / "new")
    assert slept == []


def refuse(*_arguments, **_options):
    raise OSError("no links here")


def block_moves(monkeypatch, times):
    """Refuse so many attempts to move a file, and return the list of the seconds that were waited."""
    slept, refused = [], []
    monkeypatch.setattr(system.time, "sleep", slept.append)
    for name, real in (("replace", os.replace), ("rename", os.rename)):

        def attempt(path, target, real=real):
            if len(refused) < times:
                refused.append(path)
                raise PermissionError("another program looks at it")
            real(path, target)

        monkeypatch.setattr(f"pathlib.Path.{name}", attempt)
    return slept


PILLOW = Path(PIL.__file__).parent


@pytest.mark.skipif(
    not any(system.find_in_wheel(PILLOW, "pillow", "libtiff")), reason="this Pillow has no libraries of its own"
)
def test_libraries_in_wheels_are_found_unless_there_are_none(without):
    assert [hasattr(library, "TIFFOpen") for library in system.find_in_wheel(PILLOW, "pillow", "libtiff")] == [True]
    assert list(system.find_in_wheel(PILLOW, "pillow", "libnothing")) == []
    without(Ability.WHEEL_LIBRARIES)
    assert list(system.find_in_wheel(PILLOW, "pillow", "libtiff")) == []


BUSY = "import time\nwhile time.process_time() < 0.5: pass\nprint(flush=True); input()"


def test_cores_are_those_that_may_be_used(without, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: {3, 5, 7}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.setattr("sfm_app.operating_system.HERE", frozenset(Ability))
    assert system.usable_cores() == 3
    without(Ability.CORES)
    assert system.usable_cores() == 8
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert system.usable_cores() == 1


@pytest.mark.parametrize(("limit", "megabytes"), [("512000000\n", 512.0), ("max\n", None), (None, None)])
def test_a_container_has_less_memory(tmp_path, without, monkeypatch, limit, megabytes):
    file, whole = tmp_path / "memory.max", psutil.virtual_memory().total / 1e6
    monkeypatch.setattr(system, "CONTAINER_LIMIT", file)
    monkeypatch.setattr("sfm_app.operating_system.HERE", frozenset(Ability))
    if limit:
        file.write_text(limit)
    assert system.machine_memory_mb() == (megabytes or whole) and 0 < system.free_memory_mb() <= (megabytes or whole)
    without(Ability.CONTAINERS)
    assert system.machine_memory_mb() == whole


@pytest.mark.slow
def test_times_of_children_are_looked_at_where_nobody_adds_them_up(without):
    without(Ability.CHILD_TIMES)
    times, before = system.ChildTimes(), system.cpu_seconds()
    with subprocess.Popen([sys.executable, "-c", BUSY], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as busy:
        busy.stdout.readline()
        times.look([psutil.Process(busy.pid)])
        times.look([psutil.Process(busy.pid)])  # twice is not more
    assert 0.45 <= times.seconds() < 0.9
    assert system.cpu_seconds() - before < 0.4


def test_times_of_children_are_not_counted_twice(monkeypatch):
    monkeypatch.setattr("sfm_app.operating_system.HERE", frozenset(Ability))
    times = system.ChildTimes()
    times.look([psutil.Process()])
    assert times.seconds() == 0.0
    assert system.cpu_seconds() == pytest.approx(sum(os.times()[:4]), abs=0.1)


def test_a_child_that_is_gone_is_no_error(without):
    without(Ability.CHILD_TIMES)
    times = system.ChildTimes()
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        gone = psutil.Process(process.pid)
    times.look([gone])
    assert times.seconds() == 0.0


def test_other_processes_come_first(monkeypatch):
    values = []
    monkeypatch.setattr(os, "nice", values.append, raising=False)
    system.yield_to_others(10)
    assert values == [10]
    monkeypatch.delattr(os, "nice")
    monkeypatch.setattr(psutil, "BELOW_NORMAL_PRIORITY_CLASS", 16384, raising=False)
    monkeypatch.setattr(psutil.Process, "nice", lambda _process, value: values.append(value))
    system.yield_to_others(10)
    assert values == [10, 16384]


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


@pytest.mark.slow
@pytest.mark.parametrize("taken", WAYS, ids=lambda taken: "+".join(taken) or "all")
def test_a_group_ends_when_the_one_that_started_it_is_killed(without, taken):
    without(*taken)
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        members = [psutil.Process(int(number)) for number in parent.stdout.readline().split()]
        assert len(members) == 2 and all(runs(member) for member in members)
        parent.kill()
    assert all(ends(member) for member in members)


@pytest.mark.slow
@pytest.mark.parametrize("taken", WAYS[:2], ids=lambda taken: "+".join(taken) or "all")
def test_a_group_is_ended_as_a_whole(without, taken):
    without(*taken)
    command = [sys.executable, "-c", WORKER, str(os.getpid())]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, **system.group_options()
    ) as worker:
        child = psutil.Process(int(worker.stdout.readline()))
        system.end_group(worker, 10.0)
    assert worker.returncode != 0 and ends(child)
    system.end_group(worker, 0.0)  # what has ended stays so


@pytest.mark.slow
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
    monkeypatch.setattr(system.os, "_exit", lambda code: killed.append(f"exit {code}"))
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        system.end_own_group()
    assert child.pid in killed[:-2] and killed[-2:] == [os.getpid(), "exit 1"]  # earlier tests may have left children


def test_ctrl_c_does_not_reach_a_group(without, monkeypatch):
    assert lacks(Ability.GROUPS) or system.group_options() == {"start_new_session": True}
    without(Ability.GROUPS)
    monkeypatch.setattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0x200, raising=False)
    assert system.group_options() == {"creationflags": 0x200}


@pytest.mark.parametrize(
    ("code", "name", "run_out"),
    [
        (0, "", False), (1, "", False), (-6, "SIGABRT", False), (-9, "SIGKILL", True), (-64, "SIGRTMAX", False),
        (-99, "signal 99", False), (0xC0000005, "access violation", False), (0xC0000017, "no memory", True),
        (0xC0001234, "fault 0xc0001234", False),
    ],
)  # fmt: skip
def test_exit_codes_say_what_happened(code, name, run_out):
    assert (system.crash_name(code), system.has_run_out(code)) == (name, run_out)


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


@pytest.mark.slow
@pytest.mark.skipif(lacks(Ability.EXIT_HANDLERS), reason="the C library has no on_exit")
@pytest.mark.parametrize(("first", "said"), [("", "cleaning up"), ("end_at_exit()", "")])
def test_a_process_that_a_library_ends_cleans_nothing_up_while_its_threads_work(first, said):
    command = [sys.executable, "-c", LIBRARY_EXITS.format(first)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (7, said)


def test_without_exit_handlers_the_c_library_is_left_alone(without, monkeypatch):
    asked = []
    monkeypatch.setattr(system.ctypes, "CDLL", asked.append)
    without(Ability.EXIT_HANDLERS)
    system.end_at_exit()
    assert asked == []


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals are another thing there")
def test_a_request_to_end_prints_no_stack():
    """COLMAP has a handler of its own, which does."""
    text = "import os, signal; import sfm_app.colmap.backend; os.kill(os.getpid(), signal.SIGTERM)"
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGTERM, b"")


@pytest.mark.skipif(sys.platform == "win32", reason="signals are another thing there")
def test_a_request_to_end_is_as_ctrl_c_within_the_program_only():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), system.heed_requests_to_end():
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.5)
    assert signal.getsignal(signal.SIGTERM) is before
