import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sfm_app.errors import ConfigError, InputError
from sfm_app.synthetic.cameras import Camera, Lens, Views, make_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, develop, load_truth, save_truth, write_photo_folder

pytestmark = pytest.mark.slow


class Counter:
    def __init__(self):
        self.seen = []

    def stage(self, name, note=""): ...

    def start(self, label, total):
        self.seen.append((label, total))

    def advance(self, steps=1):
        self.seen.append(steps)

    def finish(self):
        self.seen.append("done")


def test_the_folder_holds_photos_and_nothing_else(photos):
    folder, truth = photos
    assert sorted(path.name for path in folder.iterdir()) == sorted(truth.cam_from_world)
    for path in folder.iterdir():
        with Image.open(path) as image:
            assert image.format == "JPEG" and image.size == (truth.camera.width, truth.camera.height) == (120, 80)
            assert not image.getexif() and "exif" not in image.info
            assert np.asarray(image).std() > 20, "there is something to see"


def test_the_same_seed_gives_the_same_bytes(photos, still_life, four_views, tmp_path):
    folder, _ = photos
    progress = Counter()
    write_photo_folder(tmp_path / "again", still_life, four_views, PhotoOptions(seed=3), progress=progress)
    write_photo_folder(tmp_path / "other", still_life, four_views, PhotoOptions(seed=4))
    for path in folder.iterdir():
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes()
        assert (tmp_path / "other" / path.name).read_bytes() != path.read_bytes()
    assert progress.seen == [("rendering photos", 4), 1, 1, 1, 1, "done"]


@pytest.mark.parametrize("processes", [1, 2])
def test_missing_photos_are_added_with_the_same_bytes(processes, photos, still_life, four_views, tmp_path):
    folder, truth = photos
    (tmp_path / "view_01.jpg").write_bytes(b"left as it is")
    progress = Counter()
    found = write_photo_folder(tmp_path, still_life, four_views, PhotoOptions(seed=3), processes, progress)

    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in folder.iterdir())
    for path in folder.iterdir():
        same = (tmp_path / path.name).read_bytes() == path.read_bytes()
        assert same == (path.name != "view_01.jpg")
    assert progress.seen == [("rendering photos", 3), 1, 1, 1, "done"]
    assert list(found.cam_from_world) == list(truth.cam_from_world)
    progress.seen.clear()
    write_photo_folder(tmp_path, still_life, four_views, PhotoOptions(seed=3), processes, progress)
    assert progress.seen == [], "nothing is missing"


def test_truth_survives_the_disk_and_pickling(photos, tmp_path):
    _, truth = photos
    odd = Camera(np.array([[150.0, 0, 61.5], [0, 140.0, 38.25], [0, 0, 1]]), 124, 77, lens=Lens(radial=(-0.125,)))
    truth = replace(truth, cameras=Views(truth.cameras, truth.cam_from_world).with_camera(odd, ["view_02.jpg"]).cameras)
    save_truth(truth, tmp_path / "truth")
    for copy in (load_truth(tmp_path / "truth"), pickle.loads(pickle.dumps(truth))):  # noqa: S301
        for name, camera in truth.cameras.items():
            found = copy.cameras[name]
            assert np.array_equal(found.K, camera.K)
            assert (found.width, found.height, found.radial) == (camera.width, camera.height, camera.radial)
        assert copy.cameras["view_02.jpg"].radial == -0.125 and copy.cameras["view_01.jpg"].radial == 0.0
        assert list(copy.cam_from_world) == list(truth.cam_from_world)
        assert all(np.array_equal(copy.cam_from_world[name], pose) for name, pose in truth.cam_from_world.items())
        assert np.array_equal(copy.vertices, truth.vertices) and np.array_equal(copy.faces, truth.faces)


