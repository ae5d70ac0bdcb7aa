"""The user's files and their changes; names and files for COLMAP."""

import os
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from PIL import Image

from sfm_app.errors import ConfigError, InputError
from sfm_app.operating_system import Ability, lacks
from sfm_app.photos.decode import UnreadableError
from sfm_app.photos.source import assign_names, is_laid_out, lay_out, read_source
from sfm_app.settings import PhotoSettings
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
    (tmp_path / "a.mp4").write_bytes(b"\0\0\0\x18ftypisom")
    assert source_of(tmp_path / "a.mp4", tmp_path / "out").video
    with pytest.raises(ConfigError, match="--images"):
        source_of(tmp_path / "a.mp4", tmp_path / "out", images="list.txt")


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
    changes = {"width": 61, "group": "two", "mask": "b.png", "turn_deg": 90, "name": "_a.jpg", "shown": (1, 1, 9, 9)}
    assert len({hash_of(replace(used, **{key: value})) for key, value in changes.items()} - {before}) == len(changes)
    assert hash_of(used, masks=tmp_path / "masks") != before
    (folder / "a.jpg").write_text("a better photo of the same name")
    assert hash_of(used, source_of(folder, tmp_path / "out", masks=str(tmp_path / "masks"))) != before


PIXELS = np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8)


def named(*paths, lossy=True):
    return [photo.name for photo in assign_names([Photo(path, 60, 40, "g", lossy=lossy) for path in paths])]


@pytest.mark.parametrize(
    "path", ["a.jpg", "b.JPEG", "c/d e.png", "\u00fc/\U0001f600.jpg", 'it\'s; "x" & $y.png', "-o.jpg"]
)
def test_names_stay_where_they_can(path):
    assert named(path) == [path]


@pytest.mark.parametrize(
    ("path", "stored"),
    [("a.webp", "a.webp.jpg"), ("b", "b.jpg"), ("line\nbreak.jpg", "line_break.jpg"), ("\x1b[2Jx.png", "_[2Jx.png"),
     ("\udcff.jpg", "_.jpg"), ("e\u202egpj.jpg", "e_gpj.jpg")],
)  # fmt: skip
def test_names_that_colmap_or_a_terminal_cannot_have_are_replaced_and_the_original_is_kept(path, stored):
    (photo,) = assign_names([Photo(path, 60, 40, "g")])
    assert (photo.name, photo.path) == (stored, path)


@pytest.mark.parametrize("letter", ["a", "\u00fc", "\U0001f600"])
def test_long_names_leave_room_for_what_later_stages_append(letter):
    stem = letter * (251 // len(letter.encode()))
    first, second = named(f"sub/{stem}.jpg", f"sub/{stem[:-1]}b.jpg")
    assert first != second and first.startswith(f"sub/{letter}{letter}") and first.endswith(f"{letter}.jpg")
    assert all(190 < len(name.encode()) <= 210 for name in (first, second))


def test_lossless_photos_become_png():
    assert named("a.tif", "b.bmp", lossy=False) == ["a.tif.png", "b.bmp.png"]


def test_names_are_unique_and_differ_by_more_than_capitals():
    found = named("a.webp", "a.webp.jpg", "x\n.jpg", "x\r.jpg", "x_.jpg", "in/a.webp")
    assert len(set(found)) == len(found)
    assert (found[1], found[4]) == ("a.webp.jpg", "x_.jpg")
    assert named("a.jpg", "A.JPG", "_A.JPG", "b.webp", "B.WEBP.jpg") == [
        "a.jpg", "__A.JPG", "_A.JPG", "_b.webp.jpg", "B.WEBP.jpg",
    ]  # fmt: skip
    assert named("in/a.jpg", "In/a.jpg") == ["in/a.jpg", "In/_a.jpg"]


@pytest.mark.parametrize("turn", [90, 180, 270])
def test_a_turned_photo_is_laid_out_as_the_sensor_lay(tmp_path, turn):
    upright = np.rot90(PIXELS, -turn // 90)
    Image.fromarray(np.ascontiguousarray(upright)).save(tmp_path / "x.png")
    lay_out(Photo("x.png", 60, 40, "g", needs_copy=True, lossy=False, turn_deg=turn), tmp_path, tmp_path / "target")
    with Image.open(tmp_path / "target" / "x.png") as seen:
        assert np.array_equal(np.asarray(seen), PIXELS)


def test_without_links_a_photo_is_copied_and_a_changed_copy_is_noticed(tmp_path, without):
    without(Ability.LINKS)
    photos, target, photo = tmp_path / "photos", tmp_path / "target", Photo("in/x.png", 60, 40, "g")
    (photos / "in").mkdir(parents=True)
    Image.fromarray(PIXELS).save(photos / "in/x.png")
    assert not is_laid_out(photo, photos, target)
    lay_out(photo, photos, target)
    place = target / "in/x.png"

    assert not place.is_symlink() and place.read_bytes() == (photos / "in/x.png").read_bytes()
    assert is_laid_out(photo, photos, target)
    place.write_bytes(place.read_bytes() + b"!")
    assert not is_laid_out(photo, photos, target)
    lay_out(photo, photos, target)
    assert is_laid_out(photo, photos, target)
    (photos / "in/x.png").unlink()
    assert not is_laid_out(photo, photos, target)


def test_a_link_to_another_photo_is_not_the_photo(tmp_path):
    for name in ("x.png", "y.png"):
        Image.fromarray(PIXELS).save(tmp_path / name)
    (tmp_path / "target").mkdir()
    (tmp_path / "target" / "x.png").symlink_to(tmp_path / "y.png")
    assert not is_laid_out(Photo("x.png", 60, 40, "g"), tmp_path, tmp_path / "target")


@pytest.mark.parametrize("kind", ["TIFF", "BMP", "WEBP", "PNG"])
def test_colmap_reads_and_writes_what_is_laid_out(tmp_path, kind):
    (tmp_path / "photos" / "in").mkdir(parents=True)
    path = f"in/x.{kind.lower()}"
    Image.fromarray(PIXELS).save(tmp_path / "photos" / path, kind)
    (photo,) = assign_names([Photo(path, 60, 40, "g", needs_copy=kind != "PNG", lossy=kind == "WEBP")])

    lay_out(photo, tmp_path / "photos", tmp_path / "target")

    place = tmp_path / "target" / photo.name
    seen = pycolmap.Bitmap.read(place, as_rgb=True)
    assert np.abs(seen.to_array().astype(int) - PIXELS).mean() < (0.1 if kind != "WEBP" else 60)
    assert seen.write(tmp_path / f"again{place.suffix}")
    assert place.is_symlink() == (kind == "PNG" and not lacks(Ability.LINKS))


def test_large_photos_are_scaled_down(tmp_path):
    Image.fromarray(PIXELS).save(tmp_path / "x.png")
    lay_out(Photo("x.png", 30, 20, "g", needs_copy=True, lossy=False), tmp_path, tmp_path / "target")
    with Image.open(tmp_path / "target" / "x.png") as seen:
        assert seen.size == (30, 20)


def test_a_file_that_went_away_or_led_out(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "x.jpg").symlink_to(tmp_path / "y.jpg")
    for name, reason in (("x.jpg", "a link out of the folder"), ("z.jpg", "missing")):
        with pytest.raises(UnreadableError, match=reason):
            lay_out(Photo(name, 60, 40, "g"), tmp_path / "photos", tmp_path / "target")
