"""A texture that is interrupted and goes on."""

import numpy as np
import pytest
from painted_box import Album, around, box, one_by_one

from sfm_app.meshing.ray_casting import Occluders
from sfm_app.settings import TextureSettings
from sfm_app.texture import pages, texture_surface

VIEWS, BOX = around(6, size=(160, 120)), box(6)
NAMES = [view.name for view in VIEWS]


class Shaky(Album):
    """Lets nothing more be read after so many photos."""

    left = len(VIEWS) * 2

    def photo(self, view):
        if self.left == 0:
            raise KeyboardInterrupt
        self.left -= 1
        return super().photo(view)


def textured(album):
    hidden = Occluders(BOX.vertices, BOX.faces).is_hidden
    return texture_surface(BOX, VIEWS, album, hidden, TextureSettings(), one_by_one)


def interrupted_after(photos):
    album = Shaky()
    album.left = photos
    with pytest.raises(KeyboardInterrupt):
        textured(album)
    album.left = len(VIEWS) * 2
    album.asked.clear()
    return album


@pytest.fixture(scope="module")
def whole():
    return textured(Album())


def same(found, expected):
    (model, figures), (other, others) = found, expected
    assert figures == others
    np.testing.assert_array_equal(model.texture.uv, other.texture.uv)
    np.testing.assert_array_equal(model.surface.colors, other.surface.colors)
    for ours, theirs in zip(model.texture.pages, other.texture.pages, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_photos_are_looked_at_once(whole):
    album = interrupted_after(4)

    same(textured(album), whole)

    assert album.asked == [*NAMES[4:], *NAMES]


def test_photos_are_painted_once(whole, monkeypatch):
    monkeypatch.setattr(pages, "EVERY_S", -1.0)
    monkeypatch.setattr(pages, "MOST_OF_THE_TIME", np.inf)
    album = interrupted_after(len(VIEWS) + 2)

    same(textured(album), whole)

    assert album.asked == NAMES[2:]


def test_pages_are_kept_now_and_then_only(whole):
    album = interrupted_after(len(VIEWS) + 2)
    assert pages.GROUP_NAME not in album.kept

    same(textured(album), whole)

    assert album.asked == NAMES


def test_large_pages_are_kept_less_often(monkeypatch):
    clock = iter(range(0, 1000, 20))  # whatever is done takes twenty seconds
    monkeypatch.setattr(pages.time, "monotonic", lambda: float(next(clock)))
    album = Album()
    work = pages.Pages([], 40, album)
    kept_after = []
    for photo in range(40):
        before = album.kept.pop(pages.GROUP_NAME, None)
        assert before is None or before["has"].sum() == photo
        with work.lock_canvases(photo):
            pass
        kept_after += [photo] if pages.GROUP_NAME in album.kept else []

    assert kept_after == [0, 20]
