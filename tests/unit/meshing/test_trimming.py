"""Where a surface is cut, and which gaps are closed."""

import numpy as np
import pytest

from sfm_app.geometry.triangles import areas
from sfm_app.meshing import Support, bridge_gaps, cut, drop_doubtful_parts, smooth_support, trim


def nowhere(surface):
    return np.zeros(len(surface.vertices), bool)


def total(surface):
    return areas(surface.vertices, surface.faces).sum()


def test_the_border_runs_where_the_support_is_zero(sheet):
    surface = sheet(20)

    found = cut(surface, surface.vertices[:, 0] - 7.3 + 0.2 * surface.vertices[:, 1])

    assert total(found) == pytest.approx(20 * (12.7 + 0.2 * 10), rel=1e-9)
    assert (found.vertices[:, 0] + 0.2 * found.vertices[:, 1]).min() == pytest.approx(7.3)
    corners = found.vertices[found.faces]
    assert np.all(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0)


@pytest.mark.parametrize(("value", "share"), [(1.0, 1.0), (-1.0, 0.0), (0.0, 0.0)])
def test_all_or_nothing_stays(sheet, value, share):
    surface = sheet(5)

    assert total(cut(surface, np.full(len(surface.vertices), value))) == pytest.approx(share * total(surface))


@pytest.mark.parametrize(("radius", "closed"), [(2.5, True), (4.5, True), (7.5, False)])
def test_gaps_are_closed_up_to_their_width(sheet, radius, closed):
    surface = sheet(30)
    inside = np.linalg.norm(surface.vertices - [15, 15, 0], axis=1) > radius

    found = bridge_gaps(surface, np.where(inside, 1.0, -1.0), nowhere(surface), 12.0)

    assert np.all(found > 0) == closed
    assert np.all(found[inside] > 0)


def test_long_and_narrow_gaps_are_closed_and_broad_ones_beside_them_stay(sheet):
    surface = sheet(40)
    x, y = surface.vertices[:, 0], surface.vertices[:, 1]
    narrow, broad = (np.abs(x - 5) < 1.5) & (y > 3) & (y < 37), (x > 15) & (x < 35) & (y > 10) & (y < 30)

    found = bridge_gaps(surface, np.where(narrow | broad, -1.0, 1.0), nowhere(surface), 6.0)

    assert np.all(found[narrow] > 0)
    assert np.all(found[broad] < 0)


def test_gaps_that_photos_see_through_stay_open(sheet):
    surface = sheet(20)
    hole = np.linalg.norm(surface.vertices - [10, 10, 0], axis=1) < 2.5

    assert np.all((bridge_gaps(surface, np.where(hole, -1.0, 1.0), hole, 12.0) < 0) == hole)


@pytest.mark.parametrize(("free_rows", "closed"), [(1, True), (5, False)])
def test_a_gap_is_the_way_around_an_edge_where_photos_see_through_a_part_of_it(sheet, free_rows, closed):
    surface = sheet(30)
    y = surface.vertices[:, 1]
    band = (y > 5) & (y < 21)  # 15 rows

    found = bridge_gaps(surface, np.where(band, -1.0, 1.0), band & (y < 5.5 + free_rows), 20.0)

    assert np.all(found[band] > 0) == closed


def test_parts_that_few_photos_confirm_are_dropped(sheet, together):
    surface = together(sheet(9), sheet(4, origin=(50, 0, 0)), sheet(4, origin=(80, 0, 0)))
    x = surface.vertices[:, 0]
    confirmed = np.select([x < 20, x < 60], [3, 2], np.arange(len(x)) % 2 * 3).astype(np.int32)  # 3, 2, 1.5

    found = drop_doubtful_parts(surface, np.ones(len(x)), confirmed, 2.0)

    np.testing.assert_array_equal(found > 0, x < 60)


def test_trimming_keeps_what_is_confirmed_with_its_pinholes_closed(sheet, together):
    surface = together(sheet(40), sheet(6, origin=(60, 0, 0)))
    x, y = surface.vertices[:, 0], surface.vertices[:, 1]
    support = Support.zeros(len(x))
    support.confirmed[(x < 30) | (x > 50)] = 3
    support.confirmed[(np.abs(x - 10) < 1.5) & (np.abs(y - 10) < 1.5)] = 0  # a pinhole
    support.seen_through[x > 50] = 4

    found = trim(surface, support, 12.0, 2.0)

    assert total(found) == pytest.approx(29.5 * 40, rel=0.02)
    assert found.vertices[:, 0].max() < 32


@pytest.mark.parametrize(("empty", "kept"), [(2, 1.0), (5, 1.0), (7, 0.5), (40, 0.5)])
def test_what_most_photos_know_nothing_about_is_dropped_however_many_there_are(sheet, empty, kept):
    surface = sheet(40)
    support = Support.zeros(len(surface.vertices))
    support.confirmed[:] = 2
    support.empty[surface.vertices[:, 0] > 20] = empty

    found = trim(surface, support, 12.0, 1.0)

    assert total(found) == pytest.approx(kept * 40 * 40, rel=0.03)


def test_smoothing_takes_the_teeth_off_a_border_and_keeps_its_place(sheet):
    surface = sheet(40)
    x, y = surface.vertices[:, 0], surface.vertices[:, 1]
    teeth = np.where(y % 4 < 2, 3.0, -3.0)
    support = np.where(x > 20.5 + teeth, 1.0, -1.0)

    found = cut(surface, smooth_support(surface, support, 20))

    border = [found.vertices[np.abs(found.vertices[:, 1] - row) < 0.3, 0].min() for row in range(8, 33)]
    assert np.std(border) < 0.5
    assert abs(np.mean(border) - 20.5) < 1.0
