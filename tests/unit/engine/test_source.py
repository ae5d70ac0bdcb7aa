"""What the user has given, and how a change of it is seen."""

import os

import pytest

from sfm_app.engine.source import source_of
from sfm_app.errors import InputError
from sfm_app.types import Photo, PhotoSet


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "photos"
    place.mkdir()
    for name in ("a.jpg", "b.jpg", "notes.txt"):
        (place / name).write_text(name)
    return place


def photos(folder, *names, group=""):
    return PhotoSet(folder, tuple(Photo(name, 60, 40, group) for name in names))


def test_only_photos_that_are_used_matter_to_later_stages(run, folder):
    used = photos(folder, "a.jpg", "b.jpg")
    before = source_of(folder, run)
    (folder / "notes.txt").write_text("something else")
    after = source_of(folder, run)

    assert after.fingerprint != before.fingerprint and after.content(used) == before.content(used)
    assert after.content(photos(folder, "a.jpg", "b.jpg", group="other")) == before.content(used)
    assert after.content(photos(folder, "a.jpg")) != before.content(used)
    (folder / "b.jpg").write_text("another photo")
    assert source_of(folder, run).content(used) != before.content(used)


@pytest.mark.parametrize(("change", "says"), [("unlink", "is gone since"), ("touch", "has changed since")])
def test_photos_that_change_under_a_run_are_seen(run, folder, change, says):
    source, used = source_of(folder, run), photos(folder, "a.jpg", "b.jpg")
    (folder / "notes.txt").write_text("who cares")
    source.check(used)
    if change == "unlink":
        (folder / "a.jpg").unlink()
    else:
        os.utime(folder / "a.jpg", ns=(1, 1))

    with pytest.raises(InputError, match=says):
        source.check(used)
