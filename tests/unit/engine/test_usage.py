import subprocess
import sys
import threading
import time

import pytest

from sfm_app.engine import execution
from sfm_app.engine.execution import _resident_mb, measure_usage
from sfm_app.operating_system import Ability, ChildTimes

TRUE = ("cmd", "/c", "exit") if sys.platform == "win32" else ("true",)
HOLD = "held = b'x' * 200_000_000; import time; time.sleep(1.2)"


def test_memory_of_other_processes_counts():
    with measure_usage() as alone:
        pass
    with measure_usage() as used:
        subprocess.run([sys.executable, "-c", HOLD], check=True)

    assert alone.peak_mb > 10
    assert 200 <= used.peak_mb - alone.peak_mb < 350


def test_memory_of_this_process_counts_once_while_it_starts_others():
    held = b"x" * 500_000_000  # a child that has not yet begun its program shares it
    before, seen = _resident_mb(ChildTimes()), []
    others = threading.Thread(target=lambda: [subprocess.run([*TRUE], check=True) for _ in range(200)])
    others.start()
    while others.is_alive():
        seen.append(_resident_mb(ChildTimes()))

    assert len(held) / 1e6 <= min(seen)
    assert max(seen) < before + 200


def test_cpu_seconds_are_those_of_work_and_not_of_waiting():
    with measure_usage() as idle:
        time.sleep(0.5)
    with measure_usage() as busy:
        end = time.process_time() + 0.5
        while time.process_time() < end:
            pass

    assert idle.seconds >= 0.5
    assert idle.cpu_seconds < 0.3
    assert 0.45 <= busy.cpu_seconds < 1.0


@pytest.mark.parametrize("taken", [(), (Ability.CHILD_TIMES,)], ids=["system", "looks"])
def test_cpu_seconds_of_children_count_once(without, monkeypatch, taken):
    without(*taken)
    monkeypatch.setattr(execution, "EVERY_S", 0.1)
    with measure_usage() as used:
        subprocess.run([sys.executable, "-c", "import time\nwhile time.process_time() < 1.0: pass"], check=True)

    assert 0.75 < used.cpu_seconds < 1.8  # the looks themselves take some, too


def test_a_failure_is_measured_too():
    with pytest.raises(ValueError, match="no"), measure_usage() as used:
        raise ValueError("no")

    assert used.seconds > 0
