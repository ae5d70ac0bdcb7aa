"""Scale, heading and place from GPS positions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sfm_app.frame.georeference import enu_m, georeference, position_from_enu
from sfm_app.types import GpsPosition

ORIGIN = GpsPosition(48.2, 16.37, 180.0)
METRES = 12.5


def walk(count, radius_m, noise_m, seed=0, altitude_noise_m=None):
    """Camera centers along an arc, in an unknown frame with an unknown unit, and the positions a phone notes there.

    Returns:
        Centers (N, 3), positions, up (3,) in the unknown frame, true meters (N, 3) east, north, up of `ORIGIN`.
    """
    rng = np.random.default_rng(seed)
    angles = np.linspace(0, 2.5, count)
    enu = np.column_stack([radius_m * np.cos(angles), radius_m * np.sin(angles), 1.5 + 0.2 * rng.normal(size=count)])
    noise = rng.normal(size=(count, 3)) * [noise_m, noise_m, altitude_noise_m or 2 * noise_m]
    R = Rotation.random(random_state=seed).as_matrix()
    return enu @ R.T / METRES + [3, -2, 5], [position_from_enu(row, ORIGIN) for row in enu + noise], R[:, 2], enu


def test_meters_on_the_ellipsoid_and_back():
    here = GpsPosition(60.0, 179.9999, 100.0)
    enu = enu_m([GpsPosition(60.0, -179.9999, 90.0), GpsPosition(60.001, 179.9999, None)], here)
    assert enu[0] == pytest.approx([0.0002 * 55800.0, 0, -10], abs=0.02), "a degree of longitude at 60 N is 55.80 km"
    assert enu[1] == pytest.approx([0, 111.41, 0], abs=0.02), "a degree of latitude at 60 N is 111.41 km"
    there = position_from_enu(enu[0], here)
    assert (there.latitude_deg, there.longitude_deg) == pytest.approx((60.0, -179.9999), abs=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_scale_heading_and_place(seed):
    centers, positions, up, enu = walk(12, 60.0, 3.0, seed)

    found = georeference(centers, positions, up)

    assert found and (found.inliers, found.positions) == (12, 12)
    assert found.enu_from_world.scale == pytest.approx(METRES, rel=4 * found.scale_deviation)
    assert 0.005 < found.scale_deviation < 0.03
    assert 1.5 < found.rms_m < 6
    assert np.allclose(found.enu_from_world.R @ up, [0, 0, 1])
    moved = found.enu_from_world(centers)
    places = enu_m([position_from_enu(row, found.origin) for row in moved], ORIGIN)
    assert 0.1 < np.linalg.norm((places - enu)[:, :2], axis=1).max() < 8
    assert found.up_deviation_deg is None


def test_a_third_of_the_positions_may_be_wrong():
    centers, positions, up, _ = walk(12, 60.0, 3.0)
    for k in (0, 5, 6, 11):
        positions[k] = replace(positions[k], latitude_deg=positions[k].latitude_deg + 0.002 * (k - 5.5))
    positions[3] = None
    found = georeference(centers, positions, up)
    assert found and (found.inliers, found.positions) == (7, 11)
    assert found.enu_from_world.scale == pytest.approx(METRES, rel=0.06)


def test_three_exact_positions_are_enough_two_are_not():
    centers, positions, up, _ = walk(3, 60.0, 0.02)
    assert georeference(centers, positions, up).enu_from_world.scale == pytest.approx(METRES, rel=0.005)
    two = georeference(centers, [positions[0], positions[1], positions[1]], up)
    assert not two and "2 different positions" in two.reason


def test_no_positions():
    found = georeference(np.zeros((4, 3)), [None] * 4, np.array([0.0, 1.0, 0.0]))
    assert not found and found.reason == "the photos have no positions"


@pytest.mark.parametrize("seed", range(5))
def test_photos_from_one_spot_have_no_scale(seed):
    centers, positions, up, _ = walk(12, 1.5, 4.0, seed)
    found = georeference(centers, positions, up)
    assert not found and "do not determine a scale" in found.reason


@pytest.mark.parametrize("seed", range(5))
def test_positions_of_other_photos_do_not_agree(seed):
    centers, positions, up, _ = walk(12, 60.0, 3.0, seed)
    swapped = [positions[k] for k in np.random.default_rng(seed).permutation(12)]
    assert not georeference(centers, swapped, up)


def test_a_mirrored_walk_does_not_agree():
    centers, positions, up, _ = walk(12, 60.0, 3.0)
    assert not georeference(centers, positions, -up), "upside down, the walk turns the other way"


def test_a_drone_says_where_up_is_when_its_cameras_do_not():
    rng = np.random.default_rng(0)
    enu = np.column_stack([rng.uniform(-100, 100, (20, 2)), rng.uniform(55, 65, 20)])
    positions = [position_from_enu(row + rng.normal(scale=1.0, size=3), ORIGIN) for row in enu]
    wrong = np.array([0.0, 1.0, 0.0])

    found = georeference(enu / METRES, positions, wrong, up_is_sure=False)

    assert found.enu_from_world.R[2] == pytest.approx([0, 0, 1], abs=0.02)
    assert 0.1 < found.up_deviation_deg < 1.0
    assert found.enu_from_world.scale == pytest.approx(METRES, rel=0.02)
    flat = [replace(position, altitude_m=None) for position in positions]
    assert not georeference(enu / METRES, flat, wrong, up_is_sure=False)


def test_exact_positions_overrule_lines_that_lie_on_the_ground():
    """Photos of fields from above: on its side, the model still agrees with most positions to some meters."""
    rng = np.random.default_rng(0)
    enu = np.stack([np.repeat([-12.0, 0.0, 12.0], 7), np.tile(np.linspace(-12, 12, 7), 3), 30 + rng.normal(size=21)], 1)
    lying = np.array([np.sin(0.4), np.cos(0.4), 0.0])

    def found(noise_m):
        positions = [position_from_enu(row + rng.normal(scale=noise_m, size=3), ORIGIN) for row in enu]
        return georeference(enu / METRES, positions, lying)

    exact = found(0.05)
    assert exact.enu_from_world.R[2] == pytest.approx([0, 0, 1], abs=0.01) and exact.rms_m < 0.1
    assert exact.enu_from_world.scale == pytest.approx(METRES, rel=0.01) and exact.up_deviation_deg < 0.5


def test_positions_that_fit_a_sure_up_leave_it():
    """Up from positions is a degree off: lines are better, and both leave the same residuals."""
    centers, positions, up, _ = walk(12, 60.0, 0.5)
    rng = np.random.default_rng(1)
    positions = [replace(position, altitude_m=180.0 + rng.normal(scale=0.5)) for position in positions]
    found = georeference(centers, positions, up)
    assert found.up_deviation_deg is None


@pytest.mark.parametrize("up_is_sure", [True, False])
def test_cameras_too_near_each_other_for_numbers_have_no_place(up_is_sure):
    centers, positions, up, _ = walk(12, 60.0, 3.0)
    positions = [replace(position, altitude_m=180.0 + k) for k, position in enumerate(positions)]
    assert not georeference(1e-200 * centers, positions, up, up_is_sure=up_is_sure)


def swap(positions):
    return [replace(one, latitude_deg=one.longitude_deg, longitude_deg=one.latitude_deg) for one in positions]


@pytest.mark.parametrize("radius_m", [15.0, 60.0])
@pytest.mark.parametrize("up_is_sure", [True, False])
def test_swapped_latitude_and_longitude_are_named(radius_m, up_is_sure):
    centers, positions, up, _ = walk(12, radius_m, 0.3)
    found = georeference(centers, swap(positions), up, up_is_sure=up_is_sure)
    assert not found and "latitude and longitude are probably swapped" in found.reason
    assert georeference(centers, positions, up, up_is_sure=up_is_sure)


@pytest.mark.parametrize("place", [(10.0, 80.0), (48.2, 16.37), (45.0, 44.0), (-33.9, 18.4)])
def test_sound_positions_raise_no_alarm_also_on_a_line(place):
    origin = GpsPosition(*place, 100.0)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        centers, _, up, enu = walk(12, 60.0, 0.0, seed)
        flatten = [1.0, 0.02, 1.0] if seed % 2 else [1.0, 1.0, 1.0]
        R = np.linalg.lstsq(enu - enu.mean(axis=0), centers - centers.mean(axis=0), rcond=None)[0]
        enu = (enu - enu.mean(axis=0)) * flatten
        noisy = enu + rng.normal(scale=3.0, size=enu.shape)
        found = georeference(enu @ R, [position_from_enu(row, origin) for row in noisy], up)
        assert found or "swapped" not in found.reason


def test_positions_with_small_deviations_count_more():
    errors = {False: [], True: []}
    for seed in range(20):
        centers, positions, up, enu = walk(20, 60.0, 4.0, seed)
        for weighted, found in errors.items():
            given = list(positions)
            for k in range(0, 20, 2):  # half of them by RTK
                exact = replace(position_from_enu(enu[k], ORIGIN), deviation_m=0.03 if weighted else None)
                given[k] = exact
            fit = georeference(centers, given, up)
            found.append(abs(np.log(fit.enu_from_world.scale / METRES)))
            assert found[-1] < 5 * fit.scale_deviation + 1e-6
    assert np.median(errors[True]) < 0.1 * np.median(errors[False])


def test_two_exact_positions_among_many_do_not_decide_alone():
    centers, positions, up, _ = walk(12, 60.0, 3.0)
    for k in (0, 1):
        positions[k] = replace(positions[k], deviation_m=0.01)
    assert georeference(centers, positions, up).enu_from_world.scale == pytest.approx(METRES, rel=0.1)
