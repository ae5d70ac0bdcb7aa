"""The depth stage: which method, what is kept of a killed run, what the manifest says."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from sfm_app.colmap import dense
from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.dense import MASKED, DenseStore, read_depth, read_views
from sfm_app.errors import ConfigError, ReconstructionError
from sfm_app.files import UNFINISHED
from sfm_app.meshing.visibility import SKY
from sfm_app.photos.masks import save_mask
from sfm_app.plugins import DepthMethod, hookimpl, load_plugins
from sfm_app.progress import Progress
from sfm_app.settings import DepthSettings, Settings
from sfm_app.stages import depth_maps
from sfm_app.stereo import DepthMap
from sfm_app.types import Rejected

pytestmark = pytest.mark.slow


@pytest.fixture
def scene(tmp_path):
    """Three photos in a row and their model; `photo_dir` and `dense_dir` beside it."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=80, height=60, params=[70, 70, 40, 30])
    model.add_camera_with_trivial_rig(camera)
    (tmp_path / "photos").mkdir()
    (tmp_path / "sparse").mkdir()
    for index in (1, 2, 3):
        cv2.imwrite(str(tmp_path / "photos" / f"{index}.png"), np.full((60, 80, 3), 100, np.uint8))
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), np.array([-0.3 * index, 0, 0]))
        model.add_image_with_trivial_frame(pycolmap.Image(image_id=index, name=f"{index}.png", camera_id=1), pose)
    model.write(tmp_path / "sparse")
    names = ("1.png", "2.png", "3.png")
    return SimpleNamespace(
        model_dir=tmp_path / "sparse", registered=names, photo_dir=tmp_path / "photos", dense_dir=tmp_path / "dense"
    )


