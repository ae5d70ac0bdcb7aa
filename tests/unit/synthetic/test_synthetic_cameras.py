import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import (
    ArcOptions,
    Camera,
    arc,
    axis_rotation,
    camera_centre,
    look_at,
    make_camera,
    pixel_rays,
)

COORDINATES = st.floats(-5, 5)


@given(x=COORDINATES, y=COORDINATES, z=COORDINATES, roll=st.floats(-180, 180))
@settings(deadline=None)
def test_a_camera_sees_its_aim_in_the_middle(x, y, z, roll):
    centre, aim = np.array([0.0, 1.0, 9.0]), np.array([x, y, z])
    pose = look_at(centre, aim, roll)
    R, t = pose[:, :3], pose[:, 3]

    assert np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(camera_centre(pose), centre)
    assert np.allclose(R @ aim + t, [0, 0, np.linalg.norm(aim - centre)], atol=1e-9)


def test_without_roll_the_world_stands_upright():
    pose = look_at(np.array([2.0, 1.0, 5.0]), np.array([0.0, 0.5, 0.0]))
    up = pose[:, :3] @ [0.0, 1.0, 0.0]

    assert up[0] == pytest.approx(0.0, abs=1e-12) and up[1] < -0.9, "y runs down in the photo"


def test_looking_straight_down_is_refused():
    with pytest.raises(ValueError, match="no roll"):
        look_at(np.array([0.0, 5.0, 0.0]), np.zeros(3))


def test_rotation_is_right_handed():
    turned = axis_rotation(np.array([0.0, 0.0, 1.0]), 90.0) @ [1.0, 0.0, 0.0]
    assert np.allclose(turned, [0.0, 1.0, 0.0])


@given(lam=st.floats(-0.3, 0.3), aspect=st.floats(0.7, 1.4))
@settings(deadline=None)
def test_rays_undo_projection_and_distortion(lam, aspect):
    plain = make_camera(40, 30, aspect=aspect)
    camera = Camera(plain.K, 40, 30, division_lambda=lam)
    h = pixel_rays(camera) @ camera.K.T
    undistorted = h[:, :2] / h[:, 2:] - camera.K[:2, 2]
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5)
    pixels = np.column_stack([x.ravel(), y.ravel()]) - camera.K[:2, 2]

    r2 = (pixels**2).sum(axis=1, keepdims=True) / 40**2
    assert np.allclose(undistorted * (1 + lam * r2), pixels)


def test_the_optical_centre_is_not_the_middle():
    K = make_camera(960, 640).K
    assert abs(K[0, 2] - 480) / 960 == pytest.approx(0.03)
    assert K[0, 0] == pytest.approx(1008.0) and K[0, 1] == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_an_arc_is_no_orbit(seed):
    options = ArcOptions()
    views = arc(make_camera(96, 64), options, seed)
    poses = np.array(list(views.cam_from_world.values()))
    centres = np.array([camera_centre(pose) for pose in poses])
    ground_distance = np.hypot(centres[:, 0], centres[:, 2])

    assert list(views.cam_from_world) == [f"view_{k:02d}.jpg" for k in range(12)]
    assert options.distance[0] <= ground_distance.min() and ground_distance.max() <= options.distance[1]
    assert np.ptp(ground_distance) > 0.7 * np.ptp(options.distance)
    assert np.ptp(centres[:, 1]) > 0.7 * np.ptp(options.height)
    azimuth = np.degrees(np.arctan2(centres[:, 0], centres[:, 2]))
    assert np.ptp(azimuth) == pytest.approx(options.sweep_deg)
    # the point nearest to all optical axes: in an orbit every axis goes through it
    axes = poses[:, 2, :3]
    away = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    meeting = np.linalg.solve(away.sum(axis=0), np.einsum("nij,nj->i", away, centres))
    miss = np.linalg.norm(np.einsum("nij,nj->ni", away, meeting - centres), axis=1)
    assert 0.1 < miss.mean() < 1.0


@pytest.mark.parametrize(
    ("options", "named"),
    [({"photos": 1}, "photos"), ({"sweep_deg": 0.0}, "sweep_deg"), ({"distance": (5.0, 4.0)}, "distance")],
)
def test_impossible_arcs_are_refused(options, named):
    with pytest.raises(ConfigError, match=named):
        ArcOptions(**options)


def test_impossible_cameras_are_refused():
    with pytest.raises(ConfigError, match="out of range"):
        make_camera(960, 640, focal_widths=0.0)
