"""The loop that runs stages, their measured cost, and the log."""

import logging
import shutil
import subprocess
import sys
import threading
import time
import warnings
from types import SimpleNamespace

import pytest

from sfm_app.engine.execution import Pipeline, log_to_file, measure_usage, resident_mb
from sfm_app.engine.stage import Stage
from sfm_app.errors import InputError, ReconstructionError
from sfm_app.operating_system import Ability, ChildTimes
from sfm_app.types import PhotoSet

A_WHILE_S = 0.2


@pytest.fixture
def source(tmp_path):
    return SimpleNamespace(
        fingerprint="abc", content_hash=lambda _: "abc", photo_hashes=lambda _: {}, check=lambda _: None,
        photos=PhotoSet(tmp_path / "photos", ()),
    )  # fmt: skip


@pytest.fixture
def two_workers(run):
    with run.with_workers(2) as both:
        yield both


class Task:
    """Does the first of two items while the second is at work, which takes a while and writes a map."""

    def __init__(self, run, first):
        self.run, self.first, self.begun = run, first, threading.Event()

    def __call__(self, item):
        if item == 0:
            self.begun.wait()
            self.first()
        self.begun.set()
        time.sleep(A_WHILE_S)
        map_of_depths = self.run.workspace.dense / "map.bin"
        map_of_depths.parent.mkdir(parents=True, exist_ok=True)
        map_of_depths.write_text("depths")


def pipeline(first):
    """Photos, and depth maps of which one has trouble."""

    def make(products, run):
        products[photos]
        run.map(Task(run, first), range(2), "depth maps")
        return "depth maps"

    photos = Stage("photos", (), (), (), lambda products, _: products.source.photos, None, lambda _: "")
    return Pipeline(photos, (Stage("depth_maps", (photos,), (), (), make, None, lambda _: ""),))


def fail():
    raise ReconstructionError("no photo has a neighbor", "take more of them")


def test_the_photos_are_checked_after_all_tasks_of_a_failed_stage_have_ended(two_workers, source):
    written = []
    source.check = lambda _: written.append((two_workers.workspace.dense / "map.bin").exists())
    with pytest.raises(ReconstructionError, match="no photo has a neighbor"):
        pipeline(fail).run(source, two_workers)
    assert written == [False, True]  # after the photos, and after the failed depth maps


def test_files_written_after_the_output_folder_was_removed_do_not_stop_the_next_run(two_workers, source):
    def remove():
        shutil.rmtree(two_workers.workspace.root)
        raise FileNotFoundError(two_workers.workspace.dense)

    with pytest.raises(InputError, match="was removed during the run"):
        pipeline(remove).run(source, two_workers)
    pipeline(lambda: None).run(source, two_workers)

    assert set(two_workers.workspace.manifest.read()["stages"]) == {"photos", "depth_maps"}


def test_a_failed_stage_leaves_the_workers_of_the_run(two_workers, source):
    with pytest.raises(ReconstructionError):
        pipeline(fail).run(source, two_workers)
    assert two_workers.map(str, range(3), "numbers") == ["0", "1", "2"]


TRUE = ("cmd", "/c", "exit") if sys.platform == "win32" else ("true",)
HOLD = "held = b'x' * 200_000_000; import time; time.sleep(1.2)"


@pytest.mark.slow
def test_memory_of_other_processes_counts():
    with measure_usage() as alone:
        pass
    with measure_usage() as used:
        subprocess.run([sys.executable, "-c", HOLD], check=True)
    assert alone.peak_mb > 10
    assert 200 <= used.peak_mb - alone.peak_mb < 350


@pytest.mark.slow
def test_memory_of_this_process_counts_once_while_it_starts_others():
    held = b"x" * 500_000_000  # a child that has not yet begun its program shares it
    before, sizes = resident_mb(ChildTimes()), []
    others = threading.Thread(target=lambda: [subprocess.run([*TRUE], check=True) for _ in range(200)])
    others.start()
    while others.is_alive():
        sizes.append(resident_mb(ChildTimes()))

    assert len(held) / 1e6 <= min(sizes)
    assert max(sizes) < before + 200


@pytest.mark.slow
def test_cpu_seconds_do_not_count_waiting():
    with measure_usage() as idle:
        time.sleep(0.5)
    with measure_usage() as busy:
        end = time.process_time() + 0.5
        while time.process_time() < end:
            pass

    assert idle.seconds >= 0.5
    assert idle.cpu_seconds < 0.3
    assert 0.45 <= busy.cpu_seconds < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("taken", [(), (Ability.CHILD_TIMES,)], ids=["system", "looks"])
def test_cpu_seconds_of_children_count_once(without, taken):
    without(*taken)
    with measure_usage(every_s=0.1) as used:
        subprocess.run([sys.executable, "-c", "import time\nwhile time.process_time() < 1.0: pass"], check=True)
    assert 0.75 < used.cpu_seconds < 1.8  # the looks themselves take some, too


def test_a_failure_is_measured_too():
    with pytest.raises(ValueError, match="no"), measure_usage() as used:
        raise ValueError("no")
    assert used.seconds > 0


def test_the_log_has_the_warnings_of_python(run):
    run.workspace.create()
    logging.captureWarnings(capture=False)  # commands of earlier tests have turned it on
    logging.captureWarnings(capture=True)
    try:
        with log_to_file(run), warnings.catch_warnings(action="always"):
            warnings.warn("invalid value in sqrt", RuntimeWarning, stacklevel=1)
    finally:
        logging.captureWarnings(capture=False)

    assert "RuntimeWarning: invalid value in sqrt" in run.workspace.log.read_text(encoding="utf-8")


def test_the_log_has_the_traceback_of_an_error(run):
    run.workspace.create()
    with pytest.raises(IndexError), log_to_file(run):
        raise IndexError("a bug of ours")
    text = run.workspace.log.read_text(encoding="utf-8")
    assert "the run ended here" in text and "Traceback" in text and "IndexError: a bug of ours" in text
