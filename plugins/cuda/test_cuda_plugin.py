"""The calls of the plug-in to COLMAP, and its messages without a GPU; COLMAP itself is replaced by a fake."""

import pytest

pytest.importorskip("sfm_app_cuda", reason="the plug-in is not installed: pip install -e plugins/cuda")

import numpy as np
import pycolmap
import sfm_app_cuda

from sfm_app.errors import BackendError, ConfigError
from sfm_app.plugins import load_plugins
from sfm_app.settings import DepthSettings
from sfm_app.stereo import DepthTask, View
from sfm_app.types import Rejected


class Store:
    def __init__(self):
        self.maps = set()

    def has(self, view, kind):
        return (view.name, kind) in self.maps


def map_sequentially(function, items, _):
    return [function(item) for item in items]


@pytest.fixture
def task(tmp_path):
    (tmp_path / "stereo").mkdir()
    views = [View(f"{k}.jpg", np.eye(3), np.eye(3, 4), 10, 10) for k in range(3)]
    options = DepthSettings(min_agreeing=3, max_image_size_px=700)
    return DepthTask(tmp_path, views, [[1, 2], [0], []], options, Store(), map_sequentially)


@pytest.fixture
def colmap(monkeypatch, task):
    """A fake COLMAP with CUDA that records its calls and marks the maps as made, except at the third call."""
    calls = []

    def patch_match_stereo(folder, *, options, config_path):
        name, neighbors = config_path.read_text(encoding="utf-8").splitlines()
        calls.append((name, neighbors, options.geom_consistency))
        assert (folder, options.filter) == (task.folder, options.geom_consistency)
        assert (options.filter_min_num_consistent, options.max_image_size) == (3, 700)
        if len(calls) != 3:
            task.store.maps.add((name, "geometric" if options.geom_consistency else "photometric"))

    monkeypatch.setattr(pycolmap, "has_cuda", True)
    monkeypatch.setattr(pycolmap, "get_num_cuda_devices", lambda: 1, raising=False)
    monkeypatch.setattr(pycolmap, "patch_match_stereo", patch_match_stereo)
    return calls


def test_every_photo_alone_first_then_with_its_neighbors(task, colmap):
    found = sfm_app_cuda.make(task)

    assert colmap == [
        ("0.jpg", "1.jpg, 2.jpg", False),
        ("1.jpg", "0.jpg", False),
        ("0.jpg", "1.jpg, 2.jpg", True),
        ("1.jpg", "0.jpg", True),
    ]
    assert found == [Rejected("PatchMatch gave no depth map"), None, Rejected("no photo shares enough points")]


def test_maps_that_are_there_are_not_made_again(task, colmap):
    task.store.maps |= {("0.jpg", "photometric"), ("1.jpg", "photometric"), ("1.jpg", "geometric")}

    sfm_app_cuda.make(task)

    assert colmap == [("0.jpg", "1.jpg, 2.jpg", True)]


def test_auto_takes_the_gpu_where_there_is_one(colmap, monkeypatch):
    plugins = load_plugins([sfm_app_cuda], installed=False)

    assert plugins.depth_method("auto")[0].name == "patch-match"
    assert plugins.depth_method("cpu")[0].name == "cpu"
    monkeypatch.setattr(pycolmap, "get_num_cuda_devices", lambda: 0)
    assert plugins.depth_method("auto")[0].name == "cpu"


def test_without_cuda_auto_says_why_and_the_name_alone_is_an_error(monkeypatch):
    monkeypatch.setattr(pycolmap, "has_cuda", False)
    plugins = load_plugins([sfm_app_cuda], installed=False)

    method, why = plugins.depth_method("auto")

    assert (method.name, "built without CUDA" in why) == ("cpu", True)
    with pytest.raises(
        ConfigError, match="'patch-match' cannot be used here: this pycolmap was built without CUDA"
    ) as caught:
        plugins.depth_method("patch-match")
    assert "cpu" in caught.value.hint


def test_what_colmap_raises_says_which_photo(task, colmap, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(pycolmap, "patch_match_stereo", fail)
    with pytest.raises(BackendError, match=r"PatchMatch failed on 0\.jpg: out of memory"):
        sfm_app_cuda.make(task)
