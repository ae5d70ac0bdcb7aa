from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from sfm_app.colmap.backend import pycolmap
from sfm_app.colmap.model import poses_and_points
from sfm_app.frame import upright
from sfm_app.frame.georeference import enu_m, position_from_enu
from sfm_app.frame.up_direction import up_direction
from sfm_app.frame.upright import extract_cues, orient, orient_or_keep, submit_cue_extraction, turn_camera
from sfm_app.runtime.workspace import Workspace
from sfm_app.synthetic.cameras import arc, make_camera
from sfm_app.types import GpsPosition, MatchedImage, MatchGraph

pytestmark = pytest.mark.slow

METRES = 8.0
"""Per unit of the synthetic scene."""

HEADING_DEG = 70.0
"""Compass direction that its -z has."""


def model_of(views):
    """A COLMAP model with these views, moved to another frame, and a cloud of points a quarter as deep as wide."""
    model = pycolmap.Reconstruction()
    for key, (name, pose) in enumerate(views.cam_from_world.items(), start=1):
        camera = views.cameras[name]
        params = [*np.diag(camera.K)[:2], *camera.K[:2, 2], 0, 0, 0, 0]
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=key, model="OPENCV", width=camera.width, height=camera.height, params=params)
        )
        image = pycolmap.Image(name=name, camera_id=key, image_id=key)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
    for xyz in np.random.default_rng(0).uniform([-2, 0, -0.5], [2, 2, 0.5], (300, 3)):
        model.add_point3D(xyz, pycolmap.Track(), np.zeros(3, np.uint8))
    model.transform(pycolmap.Sim3d(0.3, pycolmap.Rotation3d(np.array([0.3, -0.5, 0.1, 0.8])), np.array([1.0, 2, 3])))
    return model


def scene(tmp_path, positions):
    views = arc(make_camera(480, 320))
    images = {
        key: MatchedImage(key, name, "one", 480, 320, gps=gps)
        for key, (name, gps) in enumerate(zip(views.cam_from_world, positions(views), strict=True), start=1)
    }
    run = SimpleNamespace(workspace=Workspace(tmp_path), executor=ThreadPoolExecutor(1))
    return views, model_of(views), MatchGraph(images, {}, {}), run


def true_positions(views):
    """Where the cameras are if the synthetic scene stands in Vienna, and looks towards `HEADING_DEG`."""
    turn = np.radians(HEADING_DEG)
    ahead, right = np.array([np.sin(turn), np.cos(turn), 0.0]), np.array([np.cos(turn), -np.sin(turn), 0.0])
    axes = np.stack([right, [0, 0, 1.0], -ahead])
    centers = [-pose[:, :3].T @ pose[:, 3] for pose in views.cam_from_world.values()]
    return [position_from_enu(METRES * center @ axes, GpsPosition(48.2, 16.37, 170.0)) for center in centers]


ROTATIONS = {
    0: [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    90: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],  # on end: what is down is on the right of the sensor
    180: [[-1, 0, 0], [0, -1, 0], [0, 0, 1]],
    270: [[0, -1, 0], [1, 0, 0], [0, 0, 1]],
}
"""cam_from_world by how far the picture has to be turned clockwise."""


def test_without_gps_the_model_has_size_one_and_stands_upright(tmp_path):
    views, model, matches, run = scene(tmp_path, lambda views: [None] * len(views.cam_from_world))

    entry = orient(model, matches, submit_cue_extraction([model], matches, run))
    poses, points = poses_and_points(model)

    assert entry["up"] == "camera roll" and entry["gps"] == "not used: the photos have no positions"
    assert np.allclose(np.median(points, axis=0), 0, atol=0.1)
    assert np.percentile(np.linalg.norm(points, axis=1), 80) == pytest.approx(1, abs=1e-6)
    ups = [poses[key][:, :3].T @ pose[:, :3] @ [0, 1, 0] for key, pose in enumerate(views.cam_from_world.values(), 1)]
    assert np.allclose(ups, ups[0], atol=1e-6)
    assert ups[0][1] > np.cos(np.radians(12))
    assert np.mean([pose[2, 2] for pose in poses.values()]) < -0.8, "photos look from the viewer's side"


def test_with_gps_the_model_is_in_meters_and_knows_its_place(tmp_path):
    _, model, matches, run = scene(tmp_path, true_positions)
    shape = poses_and_points(model)[1]

    entry = orient(model, matches, submit_cue_extraction([model], matches, run))
    points = poses_and_points(model)[1]

    assert entry["unit"] == "meter" and entry["gps"] == "12 of 12 positions agree"
    assert np.ptp(points, axis=0).max() / np.linalg.norm(np.ptp(shape, axis=0)) > 5
    extent = np.linalg.norm(points - np.median(points, axis=0), axis=1).max()
    assert extent == pytest.approx(METRES * np.hypot(2, np.hypot(1, 0.5)), rel=0.1)
    place = entry["georeference"]
    assert (place["latitude_deg"], place["longitude_deg"]) == pytest.approx((48.2, 16.37), abs=3e-5)
    assert place["altitude_m"] == pytest.approx(170 + METRES, abs=3)
    assert 0 <= place["heading_deg"] < 360
    turned_deg = (place["heading_deg"] - HEADING_DEG + 180) % 360 - 180
    assert abs(turned_deg) < 30, "the front may be turned to the viewer, not further"
    h = np.radians(place["heading_deg"])
    origin = GpsPosition(place["latitude_deg"], place["longitude_deg"], place["altitude_m"])
    for key, pose in poses_and_points(model)[0].items():
        x, y, z = -pose[:, :3].T @ pose[:, 3]
        enu = np.array([x * np.cos(h) - z * np.sin(h), -x * np.sin(h) - z * np.cos(h), y])
        assert enu == pytest.approx(enu_m([matches.images[key].gps], origin)[0], abs=4), "up is only that of roll"


