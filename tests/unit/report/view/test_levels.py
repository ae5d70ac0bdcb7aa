"""Points from coarse to fine."""

import numpy as np
import pytest

from sfm_app.report.server import point_levels
from sfm_app.types import Surface


def surface(count):
    places = np.column_stack([np.arange(count), np.zeros(count), np.ones(count)]).astype(float)
    colors = np.column_stack([np.arange(count) % 251, np.zeros(count), np.full(count, 7)]).astype(np.uint8)
    return Surface(places, np.zeros((0, 3), np.int64), colors)


def unpack(data, count):
    return np.frombuffer(data, "<f4", 3 * count).reshape(-1, 3), np.frombuffer(data, np.uint8, offset=12 * count)


def test_levels_have_every_point_once_with_its_color():
    found = point_levels(surface(150), first=20)

    assert found.counts == [20, 40, 80, 10]
    parts = [unpack(found.pack(level), count) for level, count in enumerate(found.counts)]
    x = np.concatenate([places[:, 0] for places, _ in parts])
    colors = np.concatenate([colors.reshape(-1, 3) for _, colors in parts])
    np.testing.assert_array_equal(np.sort(x), np.arange(150))
    np.testing.assert_array_equal(colors[:, 0], x % 251)
    assert (colors[:, 2] == 7).all()


def test_the_first_level_is_spread_over_the_scene():
    found = point_levels(surface(100_000))
    x = unpack(found.pack(0), found.counts[0])[0][:, 0]

    assert abs(x.mean() / 100_000 - 0.5) < 0.02 and x.min() < 100 and x.max() > 99_900


def test_a_level_that_is_not_there_is_an_error_and_no_points_are_no_levels():
    assert point_levels(surface(0)).counts == []
    for level in (-1, 1):
        with pytest.raises(IndexError, match="no level"):
            point_levels(surface(5)).pack(level)
