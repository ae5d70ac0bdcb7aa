"""A demo says how close it came."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sfm_app.api import Run
from sfm_app.cli.output import fold_lines
from sfm_app.demo.result import demo_lines, evaluate
from sfm_app.demo.running import draw
from sfm_app.types import CameraModel, Model, Scene, Surface, Texture

pytestmark = pytest.mark.slow


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


def test_what_was_found_is_set_beside_the_truth(rendered, scene, model, tmp_path):
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
    assert "of the truth, 100.0 % of what the photos see" in text
    assert re.search(r"found  fx .* 1 % off\n", text)
    assert "took        2 s, and 1 s to render the photos" in text
    assert max(len(line) for line in fold_lines(text.splitlines()) if str(tmp_path) not in line) <= 80


def test_a_surface_partly_beside_the_truth_is_less_accurate(rendered, scene, model, tmp_path):
    truth = rendered[1]
    lifted = model.surface.vertices + np.array([0.0, 0.02 * np.linalg.norm(np.ptp(truth.vertices, axis=0)), 0.0])
    beside = replace(model, surface=replace(model.surface, vertices=lifted), texture=None)
    result = evaluate(Run(tmp_path, None, scene, None, None, {}), scene, beside, truth, (1.0, 2.0), tmp_path)

    # walls slide along themselves, the ground rises
    assert 5.0 < result.surface_accuracy_percent < 90.0
    assert result.pages_px == []


def test_the_picture_shows_a_photo_and_the_textured_model(rendered, scene, model, tmp_path):
    (tmp_path / "photos").symlink_to(rendered[0])
    draw(model, scene, tmp_path)

    picture = np.asarray(Image.open(tmp_path / "model.png"))
    photo = np.asarray(Image.open(rendered[0] / sorted(scene.cam_from_world)[3]))
    assert picture.shape == (640, 960, 3)
    assert np.array_equal(picture[:320, :480], photo)
    assert 0.3 < np.all(picture[:320, 480:] == [200, 40, 30], axis=2).mean() <= 1.0