def test_swapped_latitudes_and_longitudes_are_named_and_not_used(tmp_path):
    def swapped(views):
        true = true_positions(views)
        return [GpsPosition(one.longitude_deg, one.latitude_deg, one.altitude_m) for one in true]

    _, model, matches, run = scene(tmp_path, swapped)
    entry = orient(model, matches, submit_cue_extraction([model], matches, run))
    assert entry["gps"].startswith("not used: latitude and longitude are probably swapped")
    assert entry["unit"] == "about the size of the scene"


def test_the_manifest_says_why_up_is_up(tmp_path):
    _, model, matches, run = scene(tmp_path, lambda views: [None] * len(views.cam_from_world))
    looks = submit_cue_extraction([model], matches, run)

    entry = orient(model, matches, looks)
    ups = [pose[1, 1] for pose in poses_and_points(model)[0].values()]
    again = orient(model, matches, looks, turn_deg=180)

    assert entry["photos_turned_deg"] == 0 and again["photos_turned_deg"] == 180
    assert 100 < entry["up_sign_odds"] < 1000, "the scene shows nothing: it is habit alone"
    assert entry["up_axis_odds"] > 5
    assert set(entry["up_evidence_nats"].values()) == {0.0} and again["up_evidence_nats"] == {}
    assert again["up_sign_odds"] > 1e6
    assert [pose[1, 1] for pose in poses_and_points(model)[0].values()] == pytest.approx([-up for up in ups], abs=1e-6)


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_a_turned_photo_is_upright_once_it_is_turned(turn):
    R = np.array(ROTATIONS[turn], float)  # a level camera, held so that its picture has to be turned by that

    assert np.allclose(turn_camera(R, turn), np.eye(3))


def test_a_turned_photo_is_looked_at_upright(tmp_path):
    picture = np.zeros((200, 300), np.uint8)
    picture[:, 150:] = 200
    cv2.imwrite(str(tmp_path / "a.png"), picture)

    looks = [extract_cues(tmp_path / "a.png", turn).picture for turn in (0, 90, 180, 270)]

    assert looks[0][:, -1].mean() > 150 and looks[1][-1].mean() > 150  # what is right goes down, left, up
    assert looks[2][:, 0].mean() > 150 and looks[3][0].mean() > 150


def test_a_photo_that_is_gone_tells_nothing(tmp_path):
    picture = np.zeros((200, 300), np.uint8)
    picture[:, 150:] = 200
    cv2.imwrite(str(tmp_path / "a.png"), picture)

    seen, gone = extract_cues(tmp_path / "a.png"), extract_cues(Path(tmp_path / "b.png"))

    assert seen.lines == pytest.approx(np.array([[150, 0, 150, 200]]), abs=2)
    assert seen.picture.shape == (171, 256) and seen.picture[:, 200].min() > 190
    assert gone.lines.shape == (0, 4) and gone.picture is None


def test_points_that_are_nowhere_do_not_keep_the_model_from_standing_upright(tmp_path):
    _, model, matches, run = scene(tmp_path, lambda views: [None] * len(views.cam_from_world))
    for xyz in ([np.inf, 0, 0], [np.nan] * 3, [1e200, 1e200, 0]):
        model.add_point3D(np.array(xyz), pycolmap.Track(), np.zeros(3, np.uint8))

    entry = orient(model, matches, submit_cue_extraction([model], matches, run))
    points = poses_and_points(model)[1][:300]

    assert entry["up"] == "camera roll"
    assert np.percentile(np.linalg.norm(points, axis=1), 80) == pytest.approx(1, abs=1e-6)


def test_a_model_without_points_stays_as_it_is_and_the_entry_says_why(tmp_path):
    _, model, matches, run = scene(tmp_path, true_positions)
    for key in list(model.points3D):
        model.delete_point3D(key)
    before = {key: pose.copy() for key, pose in poses_and_points(model)[0].items()}

    entry = orient_or_keep(model, matches, submit_cue_extraction([model], matches, run))

    assert entry["failed"] == "it has no points" and entry["unit"] == "that of mapping"
    assert all(np.array_equal(pose, before[key]) for key, pose in poses_and_points(model)[0].items())


def test_gps_that_fails_leaves_the_model_upright_without_meters(tmp_path, monkeypatch):
    def failing(*_, **__):
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    _, model, matches, run = scene(tmp_path, true_positions)
    monkeypatch.setattr(upright, "georeference", failing)

    entry = orient_or_keep(model, matches, submit_cue_extraction([model], matches, run))

    assert entry["up"] == "camera roll" and entry["unit"] == "about the size of the scene"
    assert entry["gps"] == "not used: the computation failed: Eigenvalues did not converge"


def test_up_that_nobody_knows_how_exactly_is_null_and_no_infinity(tmp_path, monkeypatch):
    def unsure(*args, **others):
        return replace(up_direction(*args, **others), deviation_deg=np.inf)

    _, model, matches, run = scene(tmp_path, lambda views: [None] * len(views.cam_from_world))
    monkeypatch.setattr(upright, "up_direction", unsure)

    assert orient_or_keep(model, matches, submit_cue_extraction([model], matches, run))["up_deviation_deg"] is None
