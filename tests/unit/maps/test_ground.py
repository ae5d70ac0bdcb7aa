"""Bare ground: hills stay, houses and trees go."""

import numpy as np
import pytest

from sfm_app.errors import ConfigError
from sfm_app.frame.scale import MetricFrame
from sfm_app.maps.ground import bare_ground
from sfm_app.maps.products import MapOptions, export_map

PIXEL_M = 0.1
TREES = (((45, 12), 2.0), ((20, 48), 1.2), ((8, 40), 3.0))


def place(side_m=60.0):
    """Coordinates in meters, and gentle hills."""
    y, x = np.mgrid[0.0:side_m:PIXEL_M, 0.0:side_m:PIXEL_M]
    return x, y, (1.5 * np.sin(x / 9.0) * np.cos(y / 11.0) + 0.1 * x).astype(np.float32)


def with_things(x, y, ground):
    """Houses of 3 to 6 m with the sides of a house, one over an edge, and round trees."""
    heights, things = ground.copy(), np.zeros(ground.shape, bool)
    for left, top, wide, deep, tall in ((10, 8, 8, 12, 4), (30, 35, 14, 9, 6), (50, 50, 14, 14, 3)):
        inside = (x > left) & (x < left + wide) & (y > top) & (y < top + deep)
        heights[inside], things = ground[inside].max() + tall, things | inside
    for at, radius in TREES:
        away = np.hypot(x - at[0], y - at[1])
        dome = ground + np.sqrt(np.maximum(radius**2 - away**2, 0.0))
        inside = away < radius
        heights[inside], things = dome[inside], things | inside
    return heights, things


@pytest.mark.parametrize("height_m", [1.0, 0.3048])
def test_houses_and_trees_go_and_hills_stay_in_any_unit(height_m):
    x, y, ground = place()
    ground = ground + np.random.default_rng(0).normal(scale=0.01, size=ground.shape).astype(np.float32)
    heights, things = with_things(x, y, ground)
    found = bare_ground(heights / np.float32(height_m), PIXEL_M, height_m) * height_m
    error = found - ground
    assert np.median(np.abs(heights - ground)[things]) > 3.0 and np.isfinite(found).all()
    assert np.mean(np.abs(error[~things]) < 1e-5) > 0.98  # the surface itself
    trees = np.min([np.hypot(x - at[0], y - at[1]) / radius for at, radius in TREES], axis=0) < 1.0
    assert 0.001 < np.quantile(np.abs(error[trees]), 0.99) < 0.2  # their feet go, too
    assert 0.01 < np.quantile(np.abs(error[things]), 0.9) < 0.5
    assert abs(np.median(error[things])) < 0.05


@pytest.mark.parametrize("height_m", [1.0, 0.3048])
def test_a_slope_without_things_is_left_as_it_is_in_any_unit(height_m):
    x, y, _ = place(40.0)
    slope = ((0.6 * x + 0.2 * y) / height_m).astype(np.float32)
    assert np.array_equal(bare_ground(slope, PIXEL_M, height_m), slope)


def test_holes_of_the_surface_stay_holes():
    x, y, ground = place()
    heights, _ = with_things(x, y, ground)
    heights[40:60, 100:130] = np.nan
    found = bare_ground(heights, PIXEL_M, 1.0)
    assert np.isnan(found[40:60, 100:130]).all() and np.isnan(found).sum() == 600
    assert np.isnan(bare_ground(np.full((30, 40), np.nan, np.float32), PIXEL_M, 1.0)).all()


def test_the_ground_of_a_house_is_flat(make_run, house):
    import rasterio

    out = make_run(MetricFrame(deviation=0.01))
    with rasterio.open(export_map(out, "dsm")[0]) as file:
        surface = file.read(1)
    with rasterio.open(export_map(out, "dtm")[0]) as file:
        ground = file.read(1, masked=True)
    assert surface.max() == pytest.approx(3.0, abs=0.01)
    assert np.abs(ground.compressed()).max() < 0.05 and ground.count() > 0.9 * ground.size


@pytest.mark.parametrize(
    ("product", "options", "words"),
    [
        ("dtm", MapOptions(plane="facade"), "no bare ground"),
        ("dsm", MapOptions(ground=True), "--ground does not apply to dsm"),
        ("dtm", MapOptions(), "needs the size"),
        ("contours", MapOptions(ground=True), "needs the size"),
    ],
)
def test_bare_ground_needs_a_map_and_meters(make_run, product, options, words):
    with pytest.raises(ConfigError, match=words) as error:
        export_map(make_run(), product, options=options)
    assert error.value.hint
