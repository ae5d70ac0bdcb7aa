"""Planes that people name, and the main wall of surfaces with known walls."""

import numpy as np
import pytest

from sfm_app.errors import ConfigError, ReconstructionError
from sfm_app.frame.scale import MetricFrame
from sfm_app.maps.projections import find_facade, project, read_plane
from sfm_app.types import Surface
from tests.unit.maps.conftest import HALF, TALL

CORNERS = np.array([[-3.0, 1.0, 2.0], [5.0, -2.0, 0.5], [0.0, 4.0, -1.0], [2.5, 0.0, 7.0]])
NOTHING = np.zeros((0, 3), np.int64)


def shown(plane, points=CORNERS):
    return project(Surface(points, NOTHING, np.zeros((len(points), 3), np.uint8)), MetricFrame(), plane)


def test_the_ground_without_a_place_has_x_to_the_right_and_minus_z_up():
    found = shown("")
    x, y, z = CORNERS.T
    np.testing.assert_allclose(found.points, np.column_stack([x, -z, y]), atol=1e-12)
    assert (found.wkt, found.unit_m, found.cut) == ("", 0.0, False)


@pytest.mark.parametrize("plane", ["0,0,0.5 2,0,0.5 1,3,0.5", "0,0,0.5 2,3,0.5 -1,3,0.5"])
def test_three_points_counterclockwise_for_the_viewer(plane):
    x, y, z = CORNERS.T
    np.testing.assert_allclose(shown(plane).points, np.column_stack([x, y, z - 0.5]), atol=1e-12)
    a, b, c = plane.split()
    np.testing.assert_allclose(shown(f"{a} {c} {b}").points, np.column_stack([-x, y, 0.5 - z]), atol=1e-12)


def test_the_top_of_a_floor_is_minus_z_and_of_a_roof_its_ridge():
    x, y, z = CORNERS.T
    np.testing.assert_allclose(shown("0,1,0 1,1,0 0,1,-1").points, np.column_stack([x, -z, y - 1.0]), atol=1e-12)
    slope = np.radians(40.0)
    far = f"0,{np.sin(slope)},{-np.cos(slope)}"
    expected = np.column_stack([x, y * np.sin(slope) - z * np.cos(slope), y * np.cos(slope) + z * np.sin(slope)])
    np.testing.assert_allclose(shown(f"0,0,0 1,0,0 {far}").points, expected, atol=1e-12)


def test_a_section_has_its_first_point_at_the_left():
    found = shown("1,0,3 1,2,-1")  # along -z: the viewer looks to -x
    x, y, z = CORNERS.T
    np.testing.assert_allclose(found.points, np.column_stack([-z, y, x - 1.0]), atol=1e-12)
    assert found.cut


def test_words_that_are_no_plane():
    assert read_plane("facade") == []
    assert [point.tolist() for point in read_plane(" 1,2,3   -1,0,1e-3 ")] == [[1, 2, 3], [-1, 0, 0.001]]
    for text in ("wall", "1,2,3", "1,2,3 4,5,6 7,8,9 1,1,1", "1,2 3,4,5", "1,2,nan 3,4,5"):
        with pytest.raises(ConfigError) as caught:
            read_plane(text)
        assert "facade" in caught.value.hint
    for plane in ("0,0,0 0,1,0", "1,1,1 2,2,2 3,3,3"):
        with pytest.raises(ConfigError, match="line"):
            shown(plane)


def wall(direction_deg, width, height, distance, noise=0.0, seed=0, lean_deg=0.0):
    """Corners (T, 3, 3) of a rough wall: its normal lies `direction_deg` from z to x, its middle along it."""
    rng = np.random.default_rng(seed)
    across, up = np.meshgrid(np.linspace(-width / 2, width / 2, 41), np.linspace(0.0, height, 21), indexing="ij")
    out = rng.normal(scale=noise, size=across.shape) - up * np.tan(np.radians(lean_deg))
    angle = np.radians(direction_deg)
    right, normal = np.array([np.cos(angle), 0, -np.sin(angle)]), np.array([np.sin(angle), 0, np.cos(angle)])
    grid = across[..., None] * right + up[..., None] * [0.0, 1.0, 0.0] + (distance + out)[..., None] * normal
    a, b, c, d = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    return np.concatenate([np.stack([a, b, c], 2).reshape(-1, 3, 3), np.stack([a, c, d], 2).reshape(-1, 3, 3)])


def surface(*parts):
    corners = np.concatenate(parts)
    return Surface(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), np.zeros((len(corners) * 3, 3)))


@pytest.mark.parametrize("direction_deg", [0.0, 63.0, 179.9, -120.0])
def test_the_main_wall_among_others(direction_deg):
    """A rough wall of 60 m2, a parallel one of 48 m2 behind it, one of 50 m2 around the corner, and the ground."""
    main = wall(direction_deg, 10.0, 6.0, 3.0, noise=0.02)
    rest = [wall(direction_deg, 8.0, 6.0, -2.0, 0.02, 1), wall(direction_deg + 90.0, 10.0, 5.0, 4.0, 0.02, 2)]
    ground = wall(0.0, 30.0, 30.0, 0.0)[:, :, [0, 2, 1]] * [1.0, 1.0, -1.0]
    normal, point = find_facade(surface(main, *rest, ground))
    angle = np.radians(direction_deg)
    true = np.array([np.sin(angle), 0.0, np.cos(angle)])
    assert np.degrees(np.arccos(np.clip(normal @ true, -1.0, 1.0))) < 0.1
    assert normal[1] == 0.0 and np.linalg.norm(normal) == pytest.approx(1.0)
    assert point @ true == pytest.approx(3.0, abs=0.01)


def test_a_rough_wall_counts_more_than_a_smooth_one_of_half_its_size():
    rough, smooth = wall(10.0, 10.0, 6.0, 3.0, noise=0.03), wall(70.0, 5.0, 6.0, 1.0)
    normal, _ = find_facade(surface(rough, smooth))
    assert np.degrees(np.arctan2(normal[0], normal[2])) == pytest.approx(10.0, abs=0.3)


def test_one_wall_of_two_triangles_and_a_leaning_one():
    normal, point = find_facade(surface(wall(30.0, 2.0, 2.0, 1.0)[:1], wall(30.0, 2.0, 2.0, 1.0)[-1:]))
    assert normal == pytest.approx([0.5, 0.0, np.sqrt(0.75)], abs=1e-9)
    assert point @ normal == pytest.approx(1.0)
    normal, _ = find_facade(surface(wall(30.0, 20.0, 2.0, 1.0, lean_deg=10.0)))
    assert normal == pytest.approx([0.5, 0.0, np.sqrt(0.75)], abs=0.01)


def test_without_walls_there_is_no_facade():
    ground = wall(0.0, 2.0 * HALF, TALL, 0.0)[:, :, [0, 2, 1]]
    with pytest.raises(ReconstructionError, match="upright") as caught:
        find_facade(surface(ground))
    assert "--plane" in caught.value.hint
