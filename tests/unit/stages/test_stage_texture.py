from types import SimpleNamespace

import numpy as np
from PIL import Image

from sfm_app.stages.texture import load_texture, read_photo, save_texture
from sfm_app.texture import PhotoView
from sfm_app.types import Model, Surface, Texture
from sfm_app.workspace import Workspace

SURFACE = Surface(np.eye(3), np.array([[0, 1, 2]]), np.full((3, 3), 9, np.uint8))


def stored(model, place):
    save_texture(model, SimpleNamespace(workspace=Workspace(place)))
    return load_texture(place / "dense")


def test_a_model_comes_back_with_all_its_pages(tmp_path):
    rng = np.random.default_rng(1)
    pages = tuple(rng.integers(0, 255, (4 + k, 6, 3), np.uint8) for k in range(11))
    texture = Texture(rng.random((1, 3, 2)).astype(np.float32), np.array([10], np.int32), pages)

    found = stored(Model(SURFACE, texture), tmp_path)

    np.testing.assert_array_equal(found.surface.vertices, SURFACE.vertices)
    np.testing.assert_array_equal(found.texture.uv, texture.uv)
    assert found.texture.page.tolist() == [10]
    for ours, theirs in zip(found.texture.pages, pages, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_model_without_a_texture_comes_back(tmp_path):
    assert stored(Model(SURFACE), tmp_path).texture is None


def test_photos_are_rgb_and_of_the_view_s_size(tmp_path):
    grey = np.zeros((40, 60), np.uint8)
    grey[:, 30:] = 200
    Image.fromarray(grey).save(tmp_path / "a.png")
    view = PhotoView("a.png", (50.0, 50.0, 30.0, 20.0, 0, 0, 0, 0), np.eye(3, 4), 60, 40)

    np.testing.assert_array_equal(read_photo(tmp_path, view), np.repeat(grey[:, :, None], 3, axis=2))
    small = read_photo(tmp_path, view.scaled(20, 10))
    assert small.shape == (10, 20, 3)
    assert (small[:, :10] == 0).all()
    assert (small[:, 10:] == 200).all()
