"""Every benchmark is a command; what it reads of Dockerfiles, processes and constants."""

import importlib
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

import benchmarks
from benchmarks.anywhere.dockerfile import read_stages
from benchmarks.common.command_line import ensure_single_thread
from benchmarks.common.processes import environment, module_command
from benchmarks.hundred.command import cpu_s, held_mb
from benchmarks.sensitivity.constants import ROOMS, Constant, constants, install, is_compiled, scale

PACKAGE = Path(benchmarks.__file__).parent
SHARED = (
    "benchmarks", "benchmarks.common", "benchmarks.surface.depth_camera", "benchmarks.surface.rendered",
    "benchmarks.synthetic", "benchmarks.thesis",
)  # fmt: skip
"""Packages that are no command."""


def packages():
    """Every package by its dotted name, and its folder."""
    folders = sorted(path.parent for path in PACKAGE.rglob("__init__.py") if "node_modules" not in path.parts)
    return {".".join(folder.relative_to(PACKAGE.parent).parts): folder for folder in folders}


COMMANDS = [name for name in packages() if name not in SHARED]


def test_every_folder_is_a_command_or_shared():
    found = {name for name, folder in packages().items() if (folder / "__main__.py").exists()}
    assert found == set(COMMANDS)
    folders = {path.parent for path in PACKAGE.rglob("*.py") if "node_modules" not in path.parts}
    assert folders == set(packages().values())


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_shows_the_command(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["__main__.py", "--help"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(name, run_name="__main__")
    shown = capsys.readouterr().out
    assert ended.value.code == 0
    assert shown.startswith(f"usage: python -m {name} ")
    assert re.search(rf"^ *python -m {name} ", shown, re.MULTILINE), "its docstring shows how it is called"


@pytest.mark.parametrize("worker", ["benchmarks.cameras.worker", "benchmarks.surface.worker"])
def test_a_worker_is_found_from_anywhere_and_brings_nothing_but_itself(worker, tmp_path):
    code = f"import sys, {worker}; print({{'numpy', 'sfm_app', 'pycolmap'}} & set(sys.modules))"
    command = [*module_command(worker)[:-2], "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "set()", done.stderr


def test_a_command_starts_anew_as_it_was_called(monkeypatch):
    calls = []
    monkeypatch.setattr("os.execve", lambda *given: calls.append(given))
    monkeypatch.setattr(sys, "orig_argv", ["python", "-X", "dev", "-m", "benchmarks.fundamental", "--seed", "1"])
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    ensure_single_thread()
    ((path, command, given),) = calls
    assert path == sys.executable == command[0]
    assert command[1:] == ["-X", "dev", "-m", "benchmarks.fundamental", "--seed", "1"]
    assert given["OMP_NUM_THREADS"] == given["NUMBA_NUM_THREADS"] == "1"


FILE = """
# a comment
FROM debian:trixie-slim AS build
RUN apt-get update \\
    && echo "$(date)" \\
    # a comment inside
    && true
ENV A=1 PATH=/opt/bin:$PATH
FROM debian:trixie-slim
COPY --from=build /opt /opt
ENTRYPOINT ["one", "two words"]
"""


def test_steps_are_read(tmp_path):
    path = tmp_path / "Dockerfile"
    path.write_text(FILE)
    build, last = read_stages(path)
    assert (build.base, build.name) == ("debian:trixie-slim", "build")
    assert [step.keyword for step in build.steps] == ["RUN", "ENV"]
    assert build.steps[0].text == 'apt-get update && echo "$(date)" && true'
    assert build.steps[1].assignments() == {"A": "1", "PATH": "/opt/bin:$PATH"}
    assert last.steps[0].option("from") == "build" and last.steps[0].words() == ["/opt", "/opt"]
    assert last.steps[1].words() == ["one", "two words"]


@pytest.mark.parametrize("line", ["ADD a b", "COPY $(ls) b"])
def test_a_step_that_is_not_understood_is_an_error(line, tmp_path):
    path = tmp_path / "Dockerfile"
    path.write_text(f"FROM debian:trixie-slim\n{line}\n")
    with pytest.raises(ValueError, match="not understood"):
        read_stages(path)


HOLDS = "import sys; held = bytearray({mb}_000_000); print(flush=True); sys.stdin.read()"
PARENT = "import subprocess, sys; held = bytearray(50_000_000); subprocess.run([sys.executable, '-c', sys.argv[1]])"
LINUX_ONLY = pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="only Linux tells the memory so")


def held_by(*arguments):
    """What a process holds once it, or its child, has said so."""
    command = [sys.executable, "-c", *arguments]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        held = held_mb(process.pid)
        process.stdin.close()
        process.wait()
    return held


@LINUX_ONLY
def test_memory_is_that_of_a_process_and_of_its_children():
    alone = held_by(HOLDS.format(mb=200))
    together = held_by(PARENT, HOLDS.format(mb=200))
    assert 190 < alone < 260
    assert 45 < together - alone < 90


@LINUX_ONLY
def test_cpu_seconds_are_those_of_children_at_work_too():
    work = "import time\nwhile time.process_time() < 0.5: pass\nprint(flush=True)\ninput()"
    before = cpu_s(os.getpid())
    with subprocess.Popen([sys.executable, "-c", work], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        during = cpu_s(os.getpid())
        process.communicate(b"end")
    assert 0.45 < during - before < 2.0
    assert 0.45 < cpu_s(os.getpid()) - before < 2.0


class Limits(NamedTuple):
    """A constant of several numbers."""

    least: float
    most: int


@pytest.mark.parametrize(
    ("value", "halved", "doubled"),
    [
        (3.0, 1.5, 6.0), (0.2, 0.1, 0.4), (0.9, 0.95, 0.8), (1, 1, 2), (5, 2, 10),
        ((0.2, "name"), (0.1, "name"), (0.4, "name")), ({"a": 2}, {"a": 1}, {"a": 4}),
        (Limits(0.25, 8), Limits(0.125, 4), Limits(0.5, 16)), (True, True, True), (None, None, None),
    ],
)  # fmt: skip
def test_numbers_are_scaled_and_stay_what_they_are(value, halved, doubled):
    assert scale(value, 0.5) == pytest.approx(halved)
    assert scale(value, 2.0) == pytest.approx(doubled)
    assert type(scale(value, 0.5)) is type(value)


def test_every_room_has_constants_and_kernels_are_known():
    found = constants()
    assert {one.path.split("/")[1] for one in found} == set(ROOMS)
    compiled = sum(map(is_compiled, found))
    assert 0 < compiled < len(found) / 2


MODULE = '''
from dataclasses import dataclass

SPREAD, STEPS = 0.25, 4
"""Chosen by hand."""
WIDTH = 3.0
"""Thesis 4.4."""


@dataclass(frozen=True, slots=True)
class LoopOptions:
    """Of the loop."""

    gain: float = 2.0
    """By hand."""
    most: int = 8
    """Thesis 4.5."""


OPTIONS = LoopOptions()
'''


@pytest.fixture
def room(tmp_path, monkeypatch):
    """The folder of a module with constants; what is imported from it is forgotten."""
    (tmp_path / "sfm_app" / "room").mkdir(parents=True)
    (tmp_path / "sfm_app" / "room" / "scaled_module.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.setattr(sys, "meta_path", sys.meta_path[:])
    yield tmp_path
    sys.modules.pop("scaled_module", None)


def test_constants_chosen_by_hand_are_found_in_options_too(room):
    path = "sfm_app/room/scaled_module.py"
    assert constants(["room"], room) == [Constant(path, "SPREAD, STEPS"), Constant(path, "LoopOptions.gain")]


@pytest.mark.parametrize(
    ("names", "values"), [("SPREAD, STEPS", (0.5, 8, 3.0, 2.0, 8)), ("LoopOptions.gain", (0.25, 4, 3.0, 4.0, 8))]
)
def test_whoever_imports_a_constant_sees_it_scaled(room, names, values):
    install(Constant("scaled_module.py", names), 2.0, room / "sfm_app" / "room")
    module = importlib.import_module("scaled_module")
    assert (module.SPREAD, module.STEPS, module.WIDTH, module.OPTIONS.gain, module.OPTIONS.most) == values


def test_a_module_that_is_imported_already_is_refused():
    with pytest.raises(RuntimeError, match="imported already"):
        install(Constant("sfm_app/settings.py", "ANY"), 2.0)
