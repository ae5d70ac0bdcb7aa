"""What the user has given, and how a change of it is seen."""

import os
from dataclasses import replace

import pytest

from sfm_app.errors import ConfigError, InputError
from sfm_app.photos import read_source
from sfm_app.settings import PhotoSettings, Settings
from sfm_app.types import Photo, PhotoSet


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "photos"
    place.mkdir()
    for name in ("a.jpg", "b.jpg", "notes.txt"):
        (place / name).write_text(name)
    return place


def source_of(path, out, **options):
    return read_source(path, out, PhotoSettings(**options), map)


def photos(folder, *names, group=""):
    return PhotoSet(folder, tuple(Photo(name, 60, 40, group) for name in names))


def test_only_photos_that_are_used_matter_to_later_stages(folder, tmp_path):
    used = photos(folder, "a.jpg", "b.jpg")
    before = source_of(folder, tmp_path / "out")
    (folder / "notes.txt").write_text("something else")
    after = source_of(folder, tmp_path / "out")

    assert after.fingerprint != before.fingerprint and after.content_hash(used) == before.content_hash(used)
    assert after.content_hash(photos(folder, "a.jpg", "b.jpg", group="other")) == before.content_hash(used)
    assert after.content_hash(photos(folder, "a.jpg")) != before.content_hash(used)
    (folder / "b.jpg").write_text("another photo")
    assert source_of(folder, tmp_path / "out").content_hash(used) != before.content_hash(used)


@pytest.mark.parametrize(("change", "says"), [("unlink", "is gone since"), ("touch", "has changed since")])
def test_photos_that_change_under_a_run_are_seen(folder, tmp_path, change, says):
    source, used = source_of(folder, tmp_path / "out"), photos(folder, "a.jpg", "b.jpg")
    (folder / "notes.txt").write_text("who cares")
    source.check(used)
    if change == "unlink":
        (folder / "a.jpg").unlink()
    else:
        os.utime(folder / "a.jpg", ns=(1, 1))

    with pytest.raises(InputError, match=says):
        source.check(used)


def test_a_video_has_no_list_of_photos(folder, tmp_path):
    photos = source_of(folder, tmp_path / "out")
    listed = Settings.from_mapping({"photos": {"images": "list.txt"}})

    photos.check_settings(listed)
    replace(photos, video=True).check_settings(Settings())
    with pytest.raises(ConfigError, match="--images"):
        replace(photos, video=True).check_settings(listed)
