"""Cores, memory and times, with and without the help of the system."""

import os
import subprocess
import sys
import time

import psutil
import pytest

from sfm_app import operating_system
from sfm_app.operating_system import (
    Ability,
    ChildTimes,
    cpu_seconds,
    free_memory_mb,
    machine_memory_mb,
    usable_cores,
    yield_to_others,
)

BUSY = "import time\nwhile time.process_time() < 0.5: pass\nprint(flush=True); input()"


def test_cores_are_those_that_may_be_used(without, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: {3, 5, 7}, raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 8)
    monkeypatch.setattr("sfm_app.operating_system.HERE", frozenset(Ability))
    assert usable_cores() == 3

    without(Ability.CORES)
    assert usable_cores() == 8
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert usable_cores() == 1


@pytest.mark.parametrize(("limit", "megabytes"), [("512000000\n", 512.0), ("max\n", None), (None, None)])
def test_a_container_has_less_memory(tmp_path, without, monkeypatch, limit, megabytes):
    file, whole = tmp_path / "memory.max", psutil.virtual_memory().total / 1e6
    monkeypatch.setattr(operating_system, "CONTAINER_LIMIT", file)
    monkeypatch.setattr("sfm_app.operating_system.HERE", frozenset(Ability))
    if limit:
        file.write_text(limit)

    assert machine_memory_mb() == (megabytes or whole) and 0 < free_memory_mb() <= (megabytes or whole)
    without(Ability.CONTAINERS)
    assert machine_memory_mb() == whole


def test_times_of_children_are_looked_at_where_nobody_adds_them_up(without):
    without(Ability.CHILD_TIMES)
    times, before = ChildTimes(), cpu_seconds()
    with subprocess.Popen([sys.executable, "-c", BUSY], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as busy:
        busy.stdout.readline()
        times.look([psutil.Process(busy.pid)])
        times.look([psutil.Process(busy.pid)])  # twice is not more
    assert 0.45 <= times.seconds() < 0.9
    assert cpu_seconds() - before < 0.4


def test_times_of_children_are_not_counted_twice(monkeypatch):
    monkeypatch.setattr("sfm_app.operating_system.HERE", frozenset(Ability))
    times = ChildTimes()
    times.look([psutil.Process()])

    assert times.seconds() == 0.0
    assert cpu_seconds() == pytest.approx(sum(os.times()[:4]), abs=0.1)


def test_a_child_that_is_gone_is_no_error(without):
    without(Ability.CHILD_TIMES)
    times = ChildTimes()
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        gone = psutil.Process(process.pid)
    times.look([gone])

    assert times.seconds() == 0.0


def test_other_processes_come_first(monkeypatch):
    asked = []
    monkeypatch.setattr(os, "nice", asked.append, raising=False)
    yield_to_others(10)
    assert asked == [10]

    monkeypatch.delattr(os, "nice")
    monkeypatch.setattr(psutil, "BELOW_NORMAL_PRIORITY_CLASS", 16384, raising=False)
    monkeypatch.setattr(psutil.Process, "nice", lambda _process, value: asked.append(value))
    yield_to_others(10)
    assert asked == [10, 16384]


def test_time_passes():
    start = cpu_seconds()
    until = time.process_time() + 0.05
    while time.process_time() < until:
        pass

    assert 0.03 <= cpu_seconds() - start < 1.0
