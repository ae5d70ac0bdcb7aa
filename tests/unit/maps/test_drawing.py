"""Tiles, samples and sections, on triangles by hand."""

import numpy as np
import pytest

from sfm_app.errors import InputError
from sfm_app.maps import drawing
from sfm_app.maps.drawing import cover, cut_front, draw_tiles, facing_corners, rays_per_pixel, texel_size
from sfm_app.synthetic.shapes import grid
from tests.unit.maps.conftest import HALF, PAGE


def plan(model):
    """The house from above: corners, pages of the triangles, pages."""
    x, y, z = model.surface.vertices.T
    points = np.column_stack([x, -z, y])
    return *facing_corners(points, model.surface.faces, model.texture), model.texture.pages


def picture(model, resolution, rays):
    """Colors and heights of all tiles together, and how many tiles there were."""
    corners, page, pages = plan(model)
    grid = cover(corners, resolution)
    colors, heights = np.zeros((grid.height, grid.width, 4), np.uint8), np.full((grid.height, grid.width), np.nan)
    tiles = list(draw_tiles(corners, page, pages, grid, rays))
    for tile in tiles:
        place = slice(tile.row, tile.row + len(tile.heights)), slice(tile.column, tile.column + tile.heights.shape[1])
        colors[place], heights[place] = tile.colors, tile.heights
    return colors, heights, len(tiles)


def test_tiles_do_not_change_the_picture(house, monkeypatch):
    whole = picture(house, 0.0713, 3)
    monkeypatch.setattr(drawing, "FINE_PX", 3 * 37)
    parts = picture(house, 0.0713, 3)
    assert whole[2] == 1 and parts[2] == 16
    assert np.abs(whole[0].astype(int) - parts[0]).max() <= 1  # rounding
    np.testing.assert_allclose(parts[1], whole[1], atol=1e-6)


def test_small_triangles_at_borders_of_tiles_belong_to_both(monkeypatch):
    """A slope of triangles of a third of a pixel: heights are linear everywhere, with one sample and with three."""
    steps = np.arange(0.0, 12.01, 1.0 / 3.0)
    flat, faces = grid(steps, steps)
    points = np.column_stack([flat, 2.0 * flat[:, 0] - flat[:, 1] + 50.0])
    corners = np.concatenate([points[faces], np.zeros((len(faces), 3, 2))], axis=2)
    if area(corners)[0] < 0.0:
        corners = corners[:, ::-1]
    x, y = np.meshgrid(np.arange(12) + 0.5, 11.5 - np.arange(12))
    for rays in (1, 3):
        monkeypatch.setattr(drawing, "FINE_PX", 5 * rays)
        whole = np.full((12, 12), np.nan)
        for tile in draw_tiles(corners, np.zeros(len(faces), np.int32), (), cover(corners, 1.0), rays):
            whole[tile.row : tile.row + 5, tile.column : tile.column + 5] = tile.heights
        np.testing.assert_allclose(whole, 2.0 * x - y + 50.0, atol=1e-4)


def test_tiles_without_triangles_are_not_drawn(house):
    corners, page, pages = plan(house)
    far = corners + np.array([1000.0, 0.0, 0.0, 0.0, 0.0])
    both = np.concatenate([corners, far])
    grid = cover(both, 0.1)
    tiles = list(draw_tiles(both, np.concatenate([page, page]), pages, grid, 3))
    assert grid.width == 10_080 and len(tiles) == 2


def test_a_coarse_pixel_is_the_mean_of_its_texels(house):
    """Two of sixteen columns of texels, those in the middle of a pixel, are white."""
    stripes = np.zeros((PAGE, PAGE, 3), np.uint8)
    stripes[:, 7::16] = stripes[:, 8::16] = 255
    corners, page, _ = plan(house)
    texel, resolution = 2.0 * HALF / PAGE, 0.5
    rays = rays_per_pixel(resolution, texel)
    assert rays == 17
    (tile,) = draw_tiles(corners, page, (stripes,) * 3, cover(corners, resolution), rays)
    assert tile.colors.shape == (16, 16, 4) and np.abs(tile.colors[:, :, :3] - 31.9).max() < 4
    (tile,) = draw_tiles(corners, page, (stripes,) * 3, cover(corners, resolution), 3)
    assert np.abs(tile.colors[:, :, :3] - 31.9).max() > 40  # three samples miss texels


