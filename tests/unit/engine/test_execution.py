"""The loop that runs stages, with stages that do next to nothing."""

import shutil
import threading
import time
from types import SimpleNamespace

import pytest

from sfm_app.engine.execution import Pipeline
from sfm_app.engine.stage import Stage
from sfm_app.errors import InputError, ReconstructionError
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


def test_a_stage_that_has_failed_is_looked_at_when_none_of_its_tasks_is_at_work_any_more(two_workers, source):
    seen = []
    source.check = lambda _: seen.append((two_workers.workspace.dense / "map.bin").exists())

    with pytest.raises(ReconstructionError, match="no photo has a neighbor"):
        pipeline(fail).run(source, two_workers)

    assert seen == [False, True]  # once the photos were read, and once the depth maps had failed


def test_what_is_written_after_the_output_folder_was_removed_does_not_stop_the_next_run(two_workers, source):
    def remove():
        shutil.rmtree(two_workers.workspace.root)
        raise FileNotFoundError(two_workers.workspace.dense)

    with pytest.raises(InputError, match="was removed while the run was at work"):
        pipeline(remove).run(source, two_workers)
    pipeline(lambda: None).run(source, two_workers)

    assert set(two_workers.workspace.manifest.read()["stages"]) == {"photos", "depth_maps"}


def test_a_stage_that_has_failed_leaves_the_workers_of_the_run_at_work(two_workers, source):
    with pytest.raises(ReconstructionError):
        pipeline(fail).run(source, two_workers)

    assert two_workers.map(str, range(3), "numbers") == ["0", "1", "2"]