class Method:
    """A way to make depth maps that can be killed, and notes how often and for which photos it was asked."""

    def __init__(self, kill_at="", reject=()):
        self.asked, self.kill_at, self.reject, self.calls = [], kill_at, reject, 0

    def make(self, task):
        found = []
        self.calls += 1
        for view in task.views:
            if view.name == self.kill_at:
                raise KeyboardInterrupt
            if not task.store.has(view, "geometric") and view.name not in self.reject:
                self.asked.append(view.name)
                depth = np.zeros((view.height, view.width), np.float32)
                depth[: view.height // 2] = 3.0
                task.store.write_maps(view, DepthMap(depth, np.zeros((*depth.shape, 3), np.float32)))
            found.append(Rejected("too dark") if view.name in self.reject else None)
        return found

    @property
    def plugins(self):
        @hookimpl
        def sfm_depth_methods():
            return [DepthMethod("ours", self.make), DepthMethod("gone", self.make, unavailable=lambda: "no such chip")]

        return load_plugins([SimpleNamespace(sfm_depth_methods=sfm_depth_methods)], installed=False)


def run_stage(scene, ways, fingerprint="", mask_dir=None, **settings):
    counts = {}
    options = DepthSettings(**{"method": "ours", **settings})
    place = SimpleNamespace(photos=scene.photo_dir, dense=scene.dense_dir)
    run = SimpleNamespace(
        plugins=ways.plugins, record=lambda **more: counts.update(more), map=one_by_one, fingerprint=fingerprint,
        settings=Settings(depth=options), workspace=place, workers=2, progress=Progress(), mask_dir=mask_dir,
    )  # fmt: skip
    assert depth_maps.make(scene, run) == scene.dense_dir
    return counts


def one_by_one(function, items, label):
    return [function(item) for item in items]


def kill_at(scene, name, **options):
    with pytest.raises(KeyboardInterrupt):
        run_stage(scene, Method(kill_at=name), **options)


def test_the_manifest_says_what_was_done(scene):
    counts = run_stage(scene, Method(reject=("2.png",)), method="auto")
    assert counts == {
        "method": "ours", "method_reason": "installed and able to run here", "depth_maps": 2,
        "rejected": {"too dark": 1}, "coverage": {"1.png": 0.5, "3.png": 0.5}, "sky": 0.0,
    }  # fmt: skip


@pytest.fixture
def upside_down(scene):
    """Photos of a textured wall above a bright sky; the depths of `Method` reach four rows into it."""
    for path in scene.photo_dir.iterdir():
        photo = np.random.default_rng(3).integers(0, 160, (60, 80, 3), np.uint8)
        photo[26:] = 230
        cv2.imwrite(str(path), photo)
    return scene


def first_depth(scene):
    return read_depth(scene.dense_dir, read_views(scene.dense_dir)[0], "geometric")


def test_depths_in_the_sky_are_removed_unless_they_shall_stay(upside_down):
    assert "sky" not in run_stage(upside_down, Method(), drop_sky=False)
    assert (first_depth(upside_down)[:26] == 3).all() and not (first_depth(upside_down) == SKY).any()
    counts, depth = run_stage(upside_down, Method(), "again"), first_depth(upside_down)
    assert counts["sky"] == pytest.approx(30 / 60, abs=0.07)  # but for the rim of a column that COLMAP leaves black
    assert (depth[:26] == 3).all()
    assert not (depth[28:, :74] > 0).any()
    assert np.mean(depth == SKY) == pytest.approx(counts["sky"], abs=0.02)


@pytest.mark.parametrize(
    ("place", "name"), [(depth_maps, "sharpen_outlines"), (dense, "publish_maps"), (depth_maps, "record")]
)
def test_a_run_that_is_killed_while_it_finishes_its_maps_makes_the_same(upside_down, monkeypatch, place, name):
    def double(maps, *_):
        return DepthMap(2 * maps.depth, maps.normals)

    monkeypatch.setattr(depth_maps, "sharpen_outlines", double)
    whole = run_stage(upside_down, Method())
    finished = [read_depth(upside_down.dense_dir, view, "geometric") for view in read_views(upside_down.dense_dir)]
    calls, original = [], getattr(place, name)

    def stop(*arguments):
        calls.append(original(*arguments))
        if len(calls) == 2 or name == "record":
            raise KeyboardInterrupt
        return calls[-1]

    with monkeypatch.context() as patched:
        patched.setattr(place, name, stop)
        with pytest.raises(KeyboardInterrupt):
            run_stage(upside_down, Method(), "again")

    method = Method()
    assert run_stage(upside_down, method, "again") == whole
    assert method.calls == 0
    for view, before in zip(read_views(upside_down.dense_dir), finished, strict=True):
        np.testing.assert_array_equal(read_depth(upside_down.dense_dir, view, "geometric"), before)


def test_a_killed_run_keeps_its_maps_and_a_finished_one_is_repeated(scene):
    kill_at(scene, "3.png")
    assert (scene.dense_dir / UNFINISHED).exists()
    for asked in (["3.png"], ["1.png", "2.png", "3.png"]):
        method = Method()
        run_stage(scene, method)
        assert method.asked == asked
        assert not (scene.dense_dir / UNFINISHED).exists()


@pytest.mark.parametrize("change", ["inputs", "model"])
def test_nothing_is_kept_that_was_made_from_something_else(scene, change):
    kill_at(scene, "3.png")
    if change == "model":
        model = pycolmap.Reconstruction(scene.model_dir)
        model.cameras[1].params = [71, 71, 40, 30]
        model.write(scene.model_dir)
    method = Method()
    run_stage(scene, method, fingerprint="others" if change == "inputs" else "")
    assert method.asked == ["1.png", "2.png", "3.png"]


def test_what_is_masked_has_no_depth_whatever_method_made_it(scene, tmp_path):
    """Also in maps that a killed run left before they were masked."""
    used = np.ones((60, 80), bool)
    used[:, :40] = False
    for name in scene.registered:
        save_mask(tmp_path / "masks", name, used if name == "1.png" else used | True)
    kill_at(scene, "3.png", mask_dir=tmp_path / "masks")

    counts = run_stage(scene, Method(), mask_dir=tmp_path / "masks")

    depth = first_depth(scene)
    assert (depth[:, :40] == MASKED).all()
    assert (depth[:30, 43:] == 3).all()
    assert counts["coverage"]["1.png"] == pytest.approx(0.25, abs=0.03)
    assert counts["coverage"]["2.png"] == counts["coverage"]["3.png"] == 0.5


def test_estimates_are_removed_at_the_end(scene):
    kill_at(scene, "1.png")
    leftover = scene.dense_dir / "stereo" / "depth_maps" / "1.png.photometric.bin"
    leftover.write_bytes(b"estimate")
    run_stage(scene, Method())
    assert not leftover.exists()
    views = read_views(scene.dense_dir)
    assert all(DenseStore(scene.dense_dir).has(view, "geometric") for view in views)


def test_no_map_at_all_is_an_error_with_the_reason(scene):
    with pytest.raises(ReconstructionError, match="none of 3 photos gets a depth map: too dark"):
        run_stage(scene, Method(reject=scene.registered))


def test_a_method_that_cannot_run_is_an_error_before_anything_is_touched(scene):
    with pytest.raises(ConfigError, match="'gone' cannot be used here: no such chip"):
        run_stage(scene, Method(), method="gone")
    with pytest.raises(ConfigError, match="no depth method is named 'sgm'"):
        run_stage(scene, Method(), method="sgm")
    assert not Path(scene.dense_dir).exists()