def test_truth_file_says_x_is_K_RX_plus_t(photos, tmp_path):
    _, truth = photos
    save_truth(truth, tmp_path)
    first = json.loads((tmp_path / "truth.json").read_text())["images"][0]
    X = np.array([0.1, 1.3, 0.2])
    h = np.array(first["K"]) @ (np.array(first["R"]) @ X + np.array(first["t"]))
    assert first["file"] == "view_00.jpg" and (first["width"], first["height"]) == (120, 80)
    assert h[2] > 0 and 0 < h[0] / h[2] < 120 and 0 < h[1] / h[2] < 80, "the ball is in the photo"
    assert np.allclose(truth.centers["view_00.jpg"], -np.array(first["R"]).T @ first["t"])


def test_every_photo_is_taken_with_its_own_camera(photos, still_life, four_views, tmp_path):
    folder, truth = photos
    tele = make_camera(120, 80, focal_widths=1.6)
    views = four_views.with_camera(tele, ["view_01.jpg"])
    mixed = write_photo_folder(tmp_path, still_life, views, PhotoOptions(seed=3))

    for name in truth.cam_from_world:
        same = (tmp_path / name).read_bytes() == (folder / name).read_bytes()
        assert same == (name != "view_01.jpg")
        assert (mixed.cameras[name].K[0, 0] == tele.K[0, 0]) == (name == "view_01.jpg")
    assert np.array_equal(truth.K, truth.camera.K)
    with pytest.raises(ValueError, match="several cameras"):
        _ = mixed.K


def test_noise_is_the_injected_noise():
    gray = np.full((200, 200, 3), 0.2)
    for noise in (0.8, 3.0):
        levels = develop(gray, PhotoOptions(noise=noise, blur_px=1.0), np.random.default_rng(0)).astype(float)
        # rounding to gray levels adds 1/12
        assert levels.std() == pytest.approx(np.hypot(noise, np.sqrt(1 / 12)), rel=0.02)
        assert levels.mean() == pytest.approx(255 * 0.2 ** (1 / 2.2), abs=0.1)


def test_blur_spreads_an_edge_as_far_as_asked():
    edge = np.zeros((40, 80, 3))
    edge[:, 40:] = 1.0
    rng = np.random.default_rng(0)
    blurred = [develop(edge, PhotoOptions(noise=0.0, blur_px=blur), rng) for blur in (0.0, 0.5, 2.0)]
    weights = [np.diff((photo[20, :, 0] / 255.0) ** 2.2) for photo in blurred]
    spread = [np.sqrt((w * (np.arange(79) - 39) ** 2).sum() / w.sum()) for w in weights]
    assert spread[0] == 0.0 and 0.4 < spread[1] < 0.6 and 1.8 < spread[2] < 2.2


def test_exposures_differ_by_as_much_as_asked():
    gray = np.full((20, 20, 3), 0.1)
    options = PhotoOptions(noise=0.0, blur_px=0.0, exposure_ev=0.5)
    levels = [develop(gray, options, np.random.default_rng(k)).mean() for k in range(200)]
    stops = np.log2((np.array(levels) / 255.0) ** 2.2 / 0.1)
    assert abs(stops.mean()) < 0.1 and stops.std() == pytest.approx(0.5, rel=0.15)


def test_wrong_options_and_a_file_in_place_of_the_folder_are_refused(still_life, four_views, photos, tmp_path):
    with pytest.raises(ConfigError, match="supersampling, quality"):
        PhotoOptions(supersampling=0, quality=100)
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(InputError, match="cannot write photos"):
        write_photo_folder(blocked, still_life, four_views)
    with pytest.raises(InputError, match="cannot write the truth"):
        save_truth(photos[1], blocked)


@pytest.mark.parametrize("damage", ["missing", "truncated", "no json"])
def test_damaged_truth_is_an_input_error(photos, tmp_path, damage):
    save_truth(photos[1], tmp_path)
    if damage == "missing":
        (tmp_path / "surface.ply").unlink()
    elif damage == "truncated":
        (tmp_path / "surface.ply").write_bytes((tmp_path / "surface.ply").read_bytes()[:-100])
    else:
        (tmp_path / "truth.json").write_text("{")
    with pytest.raises(InputError, match="no truth in"):
        load_truth(tmp_path)
