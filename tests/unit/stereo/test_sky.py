"""A sky is at infinity; a plain wall of the same gray is not."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from sfm_app.stereo import View
from sfm_app.stereo.sky import blank_areas, count_votes, find_skies, possible_skies, sky_pixels, spread_partners

WIDTH, HEIGHT, FOCAL = 640, 480, 500.0
SIDEWAYS = np.linspace(-2.0, 2.0, 6)


@dataclass(frozen=True)
class Photo:
    view: View
    gray: np.ndarray
    depth: np.ndarray
    blank: np.ndarray
    """(H, W) sky or plain wall, without a depth."""


def view_from(x):
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    return View(f"{x:.2f}", K, np.column_stack([np.eye(3), [-x, 0, 0]]), WIDTH, HEIGHT)


def photograph(x, gray_of_blank, backdrop):
    """Return a photo from (x, 0, 0): a textured ground, a textured tower, and a backdrop."""
    view = view_from(x)
    K = view.K
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    ray = np.stack([(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL])
    with np.errstate(divide="ignore"):
        ground = np.where(ray[1] > 0, 1.5 / ray[1], np.inf)
    at = x + 6.0 * ray[0]
    tower = np.where((np.abs(at - 0.5) < 0.8) & (6.0 * ray[1] > -1.2), 6.0, np.inf)
    behind = backdrop(x, ray)
    depth = np.minimum(np.minimum(ground, tower), behind)
    blank = ~np.isfinite(depth)
    rng = np.random.default_rng(3)
    shown = np.where(blank, gray_of_blank, rng.uniform(20, 160, depth.shape)) + rng.normal(0, 1.5, depth.shape)
    return Photo(view, shown.clip(0, 255).astype(np.uint8), np.where(blank, 0, depth).astype(np.float32), blank)


def sky(x, ray):
    return np.full(ray.shape[1:], np.inf)


def plain_wall(x, ray, width=3.0):
    """A wall 8 away, textured but for a part."""
    return np.where(np.abs(x + 8.0 * ray[0]) < 0.5 * width, np.inf, 8.0)


def plain_panel(x, ray):
    """The same with a part that moves by its width from photo to photo."""
    return plain_wall(x, ray, width=0.8)


def photograph_all(gray_of_blank, backdrop=sky):
    return [photograph(x, gray_of_blank, backdrop) for x in SIDEWAYS]


def areas_of(photos):
    """Return the blank areas of all photos, and the votes about them."""
    areas = [blank_areas(photo.gray, photo.depth) for photo in photos]
    views = [photo.view for photo in photos]
    return areas, [count_votes(areas, views, index) for index in range(len(views))]


def skies_of(photos):
    cells = find_skies(*areas_of(photos))
    return [sky_pixels(photo.gray, own) for photo, own in zip(photos, cells, strict=True)]


@pytest.mark.parametrize("gray", [200.0, 250.0])
def test_a_sky_is_found_up_to_its_outlines(gray):
    photos = photograph_all(gray)

    for photo, found in zip(photos, skies_of(photos), strict=True):
        assert found[photo.blank].mean() > 0.98
        inside = cv2.erode((~photo.blank).view(np.uint8), np.ones((5, 5))) > 0  # but for the blur of outlines
        assert found[inside].mean() < 0.002


PALING = 130.0 + 0.5 * np.mgrid[:HEIGHT, :WIDTH][0]
"""A sky that is paler at the horizon."""


@pytest.mark.parametrize("gray", [220.0, PALING], ids=["even", "paling"])
def test_depths_extended_into_the_sky_are_sky(gray):
    photos = photograph_all(gray)
    rims = [photo.blank & (cv2.dilate((~photo.blank).view(np.uint8), np.ones((13, 13))) > 0) for photo in photos]
    extended = [
        replace(one, depth=np.where(rim, np.float32(6), one.depth)) for one, rim in zip(photos, rims, strict=True)
    ]

    for photo, rim, found in zip(photos, rims, skies_of(extended), strict=True):
        mixed = cv2.dilate((~photo.blank).view(np.uint8), np.ones((3, 3))) > 0  # outlines are decided later
        assert found[rim & ~mixed].mean() > 0.98


def test_only_what_is_near_the_sky_and_of_its_gray_is_sky():
    gray, cells = np.full((HEIGHT, WIDTH), 100, np.uint8), np.zeros((96, 128), bool)
    gray[:205], gray[205:215], gray[400:420] = 200, 208, 200  # a sky, the roof before it, and a puddle
    cells[:40] = True

    found = sky_pixels(gray, cells)

    assert found[:204].all() and not found[206:].any()


def test_a_plain_wall_and_a_dark_background_are_no_sky():
    photos = photograph_all(220.0, plain_wall)

    assert all(blank_areas(photo.gray, photo.depth).blank.any() for photo in photos)
    assert not any(found.any() for found in skies_of(photos))
    assert not any(found.any() for found in skies_of(photograph_all(10.0)))


def photograph_window():
    """Photos of a tower with a window as bright as the sky, whose direction changes from photo to photo."""
    walled = []
    for photo in photograph_all(230.0):
        at = photo.view.center[0] + 6.0 * (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
        window = np.zeros_like(photo.blank)
        window[240:330] = np.abs(at - 0.5) < 0.5
        gray = np.where(window, 226, photo.gray).astype(np.uint8)
        walled.append((replace(photo, gray=gray, depth=np.where(window, np.float32(0), photo.depth)), window))
    return walled


def test_a_wall_stays_in_a_scene_with_a_sky():
    walled = photograph_window()

    for (photo, window), own in zip(walled, skies_of([photo for photo, _ in walled]), strict=True):
        assert own[photo.blank].mean() > 0.98
        assert own[window].mean() < 0.05


def test_any_blank_area_may_be_the_sky_in_a_scene_that_may_have_one():
    areas, votes = areas_of([photo for photo, _ in photograph_window()])

    assert max(one.labels.max() for one in areas) > 1  # the window is an area of its own
    for one, found in zip(areas, possible_skies(areas, votes), strict=True):
        np.testing.assert_array_equal(found, one.blank)


@pytest.mark.parametrize(("backdrop", "possible"), [(sky, True), (plain_panel, False)])
def test_a_sky_is_possible_where_other_photos_show_nothing_in_that_direction(backdrop, possible):
    areas, votes = areas_of(photograph_all(220.0, backdrop))

    for one, found in zip(areas, possible_skies(areas, votes), strict=True):
        assert one.blank.mean() > 0.01
        assert found[one.blank].mean() == pytest.approx(float(possible), abs=0.05)
        assert not found[~one.blank].any()


def test_a_blank_area_that_no_other_photo_shows_may_be_the_sky():
    areas, votes = areas_of([photograph(0.0, 220.0, sky)])

    np.testing.assert_array_equal(possible_skies(areas, votes)[0], areas[0].blank)


def test_one_photo_does_not_vote_about_itself():
    photo = photograph(0.0, 220.0, sky)

    assert not skies_of([photo])[0].any()
    assert spread_partners([photo.view, photo.view], 0) == []  # of the same place
    assert find_skies([], []) == []


def test_partners_are_near_and_far():
    partners = spread_partners([view_from(x) for x in np.linspace(0, 5, 40)], 0)

    assert len(partners) == len(set(partners)) == 16
    assert partners[0] == 1
    assert partners[-1] == 39