def test_an_odd_number_of_samples_one_in_the_middle():
    assert [rays_per_pixel(size, 1.0) for size in (0.1, 1.0, 2.5, 3.1, 7.0, 8.0)] == [3, 3, 5, 5, 9, 9]
    assert rays_per_pixel(1e9, 1.0) == drawing.FINE_PX and rays_per_pixel(1.0, 0.0) == 3


def test_backs_show_what_lies_behind_them(house):
    """The roof turned over lets the ground be seen."""
    corners, page, pages = plan(house)
    assert len(corners) == 4  # ground and roof, no walls
    x, y, z = house.surface.vertices.T
    faces = house.surface.faces.copy()
    faces[2:4] = faces[2:4, ::-1]
    turned, page = facing_corners(np.column_stack([x, -z, y]), faces, house.texture)
    (tile,) = draw_tiles(turned, page, pages, cover(turned, 0.1), 3)
    assert np.nanmax(tile.heights) == pytest.approx(0.0, abs=1e-6) and (tile.colors[:, :, 3] == 255).all()


def test_texels_are_measured_where_most_of_the_picture_is(house):
    corners, page, _ = plan(house)
    assert texel_size(corners, page, house.texture) == pytest.approx(2.0 * HALF / PAGE)
    finer = corners.copy()
    finer[page == 1, :, 3:] *= 8.0
    assert texel_size(finer, page, house.texture) == pytest.approx(2.0 * HALF / PAGE)
    narrow = corners.copy()
    narrow[page == 1, :, 3:] = 0.5  # a roof without a photo has one color
    assert texel_size(narrow, page, house.texture) == pytest.approx(2.0 * HALF / PAGE)


def test_a_grid_begins_at_whole_pixels_and_contains_all(house):
    corners, _, _ = plan(house)
    moved = corners + np.array([3.217, -1.113, 0.0, 0.0, 0.0])
    grid = cover(moved, 0.3)
    assert grid.left / 0.3 == pytest.approx(round(grid.left / 0.3)) and grid.top / 0.3 == pytest.approx(
        round(grid.top / 0.3)
    )
    assert 0.0 <= moved[:, :, 0].min() - grid.left < 0.3 and 0.0 <= grid.top - moved[:, :, 1].max() < 0.3
    assert 0.0 <= grid.left + grid.width * 0.3 - moved[:, :, 0].max() < 0.3
    assert 0.0 <= moved[:, :, 1].min() - (grid.top - grid.height * 0.3) < 0.3
    for resolution in (1e-6, np.nan):
        with pytest.raises(InputError, match="raster"):
            cover(moved, resolution)


def area(corners):
    a, b = corners[:, 1, :2] - corners[:, 0, :2], corners[:, 2, :2] - corners[:, 0, :2]
    return 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def test_cutting_keeps_what_is_behind_with_its_texture():
    """Triangles whose height is that of a slope 2 x + y - 0.5: the parts below 0, u = x and v = y."""
    rng = np.random.default_rng(3)
    flat = rng.uniform(-1.0, 1.0, (500, 3, 2))
    flip = area(flat) < 0.0
    flat[flip] = flat[flip][:, ::-1]
    heights = 2.0 * flat[:, :, :1] + flat[:, :, 1:] - 0.5
    corners = np.concatenate([flat, heights, flat], axis=2)
    page = np.arange(500, dtype=np.int32)
    cut, pages = cut_front(corners, page)
    assert cut[:, :, 2].max() < 1e-12 and (area(cut) > -1e-12).all() and len(cut) == len(pages)
    np.testing.assert_allclose(cut[:, :, 3:], cut[:, :, :2], atol=1e-12)
    np.testing.assert_allclose(cut[:, :, 2], 2.0 * cut[:, :, 0] + cut[:, :, 1] - 0.5, atol=1e-12)
    front, _ = cut_front(corners * [1.0, 1.0, -1.0, 1.0, 1.0], page)
    behind_area = np.bincount(pages, area(cut), 500)
    front_area = area(front).sum()
    assert behind_area.sum() + front_area == pytest.approx(area(corners).sum())
    assert behind_area.sum() > 0.3 * area(corners).sum() and front_area > 0.3 * area(corners).sum()
    whole = (heights < 0.0).all(axis=(1, 2))
    np.testing.assert_allclose(behind_area[whole], area(corners)[whole])
    assert (behind_area <= area(corners) + 1e-12).all()
