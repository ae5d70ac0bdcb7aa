"""Cameras, their lenses and their poses along an arc."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from benchmarks.synthetic.walks import orbit
from sfm_app.errors import ConfigError
from sfm_app.synthetic import cameras
from sfm_app.types.scene import camera_center

COORDINATES = st.floats(-5, 5)


@given(x=COORDINATES, y=COORDINATES, z=COORDINATES, roll=st.floats(-180, 180))
def test_a_camera_sees_its_aim_in_the_middle(x, y, z, roll):
    center, aim = np.array([0.0, 1.0, 9.0]), np.array([x, y, z])
    pose = cameras.look_at(center, aim, roll)
    R, t = pose[:, :3], pose[:, 3]
    assert np.allclose(R @ R.T, np.eye(3)) and np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(camera_center(pose), center)
    assert np.allclose(R @ aim + t, [0, 0, np.linalg.norm(aim - center)], atol=1e-9)


def test_without_roll_the_world_stands_upright():
    assert np.allclose(cameras.axis_rotation(np.array([0.0, 0.0, 1.0]), 90.0) @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    pose = cameras.look_at(np.array([2.0, 1.0, 5.0]), np.array([0.0, 0.5, 0.0]))
    up = pose[:, :3] @ [0.0, 1.0, 0.0]
    assert up[0] == pytest.approx(0.0, abs=1e-12) and up[1] < -0.9, "y runs down in the photo"


@given(k1=st.floats(-0.35, 0.5), aspect=st.floats(0.8, 1.4), width=st.sampled_from([40, 56]))
def test_rays_undo_projection_and_distortion(k1, aspect, width):
    camera = cameras.make_camera(width, 30, focal_widths=1.3, aspect=aspect, radial=k1)
    x, y, z = cameras.pixel_rays(camera).T
    # COLMAP's OPENCV model, which is SIMPLE_RADIAL where fx = fy
    bent = 1 + k1 * (x * x + y * y)
    pixels = np.column_stack([x * bent, y * bent, z]) @ camera.K.T
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(30) + 0.5)
    assert np.allclose(pixels[:, 0], u.ravel(), atol=1e-11) and np.allclose(pixels[:, 1], v.ravel(), atol=1e-11)
    assert np.all(1 + 3 * k1 * (x * x + y * y) > 0), "the branch through the center"


@given(share=st.floats(0.5, 1.5).filter(lambda share: abs(share - 1) > 1e-6))
def test_distortion_that_folds_within_the_photo_is_refused(share):
    plain = cameras.make_camera(40, 30, center=(0.5, 0.5))
    rim = np.hypot(19.5 / plain.K[0, 0], 14.5 / plain.K[1, 1])  # the outermost pixel centers
    folds_at_rim = -4.0 / 27.0 / rim**2
    camera = cameras.make_camera(40, 30, center=(0.5, 0.5), radial=share * folds_at_rim)
    if share > 1:
        with pytest.raises(ConfigError, match="folds within the photo"):
            cameras.pixel_rays(camera)
    else:
        assert np.all(np.isfinite(cameras.pixel_rays(camera)))


def miss_of_axes(views):
    """(N,) how far each optical axis passes the point that is nearest to all of them."""
    poses = np.array(list(views.cam_from_world.values()))
    centers = np.array([camera_center(pose) for pose in poses])
    axes = poses[:, 2, :3]
    away = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    meeting = np.linalg.solve(away.sum(axis=0), np.einsum("nij,nj->i", away, centers))
    return np.linalg.norm(np.einsum("nij,nj->ni", away, meeting - centers), axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_an_arc_is_no_orbit(seed):
    options = cameras.ArcOptions()
    views = cameras.arc(cameras.make_camera(96, 64), options, seed)
    centers = np.array([camera_center(pose) for pose in views.cam_from_world.values()])
    ground_distance = np.hypot(centers[:, 0], centers[:, 2])

    assert list(views.cam_from_world) == [f"view_{k:02d}.jpg" for k in range(12)] == list(views.cameras)
    assert options.distance[0] <= ground_distance.min() and ground_distance.max() <= options.distance[1]
    assert np.ptp(ground_distance) > 0.7 * np.ptp(options.distance)
    assert np.ptp(centers[:, 1]) > 0.7 * np.ptp(options.height)
    azimuth = np.degrees(np.arctan2(centers[:, 0], centers[:, 2]))
    assert np.ptp(azimuth) == pytest.approx(options.sweep_deg) and 0.1 < miss_of_axes(views).mean() < 1.0


def test_photos_can_be_taken_with_another_camera():
    wide, tele = cameras.make_camera(96, 64), cameras.make_camera(96, 64, focal_widths=2.0)
    views = orbit(wide, 4).with_camera(tele, ["view_01.jpg", "view_03.jpg"])
    assert [camera is tele for camera in views.cameras.values()] == [False, True, False, True]
    assert list(views.cameras) == list(views.cam_from_world)
    with pytest.raises(ConfigError, match=r"no such photo: view_09\.jpg"):
        views.with_camera(tele, ["view_09.jpg"])


def rays_at(theta, azimuth=0.3):
    theta = np.asarray(theta, float)
    return np.column_stack([np.sin(theta) * np.cos(azimuth), np.sin(theta) * np.sin(azimuth), np.cos(theta)])


@pytest.mark.parametrize(
    ("projection", "radius"),
    [
        ("perspective", np.tan),
        ("stereographic", lambda theta: 2 * np.tan(theta / 2)),
        ("equidistant", lambda theta: theta),
        ("equisolid", lambda theta: 2 * np.sin(theta / 2)),
    ],
)
def test_the_radius_is_that_of_the_projection(projection, radius):
    theta = np.linspace(0.0, 1.5, 7)
    points = cameras.Lens(projection).project(rays_at(theta))
    np.testing.assert_allclose(np.hypot(*points.T), radius(theta), atol=1e-12)
    np.testing.assert_allclose(np.arctan2(points[1:, 1], points[1:, 0]), 0.3, atol=1e-12)


@given(
    projection=st.sampled_from([name for name in cameras.PROJECTIONS if name != "equirectangular"]),
    k1=st.floats(-0.05, 0.1), k2=st.floats(-0.005, 0.01), p=st.floats(-0.002, 0.002), theta=st.floats(0.0, 1.2),
    azimuth=st.floats(-3.1, 3.1),
)  # fmt: skip
def test_a_ray_comes_back_through_the_lens(projection, k1, k2, p, theta, azimuth):
    lens = cameras.Lens(projection, (k1, k2), (p, -p / 2))
    ray = rays_at([theta], azimuth)
    radii = np.hypot(*cameras.Lens(projection, (k1, k2)).project(rays_at(np.linspace(0.0, theta + 0.05, 200))).T)
    assume((np.diff(radii) > 1e-6).all() or theta < 0.01)  # beyond its fold a lens has no inverse
    back = lens.rays(lens.project(ray))[0]
    np.testing.assert_allclose(back / np.linalg.norm(back), ray[0], atol=1e-10)


def test_a_fisheye_sees_behind_itself_and_no_further_than_all_round():
    lens = cameras.Lens("equidistant")
    behind, beyond = lens.rays(np.array([[2.0, 0.0], [3.2, 0.0]]))
    assert behind[2] < 0 and np.isnan(beyond).all()
    assert np.isnan(cameras.Lens("equisolid").rays(np.array([[2.1, 0.0]]))).all()


@pytest.mark.parametrize("projection", sorted(set(cameras.PROJECTIONS) - {"perspective", "equirectangular"}))
@pytest.mark.parametrize("field_deg", [90.0, 150.0, 200.0])
def test_the_field_of_view_is_what_was_asked_for(projection, field_deg):
    camera = cameras.make_wide_camera(320, 240, field_deg, cameras.Lens(projection), center=(0.5, 0.5))
    edge = camera.lens.rays(np.array([[160.0 / camera.K[0, 0], 0.0]]))[0]
    assert np.degrees(np.arccos(edge[2])) == pytest.approx(field_deg / 2)


def test_a_panorama_looks_all_round():
    camera = cameras.panorama_camera(64)
    rays = cameras.pixel_rays(camera).reshape(32, 64, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=2), 1.0)
    assert rays[16, 32] @ [0, 0, 1] > 0.99 and rays[16, 0] @ [0, 0, -1] > 0.99
    assert rays[16, 48] @ [1, 0, 0] > 0.99 and rays[31, 5] @ [0, 1, 0] > 0.99
    flat = rays.reshape(-1, 3)
    np.testing.assert_allclose(camera.lens.rays(camera.lens.project(flat)), flat, atol=1e-12)


def test_impossible_arcs_and_cameras_are_refused():
    for options in ({"photos": 1}, {"sweep_deg": 0.0}, {"distance": (5.0, 4.0)}):
        with pytest.raises(ConfigError, match=next(iter(options))):
            cameras.ArcOptions(**options)
    with pytest.raises(ValueError, match="no roll"):
        cameras.look_at(np.array([0.0, 5.0, 0.0]), np.zeros(3))
    with pytest.raises(ConfigError, match="out of range"):
        cameras.make_camera(960, 640, focal_widths=0.0)
    with pytest.raises(ConfigError, match="unknown projection"):
        cameras.Lens("pinhole")
    with pytest.raises(ConfigError, match="folds within the photo"):
        cameras.Lens(radial=(-0.3,)).rays(np.array([[1.5, 0.0]]))
    with pytest.raises(ConfigError, match="out of range"):
        cameras.make_wide_camera(320, 240, 180.0, cameras.Lens())
