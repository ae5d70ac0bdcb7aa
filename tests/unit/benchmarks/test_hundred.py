"""The benchmark of hundreds of photos: its figures and its page."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.hundred.command import cpu_s, held_mb, page
from sfm_app.pipeline import NAMES

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
def test_a_process_that_has_ended_holds_nothing():
    with subprocess.Popen([sys.executable, "-c", ""]) as process:
        process.wait()

        assert held_mb(process.pid) == 0


@LINUX_ONLY
def test_cpu_seconds_are_those_of_the_process():
    before, spent = time.process_time(), cpu_s(os.getpid())
    while time.process_time() < before + 0.3:
        pass

    assert 0.25 < cpu_s(os.getpid()) - spent < 0.6


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


def test_the_page_has_stages_in_rows_and_numbers_of_photos_in_columns():
    rows = [
        {"method": "sfm-app", "photos": count, "placed": count - 1}
        | {f"s of {name}": float(count) for name in NAMES}
        | {f"CPU {name}": 2.0 * count for name in NAMES}
        | {f"MB {name}": 10 * count + number for number, name in enumerate(NAMES)}
        for count in (50, 100)
    ]

    lines = page(rows).splitlines()

    assert "49 of 50, 99 of 100" in lines[2]
    columns = " | ".join(f"{figure}, {count} photos" for figure in ("CPU", "s", "MB") for count in (50, 100))
    assert f"| stage | {columns} |" in lines
    assert "| mesh | 100 | 200 | 50 | 100 | 507 | 1007 |" in lines
    n = len(NAMES)
    assert f"| together | {n * 100} | {n * 200} | {n * 50} | {n * 100} | 509 | 1009 |" in lines
