"""Photos taken on end: whether EXIF says so or only their shape, they share the camera of the others."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import sfm_app
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import ArcOptions, arc, make_camera
from sfm_app.synthetic.photo_folder import write_photo_folder
from sfm_app.synthetic.scenes import courtyard

SENSOR_FROM_UPRIGHT = {90: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], 270: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}
"""By how far the picture has to be turned clockwise to be upright."""
TURNED = {"view_01.jpg": 90, "view_03.jpg": 270, "view_05.jpg": 90}
EXIF = {90: 6, 270: 8}


@pytest.fixture(scope="module")
def upright_photos(tmp_path_factory):
    """The photos as cameras show them, turned by what EXIF says, and the truth."""
    place = tmp_path_factory.mktemp("portrait") / "photos"
    views = arc(make_camera(480, 320), ArcOptions(photos=8, sweep_deg=50.0))
    poses = {
        name: np.array(SENSOR_FROM_UPRIGHT[TURNED[name]], float) @ pose if name in TURNED else pose
        for name, pose in views.cam_from_world.items()
    }
    return place, write_photo_folder(place, courtyard(), replace(views, cam_from_world=poses))


@pytest.mark.parametrize("told", [True, False])
def test_portrait_and_landscape_are_one_camera(upright_photos, tmp_path, told):
    rendered, truth = upright_photos
    shutil.copytree(rendered, tmp_path / "photos")
    for name, turn in TURNED.items():
        exif = Image.Exif()
        with Image.open(tmp_path / "photos" / name) as photo:
            if told:
                exif[0x0112] = EXIF[turn]
                photo.save(tmp_path / "photos" / name, quality=95, exif=exif)
            else:
                photo.rotate(-turn, expand=True).save(tmp_path / "photos" / name, quality=95)

    settings = Settings.from_mapping({"quality": "draft", "report": False})
    run = sfm_app.reconstruct(tmp_path / "photos", tmp_path / "out", settings, last="scene")
    found = next(iter(run.calibration.cameras.values())).K

    assert len(run.calibration.cameras) == 1 and len(run.scene.registered) == 8
    assert found[0, 0] == pytest.approx(truth.camera.K[0, 0], rel=0.02)
    assert run.manifest["stages"]["scene"]["counts"]["orientation"]["photos_turned_deg"] == 0
    ups = [pose[:, :3].T @ upright(name, told) for name, pose in run.scene.cam_from_world.items()]
    assert np.array(ups)[:, 1].min() > np.cos(np.radians(25))


def upright(name, told):
    """What is up in a photo as it is laid out: without EXIF those turned the other way lie upside down."""
    turn = (TURNED[name] if told else 90) if name in TURNED else 0
    return {0: [0, -1, 0], 90: [-1, 0, 0], 270: [1, 0, 0]}[turn]
