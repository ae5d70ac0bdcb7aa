"""The photos of a demo: rendered once, and never mixed with those of another scene."""

import json

import numpy as np
import pytest

from benchmarks.synthetic.scenes import poster
from benchmarks.synthetic.walks import orbit
from sfm_app.demo import SCENES, running
from sfm_app.demo.running import camera_of
from sfm_app.demo.scenes import DEMO_SCENES, DemoScene
from sfm_app.errors import InputError
from sfm_app.geometry.camera import camera_matrix
from sfm_app.progress import SilentProgress
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import make_camera
from sfm_app.types import CameraModel

ONE_WORKER = Settings.from_mapping({"workers": 1})


def small(sweep_deg=40.0, photos=3):
    return DemoScene(poster, lambda: orbit(make_camera(48, 32), photos, sweep_deg))


@pytest.fixture
def scenes(monkeypatch):
    known = {"one": small(), "turned": small(60.0), "longer": small(40.0, 4)}
    monkeypatch.setattr(running, "DEMO_SCENES", known)
    return known


def render(out, scene):
    return running._render_photos(out, scene, ONE_WORKER, SilentProgress())


def changes(out):
    return {path.name: path.stat().st_mtime_ns for path in (out / "photos").iterdir()}


def test_photos_are_rendered_once(scenes, tmp_path):
    truth = render(tmp_path, "one")
    before = changes(tmp_path)
    again = render(tmp_path, "one")

    assert sorted(before) == sorted(truth.cam_from_world) == ["view_00.jpg", "view_01.jpg", "view_02.jpg"]
    assert changes(tmp_path) == before
    assert np.array_equal(again.vertices, truth.vertices) and np.array_equal(again.K, truth.K)


def test_what_is_missing_is_rendered(scenes, tmp_path):
    render(tmp_path, "one")
    bytes_of_all = {path.name: path.read_bytes() for path in (tmp_path / "photos").iterdir()}
    before = changes(tmp_path)
    (tmp_path / "photos" / "view_01.jpg").unlink()
    render(tmp_path, "one")

    assert {name for name, when in changes(tmp_path).items() if when != before[name]} == {"view_01.jpg"}
    assert {path.name: path.read_bytes() for path in (tmp_path / "photos").iterdir()} == bytes_of_all


@pytest.mark.parametrize("other", ["turned", "longer"])
def test_photos_of_another_scene_are_left_alone(scenes, tmp_path, other):
    render(tmp_path, other)
    before = changes(tmp_path)

    with pytest.raises(InputError, match="has other photos"):
        render(tmp_path, "one")
    assert changes(tmp_path) == before


def test_photos_without_a_truth_are_left_alone(scenes, tmp_path):
    render(tmp_path, "one")
    (tmp_path / "truth.json").unlink()

    with pytest.raises(InputError, match="has other photos"):
        render(tmp_path, "one")


def test_the_truth_says_which_photos_a_killed_demo_has_begun(scenes, tmp_path, monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(running, "add_missing_photos", stop)
    with pytest.raises(KeyboardInterrupt):
        render(tmp_path, "one")

    assert len(json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))) > 0
    monkeypatch.undo()
    monkeypatch.setattr(running, "DEMO_SCENES", scenes)
    assert len(render(tmp_path, "one").cam_from_world) == 3


def test_a_fisheye_is_drawn_with_its_lens():
    K = camera_matrix(366.0, 366.0, 480.0, 320.0)
    wide = camera_of(CameraModel("OPENCV_FISHEYE", (366.0, 366.0, 480.0, 320.0, 0.01, 0, 0, 0), K, 960, 640))
    plain = camera_of(CameraModel("OPENCV", (366.0, 366.0, 480.0, 320.0, 0.01, 0, 0, 0), K, 960, 640))

    assert wide.lens.projection == "equidistant" and wide.lens.radial == (0.01, 0.0, 0.0, 0.0)
    assert plain.lens.projection == "perspective"


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_has_the_photos_that_its_text_says(name):
    views = DEMO_SCENES[name].views()

    assert f", {len(views.cam_from_world)} photos " in SCENES[name]
    assert len({camera.K.tobytes() for camera in views.cameras.values()}) == 1
    assert max(camera.width * camera.height for camera in views.cameras.values()) <= 960 * 640


def test_every_scene_has_a_name():
    assert tuple(DEMO_SCENES) == tuple(SCENES)
