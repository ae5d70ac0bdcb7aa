"""Rendered folders with cameras that the user knows, and with photos taken on end, which share the camera of others."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sfm_app.api import reconstruct
from sfm_app.settings import Settings
from sfm_app.synthetic.cameras import ArcOptions, arc, make_camera
from sfm_app.synthetic.photo_folder import write_photo_folder
from sfm_app.synthetic.scenes import courtyard

pytestmark = pytest.mark.slow

QUICK = {"quality": "draft", "report": False, "matching": {"max_image_size_px": 360}}


def run(photos, out, **values):
    return reconstruct(photos, out, Settings.from_mapping(QUICK | values), last="scene")


def contradicted(done, stage):
    [camera] = done.manifest["stages"][stage]["counts"]["given_cameras"].values()
    assert camera["checked"]
    return [one["what"] for one in camera["contradicted"]]


def test_a_given_camera_is_kept_or_refined_and_checked(rendered, tmp_path):
    photos, truth = rendered
    f, cx, cy = truth.K[0, 0], truth.K[0, 2], truth.K[1, 2]
    size = {"width": 960, "height": 640}
    K = [[2 * f, 0, 2 * cx - 0.5], [0, 2 * f, 2 * cy - 0.5], [0, 0, 1]]
    file = tmp_path / "camera.json"
    file.write_text(json.dumps({"camera_matrix": K, "dist_coeffs": [0, 0, 0, 0], **size}))

    kept = run(photos, tmp_path / "out", calibration={"file": str(file), "keep": True})

    [camera] = kept.scene.cameras.values()
    assert camera.params == (f, f, cx, cy, 0.0, 0.0, 0.0, 0.0) and camera.deviations == {}
    assert (kept.calibration.main.method, kept.calibration.main.focal_px) == ("kept", pytest.approx(f))
    assert contradicted(kept, "intrinsics") == contradicted(kept, "scene") == []
    assert len(kept.scene.registered) == len(truth.cam_from_world)

    K[0][0] = K[1][1] = 2 * 1.15 * f
    file.write_text(json.dumps({"K": K, **size}))
    wrong = run(photos, tmp_path / "out", calibration={"file": str(file)})

    [camera] = wrong.scene.cameras.values()
    assert abs(camera.K[0, 0] / f - 1.0) < 0.01 and wrong.calibration.main.method == "given"
    assert contradicted(wrong, "intrinsics")[0] == contradicted(wrong, "scene")[0] == "focal length"
    assert kept.manifest["stages"]["match_graph"] == wrong.manifest["stages"]["match_graph"]


def test_the_named_model_is_the_last_one(rendered, tmp_path):
    photos, truth = rendered
    done = run(photos, tmp_path / "out", scene={"camera_model": "RADIAL"})
    [lens] = done.manifest["stages"]["scene"]["counts"]["lenses"].values()
    [camera] = done.scene.cameras.values()
    assert (lens["model"], lens["file"]) == ("RADIAL", "OPENCV")
    assert np.count_nonzero(camera.params[4:6]) == 2 and camera.params[6:] == (0.0, 0.0)
    assert abs(camera.K[0, 0] / truth.K[0, 0] - 1.0) < 0.01


SENSOR_FROM_UPRIGHT = {90: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], 270: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}
"""By how far the picture has to be turned clockwise to be upright."""
TURNED = {"view_01.jpg": 90, "view_03.jpg": 270, "view_05.jpg": 90}
EXIF = {90: 6, 270: 8}


def upright(name, told):
    """What is up in a photo as it is laid out: without EXIF those turned the other way lie upside down."""
    turn = (TURNED[name] if told else 90) if name in TURNED else 0
    return {0: [0, -1, 0], 90: [-1, 0, 0], 270: [1, 0, 0]}[turn]


@pytest.fixture(scope="module")
def upright_photos(tmp_path_factory):
    """The photos as cameras show them, turned by what EXIF says, and the truth."""
    place = tmp_path_factory.mktemp("portrait") / "photos"
    views = arc(make_camera(480, 320), ArcOptions(photos=6, sweep_deg=40.0))
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

    done = run(tmp_path / "photos", tmp_path / "out")
    [found] = done.calibration.cameras.values()

    assert len(done.scene.registered) == 6 and found.K[0, 0] == pytest.approx(truth.camera.K[0, 0], rel=0.02)
    assert done.manifest["stages"]["scene"]["counts"]["orientation"]["photos_turned_deg"] == 0
    ups = [pose[:, :3].T @ upright(name, told) for name, pose in done.scene.cam_from_world.items()]
    assert np.array(ups)[:, 1].min() > np.cos(np.radians(25))
