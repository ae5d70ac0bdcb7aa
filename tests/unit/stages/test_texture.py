"""Textures in files, photos at the size of their views, and a killed run."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sfm_app.camera.models import camera_matrix
from sfm_app.photos.masks import save_mask
from sfm_app.products import read_texture, write_texture
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages import texture
from sfm_app.stages.texture import FileStore, surface_digest
from sfm_app.texture.views import PhotoView
from sfm_app.types import CameraModel, Model, Surface, Texture

POSE = np.eye(3, 4)
SURFACE = Surface(np.eye(3), np.array([[0, 1, 2]]), np.full((3, 3), 9, np.uint8))


VIEW = PhotoView("a.png", camera_matrix(50.0, 50.0, 30.0, 20.0), np.eye(3, 4), 60, 40, "a.png")


def run_of(place, fingerprint="", **settings):
    """A run that records nothing."""
    return SimpleNamespace(
        workspace=Workspace(place), settings=Settings.from_mapping(settings), fingerprint=fingerprint, map=None,
        record=dict, mask_dir=None,
    )  # fmt: skip


def stored(model, place):
    write_texture(model, Workspace(place))
    return read_texture(Workspace(place))


def test_a_model_comes_back_with_its_pages_and_normal_maps_if_it_has_any(tmp_path):
    rng = np.random.default_rng(1)
    pages, maps = (tuple(rng.integers(0, 255, (side + k, 6, 3), np.uint8) for k in range(11)) for side in (6, 3))
    texture = Texture(rng.random((1, 3, 2)).astype(np.float32), np.array([10], np.int32), pages)

    assert stored(Model(SURFACE), tmp_path).texture is None
    assert stored(Model(SURFACE, texture), tmp_path).texture.normal_maps == ()
    found = stored(Model(SURFACE, replace(texture, normal_maps=maps)), tmp_path)

    np.testing.assert_array_equal(found.surface.vertices, SURFACE.vertices)
    np.testing.assert_array_equal(found.texture.uv, texture.uv)
    assert found.texture.page.tolist() == [10]
    assert len(found.texture.pages) == len(found.texture.normal_maps) == 11
    for ours, theirs in zip((*found.texture.pages, *found.texture.normal_maps), (*pages, *maps), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_photos_are_rgb_and_of_the_view_s_size(tmp_path):
    gray = np.zeros((40, 60), np.uint8)
    gray[:, 30:] = 200
    Image.fromarray(gray).save(tmp_path / "a.png")
    files = FileStore(tmp_path, tmp_path / "parts")
    np.testing.assert_array_equal(files.photo(VIEW), np.repeat(gray[:, :, None], 3, axis=2))
    small = files.photo(VIEW.resize(20, 10))
    assert small.shape == (10, 20, 3)
    assert (small[:, :10] == 0).all()
    assert (small[:, 10:] == 200).all()


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.13])
def test_nothing_is_seen_of_what_is_masked_at_any_size(tmp_path, scale):
    photo, used = np.full((40, 60, 3), (20, 120, 90), np.uint8), np.ones((40, 60), bool)
    used[10:31, 17:44] = used[:, 3] = False
    photo[~used] = (255, 0, 255)
    Image.fromarray(photo).save(tmp_path / "a.png")
    save_mask(tmp_path / "masks", "a.png", used)
    files = FileStore(tmp_path, tmp_path / "parts", tmp_path / "masks")

    seen = files.photo(VIEW.resize(round(60 * scale), round(40 * scale)))

    np.testing.assert_array_equal(files.usable_pixels(VIEW), used)
    assert (seen == (20, 120, 90)).all()
    assert FileStore(tmp_path, tmp_path / "parts").usable_pixels(VIEW) is None


def test_arrays_come_back_by_name_and_damaged_ones_count_as_none(tmp_path):
    files = FileStore(tmp_path, tmp_path / "parts")
    assert files.recall("view0") is None

    files.keep("view0", {"score": np.arange(3), "sharpness": np.array(0.5)})
    files.keep("view0", {"score": np.arange(4)})

    assert list(files.recall("view0")) == ["score"]
    assert files.recall("view0")["score"].tolist() == [0, 1, 2, 3]
    (path,) = (tmp_path / "parts").iterdir()
    path.write_bytes(path.read_bytes()[:50])
    assert files.recall("view0") is None
    path.write_bytes(b"")
    assert files.recall("view0") is None


def test_the_digest_of_a_surface_is_that_of_all_its_parts():
    same = Surface(np.eye(3), np.array([[0, 1, 2]]), np.full((3, 3), 9, np.uint8))
    others = [
        replace(SURFACE, vertices=2 * np.eye(3)),
        replace(SURFACE, faces=np.array([[0, 2, 1]])),
        replace(SURFACE, colors=np.full((3, 3), 8, np.uint8)),
    ]
    assert surface_digest(same) == surface_digest(SURFACE)
    assert len({surface_digest(surface) for surface in (SURFACE, *others)}) == 4


@pytest.mark.parametrize("change", ["", "fingerprint", "camera", "surface"])
def test_nothing_is_used_that_was_found_with_something_else(tmp_path, monkeypatch, change):
    """The first run is killed at its second photo; photos that it has looked at are not read again."""
    found = []

    def texture_surface(surface, views, store, options, spread):
        found.append(store.recall("view0"))
        if len(found) == 1:
            store.keep("view0", {"score": np.arange(3)})
            raise KeyboardInterrupt
        return Model(surface), {}

    def run_stage(fingerprint="", focal=50.0, surface=SURFACE):
        camera = CameraModel("OPENCV", (focal, 50.0, 30.0, 20.0, 0, 0, 0, 0), np.eye(3), 60, 40)
        scene = SimpleNamespace(cameras={"one": camera}, camera_of={"a.png": "one"}, cam_from_world={"a.png": POSE})
        texture.make(scene, surface, run_of(tmp_path, fingerprint))

    monkeypatch.setattr(texture, "texture_surface", texture_surface)
    with pytest.raises(KeyboardInterrupt):
        run_stage()
    others = {"fingerprint": "others", "camera": 51.0, "surface": replace(SURFACE, vertices=2 * np.eye(3))}
    run_stage(**({"focal" if change == "camera" else change: others[change]} if change else {}))

    assert (found[1] is None) == bool(change)
    assert not (tmp_path / "texture" / texture.PARTS).exists()
