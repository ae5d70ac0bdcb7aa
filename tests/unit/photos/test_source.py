"""What the user has given, and how a change of it is seen."""

import os
from dataclasses import replace

import pytest

from sfm_app.errors import ConfigError, InputError
from sfm_app.photos.source import read_source
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


def test_a_photo_is_the_same_if_bytes_size_group_and_mask_are(folder, tmp_path):
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "a.png").write_text("mask")
    (tmp_path / "masks" / "b.png").write_text("mask of b")
    source = source_of(folder, tmp_path / "out", masks=str(tmp_path / "masks"))
    used = Photo("a.jpg", 60, 40, "one camera", mask="a.png")

    def hash_of(photo, source=source, masks=None):
        return source.photo_hashes(PhotoSet(folder, (photo,), (), masks))[photo.name]

    before = hash_of(used)
    assert hash_of(replace(used, notes=("read without color",))) == before
    changes = {
        "width": 61,
        "group": "another",
        "mask": "b.png",
        "turn_deg": 90,
        "name": "_a.jpg",
        "shown": (1, 1, 9, 9),
    }
    assert len({hash_of(replace(used, **{key: value})) for key, value in changes.items()} - {before}) == len(changes)
    assert hash_of(used, masks=tmp_path / "masks") != before
    (folder / "a.jpg").write_text("a better photo of the same name")
    assert hash_of(used, source_of(folder, tmp_path / "out", masks=str(tmp_path / "masks"))) != before
