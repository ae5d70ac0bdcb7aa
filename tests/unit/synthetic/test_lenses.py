"""Lenses of synthetic cameras are those of the textbook, and what they do is undone exactly."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sfm_app.errors import ConfigError
from sfm_app.synthetic.cameras import PROJECTIONS, Lens, make_wide_camera, panorama_camera, pixel_rays

WIDE = [name for name in PROJECTIONS if name not in ("perspective", "equirectangular")]


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
    points = Lens(projection).project(rays_at(theta))
    np.testing.assert_allclose(np.hypot(*points.T), radius(theta), atol=1e-12)
    np.testing.assert_allclose(np.arctan2(points[1:, 1], points[1:, 0]), 0.3, atol=1e-12)


@given(
    projection=st.sampled_from([name for name in PROJECTIONS if name != "equirectangular"]),
    k1=st.floats(-0.05, 0.1), k2=st.floats(-0.005, 0.01), p=st.floats(-0.002, 0.002), theta=st.floats(0.0, 1.2),
    azimuth=st.floats(-3.1, 3.1),
)  # fmt: skip
@settings(deadline=None)
def test_a_ray_comes_back_through_the_lens(projection, k1, k2, p, theta, azimuth):
    lens = Lens(projection, (k1, k2), (p, -p / 2))
    ray = rays_at([theta], azimuth)
    radii = np.hypot(*Lens(projection, (k1, k2)).project(rays_at(np.linspace(0.0, theta + 0.05, 200))).T)
    assume((np.diff(radii) > 1e-6).all() or theta < 0.01)  # beyond its fold a lens has no inverse
    back = lens.rays(lens.project(ray))[0]
    np.testing.assert_allclose(back / np.linalg.norm(back), ray[0], atol=1e-10)


def test_a_fisheye_sees_behind_itself_and_no_further_than_all_round():
    lens = Lens("equidistant")
    behind, beyond = lens.rays(np.array([[2.0, 0.0], [3.2, 0.0]]))
    assert behind[2] < 0 and np.isnan(beyond).all()
    assert np.isnan(Lens("equisolid").rays(np.array([[2.1, 0.0]]))).all()


@pytest.mark.parametrize("projection", WIDE)
@pytest.mark.parametrize("field_deg", [90.0, 150.0, 200.0])
def test_the_field_of_view_is_what_was_asked_for(projection, field_deg):
    camera = make_wide_camera(320, 240, field_deg, Lens(projection), center=(0.5, 0.5))
    edge = camera.lens.rays(np.array([[160.0 / camera.K[0, 0], 0.0]]))[0]
    assert np.degrees(np.arccos(edge[2])) == pytest.approx(field_deg / 2)


def test_a_panorama_looks_all_round():
    camera = panorama_camera(64)
    rays = pixel_rays(camera).reshape(32, 64, 3)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=2), 1.0)
    assert rays[16, 32] @ [0, 0, 1] > 0.99 and rays[16, 0] @ [0, 0, -1] > 0.99
    assert rays[16, 48] @ [1, 0, 0] > 0.99 and rays[31, 5] @ [0, 1, 0] > 0.99
    np.testing.assert_allclose(
        camera.lens.rays(camera.lens.project(rays.reshape(-1, 3))), rays.reshape(-1, 3), atol=1e-12
    )


def test_what_cannot_be_is_refused():
    with pytest.raises(ConfigError, match="unknown projection"):
        Lens("pinhole")
    with pytest.raises(ConfigError, match="folds within the photo"):
        Lens(radial=(-0.3,)).rays(np.array([[1.5, 0.0]]))
    with pytest.raises(ConfigError, match="out of range"):
        make_wide_camera(320, 240, 180.0, Lens())
