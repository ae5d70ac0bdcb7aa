"""A demo renders its photos once, never mixes them with those of another scene, and says how close it came."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.synthetic.scenes import poster
from benchmarks.synthetic.walks import orbit
from sfm_app.api import Run
from sfm_app.cli.commands import SCENES as TEXTS
from sfm_app.cli.output import fold_lines
from sfm_app.demo import SCENES, DemoScene, demo_lines, draw, evaluate, render_photos
from sfm_app.errors import InputError
from sfm_app.progress import Progress
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import make_camera
from sfm_app.types import CameraModel, Model, Scene, Surface, Texture

ONE_WORKER = Settings.from_mapping({"workers": 1})


def small(sweep_deg=40.0, photos=3):
    return DemoScene(poster, lambda: orbit(make_camera(48, 32), photos, sweep_deg))


SMALL_SCENES = {"one": small(), "turned": small(60.0), "longer": small(40.0, 4)}


class Stopping(Progress):
    """Stops as a person does, before the first photo."""

    def start(self, *_):
        raise KeyboardInterrupt


def render(out, scene, progress=None):
    return render_photos(out, scene, ONE_WORKER, progress or Progress(), SMALL_SCENES)


def changes(out):
    return {path.name: path.stat().st_mtime_ns for path in (out / "photos").iterdir()}


def test_photos_are_rendered_once(tmp_path):
    truth = render(tmp_path, "one")
    before = changes(tmp_path)
    again = render(tmp_path, "one")
    assert sorted(before) == sorted(truth.cam_from_world) == ["view_00.jpg", "view_01.jpg", "view_02.jpg"]
    assert changes(tmp_path) == before
    assert np.array_equal(again.vertices, truth.vertices) and np.array_equal(again.K, truth.K)


def test_what_is_missing_is_rendered(tmp_path):
    render(tmp_path, "one")
    bytes_of_all = {path.name: path.read_bytes() for path in (tmp_path / "photos").iterdir()}
    before = changes(tmp_path)
    (tmp_path / "photos" / "view_01.jpg").unlink()
    render(tmp_path, "one")
    assert {name for name, when in changes(tmp_path).items() if when != before[name]} == {"view_01.jpg"}
    assert {path.name: path.read_bytes() for path in (tmp_path / "photos").iterdir()} == bytes_of_all


@pytest.mark.parametrize("other", ["turned", "longer", "without a truth"])
def test_photos_of_another_scene_are_left_alone(tmp_path, other):
    render(tmp_path, other if other in SMALL_SCENES else "one")
    if other not in SMALL_SCENES:
        (tmp_path / "truth.json").unlink()
    before = changes(tmp_path)
    with pytest.raises(InputError, match="holds photos of another scene"):
        render(tmp_path, "one")
    assert changes(tmp_path) == before


def test_the_truth_says_which_photos_a_killed_demo_has_begun(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        render(tmp_path, "one", Stopping())
    assert len(json.loads((tmp_path / "truth.json").read_text(encoding="utf-8"))) > 0
    assert len(render(tmp_path, "one").cam_from_world) == 3


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_has_the_photos_of_its_text(name):
    views = SCENES[name].views()
    assert tuple(SCENES) == tuple(TEXTS)
    assert f", {len(views.cam_from_world)} photos " in TEXTS[name]
    assert len({camera.K.tobytes() for camera in views.cameras.values()}) == 1
    assert max(camera.width * camera.height for camera in views.cameras.values()) <= 960 * 640


@pytest.fixture(scope="module")
def scene(rendered) -> Scene:
    """The true cameras, but for 1 % of the focal."""
    truth = rendered[1]
    camera = truth.camera
    K = camera.K * [[1.01, 1, 1], [1, 1.01, 1], [1, 1, 1]]
    params = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    found = CameraModel("PINHOLE", params, K, camera.width, camera.height)
    return Scene(
        Path("sparse"), truth.cam_from_world, {}, {"one": found}, 0, 0, 0.0, dict.fromkeys(truth.cameras, "one")
    )


@pytest.fixture(scope="module")
def model(rendered) -> Model:
    """The true surface in red, on two pages."""
    vertices, faces = rendered[1].vertices, rendered[1].faces
    red = (200, 40, 30)
    pages = np.full((20, 30, 3), red, np.uint8), np.full((16, 16, 3), red, np.uint8)
    texture = Texture(np.full((len(faces), 3, 2), 0.5, np.float32), (np.arange(len(faces)) % 2).astype(np.int32), pages)
    return Model(Surface(vertices, faces, np.zeros(vertices.shape, np.uint8)), texture)


@pytest.mark.slow
def test_the_result_is_compared_with_the_truth(rendered, scene, model, tmp_path):
    truth = rendered[1]
    run = Run(tmp_path, None, scene, None, None, {})
    result = evaluate(run, scene, model, truth, (1.0, 2.0), tmp_path)

    assert result.photos == result.registered == 7
    assert result.refined_focal_error_percent == pytest.approx(1.0) and result.refined_center_error_percent == 0.0
    assert result.surface_error_percent == 0.0
    assert result.surface_accuracy_percent == result.surface_coverage_percent == 100.0
    assert result.pages_px == [[30, 20], [16, 16]]
    text = "\n".join(demo_lines(result))
    assert f"mesh        of all 7 photos, {len(truth.faces):,} triangles: 100.0 % within 0.5 %" in text
    assert "of the truth; it covers 100.0 % of the visible surface" in text
    assert re.search(r"found  fx .* 1 % off\n", text)
    assert "took        2 s, and 1 s to render the photos" in text
    assert max(len(line) for line in fold_lines(text.splitlines()) if str(tmp_path) not in line) <= 80


@pytest.mark.slow
def test_the_picture_shows_a_photo_and_the_textured_model(rendered, scene, model, tmp_path):
    (tmp_path / "photos").symlink_to(rendered[0])
    draw(model, scene, tmp_path)
    picture = np.asarray(Image.open(tmp_path / "model.png"))
    photo = np.asarray(Image.open(rendered[0] / sorted(scene.cam_from_world)[3]))
    assert picture.shape == (640, 960, 3)
    assert np.array_equal(picture[:320, :480], photo)
    assert 0.3 < np.all(picture[:320, 480:] == [200, 40, 30], axis=2).mean() <= 1.0
