"""Owners of texels, the background, and checkpoints of interrupted textures."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from painted_box import Album, around, assert_same_texture, box
from painted_box import textured as textured_surface

from sfm_app.texture import pages
from sfm_app.texture.pages import fill_background, owners
from sfm_app.texture.sightings import NONE


def test_texels_have_the_same_owners_in_bands():
    rng = np.random.default_rng(2)
    corners = rng.uniform(0, 100, (30, 1, 2)) + rng.uniform(-12, 12, (30, 3, 2))
    triangles = np.arange(30)

    whole = owners((96, 90), triangles, corners)
    with ThreadPoolExecutor(3) as threads:
        in_bands = owners((96, 90), triangles, corners, threads.map, band=16)

    assert 0.1 < np.mean(whole != NONE) < 0.9
    np.testing.assert_array_equal(in_bands, whole)


def test_background_takes_the_color_next_to_it():
    page = np.zeros((64, 48, 3), np.uint8)
    painted = np.zeros((64, 48), bool)
    page[:20, :10], painted[:20, :10] = 200, True
    page[40:, 30:], painted[40:, 30:] = 60, True
    filled = fill_background(page.copy(), painted)
    np.testing.assert_array_equal(filled[painted], page[painted])
    assert (filled[19:22, 9:12] == 200).all()
    assert set(np.unique(filled)) >= {60, 200}
    assert filled.min() >= 60


# Interrupted textures.

VIEWS, BOX = around(6, size=(160, 120)), box(6)
NAMES = [view.name for view in VIEWS]


class Shaky(Album):
    """A store that kills the run after a number of photos."""

    left = len(VIEWS) * 2

    def photo(self, view):
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        return super().photo(view)


def textured(album):
    return textured_surface(album, BOX, VIEWS)


def interrupted_after(photos):
    album = Shaky()
    album.left = photos
    with pytest.raises(KeyboardInterrupt):
        textured(album)
    album.left = len(VIEWS) * 2
    album.read.clear()
    return album


@pytest.fixture(scope="module")
def whole():
    return textured(Album())


@pytest.mark.parametrize(
    ("photos", "options", "rest"),
    [
        (4, {}, [*NAMES[4:], *NAMES]),  # finished scores are kept
        (len(VIEWS) + 2, {"every_s": -1.0, "most_time": np.inf}, NAMES[2:]),  # and painted photos with checkpoints
        (len(VIEWS) + 2, {}, NAMES),  # the first checkpoint comes later
    ],
    ids=["scores", "checkpoints", "no checkpoint"],
)
def test_an_interrupted_texture_resumes(whole, monkeypatch, photos, options, rest):
    monkeypatch.setattr(pages, "CHECKPOINTS", replace(pages.CHECKPOINTS, **options))
    album = interrupted_after(photos)
    assert (pages.CHECKPOINT_NAME in album.kept) == bool(options)

    model, figures = textured(album)

    assert figures == whole[1]
    assert_same_texture(model, whole[0])
    assert album.read == rest


def test_large_pages_are_saved_less_often(monkeypatch):
    clock = iter(range(0, 1000, 20))  # every step takes twenty seconds
    monkeypatch.setattr(pages.time, "monotonic", lambda: float(next(clock)))
    album = Album()
    work = pages.Pages([], 40, album)
    kept_after = []
    for photo in range(40):
        before = album.kept.pop(pages.CHECKPOINT_NAME, None)
        assert before is None or before["has"].sum() == photo
        with work.lock_canvases(photo):
            pass
        kept_after += [photo] if pages.CHECKPOINT_NAME in album.kept else []

    assert kept_after == [0, 20]
