from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from sfm_app.errors import InputError
from sfm_app.photos.masks import read_mask
from sfm_app.photos.probe import read_photo
from sfm_app.photos.source import read_source
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages import photos


def pixels(seed=0):
    """A picture of its own; the upper half is dark, so that turning shows."""
    found = np.random.default_rng(seed).integers(0, 255, (96, 128, 3), np.uint8)
    found[:48] //= 3
    return found


PIXELS = pixels()


@pytest.fixture
def run(tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.create()
    with make_executor(2) as executor:
        yield RunContext(Settings(), workspace, load_plugins(installed=False), executor, 2)


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "photos"
    place.mkdir()
    for seed, name in enumerate(("a.jpg", "b.png"), start=1):
        Image.fromarray(pixels(seed)).save(place / name)
    return place


def source_of(folder, run):
    return read_source(folder, run.workspace.root, run.settings.photos, map)


def make(folder, run):
    return photos.make(source_of(folder, run), run)


def load(folder, run):
    return photos.load(source_of(folder, run), run)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_camera_that_was_turned_keeps_its_layout_and_mirrors_are_undone(folder, run, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(PIXELS).save(folder / "turned.png", exif=exif)

    photo = next(photo for photo in make(folder, run).photos if photo.name == "turned.png")
    seen = Image.open(run.workspace.photos / "turned.png")
    seen.load()

    assert (photo.width, photo.height) == seen.size == (128, 96)
    assert photo.turn_deg == {3: 180, 6: 90, 8: 270}.get(orientation, 90 if orientation in (5, 7) else 0)
    assert seen.getexif().get(0x0112, 1) == 1
    assert photo.needs_copy == (orientation != 1)
    upright = {2: PIXELS[:, ::-1], 4: PIXELS[::-1], 5: PIXELS.swapaxes(0, 1), 7: np.rot90(PIXELS, 2).swapaxes(0, 1)}
    expected = np.rot90(upright.get(orientation, PIXELS), orientation in (5, 7))  # these two lie as the others then
    assert np.array_equal(np.asarray(seen), expected)


def test_photos_of_one_size_share_a_camera_unless_exif_tells_them_apart(folder, run):
    Image.fromarray(PIXELS[:, :100]).save(folder / "c.jpg")
    exif = Image.Exif()
    exif[0x0110] = "Box Brownie"
    Image.fromarray(PIXELS).save(folder / "d.jpg", exif=exif)
    groups = make(folder, run).groups
    names = [[photo.name for photo in members] for members in groups.values()]
    assert names == [["a.jpg", "b.png"], ["c.jpg"], ["d.jpg"]]


def test_bars_around_a_picture_are_seen_and_read_back(folder, run):
    within = np.zeros((240, 320, 3), np.uint8)
    within[30:210] = np.random.default_rng(5).integers(60, 255, (180, 320, 3))
    Image.fromarray(within).save(folder / "barred.png")
    found = {photo.name: photo for photo in make(folder, run).photos}
    assert found["barred.png"].shown == (0, 30, 320, 180)
    assert found["barred.png"].group == "320x180 in 320x240"
    assert {photo.shown for name, photo in found.items() if name != "barred.png"} == {None}
    assert {photo.name: photo for photo in load(folder, run).photos} == found


def test_exif_focal_is_read_as_a_hint_in_pixels(folder, run):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 27
    Image.fromarray(PIXELS).save(folder / "e.jpg", exif=exif)
    photo = next(photo for photo in make(folder, run).photos if photo.name == "e.jpg")
    assert photo.prior.focal_px == pytest.approx(27 / 36 * 128)


def with_gps(folder, **entries):
    """A photo whose EXIF has these GPS entries on top of sound ones; None takes one away."""
    tags = {"lat_ref": 1, "lat": 2, "lon_ref": 3, "lon": 4, "alt_ref": 5, "alt": 6}
    sound = dict(zip(tags, ("S", (33.0, 51.0, 24.5), "E", (151.0, 12.0, 54.25), b"\x00", 7.5), strict=True))
    exif = Image.Exif()
    exif.get_ifd(0x8825).update({tags[name]: value for name, value in (sound | entries).items() if value is not None})
    Image.fromarray(PIXELS).save(folder / "where.jpg", exif=exif)


def read_gps(folder, run):
    found = make(folder, run)
    assert load(folder, run) == found
    return next(photo.gps for photo in found.photos if photo.name == "where.jpg")


def test_gps_is_read_as_a_hint(folder, run):
    with_gps(folder)
    gps = read_gps(folder, run)
    assert gps.latitude_deg == pytest.approx(-(33 + 51 / 60 + 24.5 / 3600), abs=1e-6)
    assert gps.longitude_deg == pytest.approx(151 + 12 / 60 + 54.25 / 3600, abs=1e-6)
    assert gps.altitude_m == pytest.approx(7.5)
    assert run.statistics["gps"] == 1


@pytest.mark.parametrize(
    ("entries", "altitude_m"),
    [({"alt": None}, None), ({"alt_ref": b"\x01"}, -7.5), ({"alt": 90_000.0}, None), ({"alt_ref": None}, 7.5)],
)
def test_altitude_is_optional(folder, run, entries, altitude_m):
    with_gps(folder, **entries)
    assert read_gps(folder, run).altitude_m == altitude_m


@pytest.mark.parametrize(
    "entries",
    [{"lat": None}, {"lon_ref": None}, {"lat_ref": "X"}, {"lat": (91.0, 0.0, 0.0)}, {"lon": (180.0, 30.0, 0.0)},
     {"lat": (33.0, 75.0, 0.0)}, {"lat": (33.0, 51.0)}, {"lat": (IFDRational(33, 0), 51.0, 0.0)},
     {"lat": (0.0, 0.0, 0.0), "lon": (0.0, 0.0, 0.0)}],
)  # fmt: skip
def test_a_position_that_cannot_be_true_is_none(folder, run, entries):
    with_gps(folder, **entries)
    assert read_gps(folder, run) is None


def test_photos_too_large_for_the_memory_are_scaled_down_and_say_so(folder, run):
    run = replace(run, settings=Settings.from_mapping({"max_memory_gb": 1}))
    Image.fromarray(np.tile(PIXELS, (20, 14, 1))).save(folder / "large.jpg", quality=50)
    photo = next(photo for photo in make(folder, run).photos if photo.name == "large.jpg")
    assert 1.9e6 < photo.width * photo.height <= 2e6
    assert photo.notes == (f"scaled down from 1792 x 1920 to {photo.width} x {photo.height} pixels",)


def test_photos_that_came_later_are_read_and_known_ones_are_not_decoded_again(folder, run, monkeypatch):
    make(folder, run)
    Image.fromarray(pixels(3)).save(folder / "c.jpg")
    Image.fromarray(pixels(4)).save(folder / "b.png")
    read = []
    monkeypatch.setattr(
        photos, "read_photo", lambda place, name, options: read.append(name) or read_photo(place, name, options=options)
    )

    found = make(folder, run)

    assert sorted(read) == ["b.png", "c.jpg"]
    run.workspace.photo_stats.unlink()
    assert make(folder, run) == found


@pytest.mark.parametrize(("limit", "told"), [(1, ["2 files: if this is not the folder"]), (2, [])])
def test_a_folder_of_very_many_files_may_be_another_than_meant(folder, run, monkeypatch, limit, told):
    said = []
    monkeypatch.setattr(photos, "MANY_FILES", limit)
    monkeypatch.setattr(run.progress, "say", said.append)
    make(folder, run)
    assert [line[: len(told[0])] for line in said] == told if told else said == []


VISIBLE = np.zeros((96, 128), bool)
VISIBLE[20:80, 30:100] = True


def cut_out(kind):
    alpha = Image.fromarray(np.where(VISIBLE, np.uint8(255), np.uint8(30)))
    image = Image.fromarray(PIXELS).convert("L" if kind == "LA" else "RGB")
    if kind == "palette":
        pixels = np.where(VISIBLE, np.asarray(image.quantize(100)) + 1, 0).astype(np.uint8)
        colors = image.quantize(100).getpalette()
        image = Image.fromarray(pixels, "P")
        image.putpalette([9, 9, 9, *colors])
        image.info["transparency"] = 0
    elif kind == "color":
        image.paste((1, 2, 3), mask=Image.fromarray(~VISIBLE))
        image.info["transparency"] = (1, 2, 3)
    else:
        image.putalpha(alpha)
    return image


def laid_mask(run, name):
    return read_mask(run.workspace.masks, name)


@pytest.mark.parametrize("kind", ["RGBA", "LA", "palette", "color"])
def test_transparent_pixels_are_masked_in_all_later_stages(folder, run, kind):
    assert run.mask_dir is None
    cut_out(kind).save(folder / "c.png")
    found = make(folder, run)
    assert [photo.cut_out for photo in found.photos] == [False, False, True]
    assert run.mask_dir == run.workspace.masks
    assert np.array_equal(laid_mask(run, "c.png"), VISIBLE) and laid_mask(run, "a.jpg").all()
    with Image.open(run.workspace.photos / "c.png") as laid:
        assert laid.mode == "RGB"
    (run.workspace.masks / "c.png.png").unlink()
    assert load(folder, run) == found
    assert np.array_equal(laid_mask(run, "c.png"), VISIBLE)
    (folder / "c.png").unlink()
    make(folder, run)
    assert run.mask_dir is None


@pytest.mark.parametrize("orientation", [1, 3, 6, 7])
def test_transparent_pixels_of_turned_photos_lie_on_the_laid_out_photo(folder, run, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    pixels = np.full((96, 128, 4), np.uint8(255))
    pixels[..., 3] = np.where(VISIBLE, 255, 0)
    pixels[20:40, 30:50, :3] = 90
    image = Image.fromarray(pixels)
    image.save(folder / "c.png", exif=exif)
    photo = next(photo for photo in make(folder, run).photos if photo.name == "c.png")
    mask = laid_mask(run, "c.png")
    laid = np.asarray(Image.open(run.workspace.photos / "c.png"))[..., 0]
    assert mask.shape == laid.shape == (photo.height, photo.width) and mask.sum() == VISIBLE.sum()
    rows, columns = np.nonzero(mask)
    corners = [laid[y, x] for y in (rows.min(), rows.max()) for x in (columns.min(), columns.max())]
    assert sorted(corners) == [90, 255, 255, 255]


def test_a_mask_and_transparent_pixels_both_hold(folder, run, tmp_path):
    cut_out("RGBA").save(folder / "c.png")
    upper = np.zeros((96, 128), np.uint8)
    upper[:50] = 255
    (tmp_path / "masks").mkdir()
    Image.fromarray(upper).save(tmp_path / "masks" / "c.png")
    run = replace(run, settings=Settings.from_mapping({"photos": {"masks": str(tmp_path / "masks")}}))
    make(folder, run)
    assert np.array_equal(laid_mask(run, "c.png"), VISIBLE & (upper > 0))


def test_a_photo_that_is_transparent_all_over_is_left_out(folder, run):
    Image.new("RGBA", (128, 96), (9, 9, 9, 0)).save(folder / "c.png")
    assert {one.name: one.reason for one in make(folder, run).unusable} == {"c.png": "transparent all over"}


def with_masks(run, place):
    return replace(run, settings=Settings.from_mapping({"photos": {"masks": str(place)}}))


@pytest.mark.parametrize("place", ["mask.png", "photos/mask.png", "a.png"])
def test_one_file_masks_all_photos(folder, run, tmp_path, place):
    upper = np.zeros((96, 128), np.uint8)
    upper[:50] = 255
    Image.fromarray(upper).save(tmp_path / place)
    found = make(folder, run := with_masks(run, tmp_path / place))
    assert [photo.name for photo in found.photos] == ["a.jpg", "b.png"]
    for photo in found.photos:
        assert np.array_equal(laid_mask(run, photo.name), upper > 0)
    assert run.statistics["masks"] == {"photos": 2, "unused": []}
    assert load(folder, run).photos == found.photos


def test_masks_that_hide_nothing_are_named_and_black_ones_give_one_reason(folder, run, tmp_path):
    (tmp_path / "masks").mkdir()
    for name, level in (("a.png", 255), ("b.png", 255)):
        Image.new("L", (128, 96), level).save(tmp_path / "masks" / name)
    run = with_masks(run, tmp_path / "masks")
    make(folder, run)
    assert run.statistics["masks"] == {"photos": 2, "unused": [], "white": ["a.jpg", "b.png"]}
    for name in ("a.png", "b.png"):
        Image.new("L", (128, 96)).save(tmp_path / "masks" / name)
    with pytest.raises(InputError, match=r"^no usable photo in .*: 2 its mask is all black$"):
        make(folder, run)


def test_names_of_a_list_that_are_not_there_are_named(folder, run, tmp_path):
    (tmp_path / "list.txt").write_text("no.jpg\nnone.jpg\n")
    run = replace(run, settings=Settings.from_mapping({"photos": {"images": str(tmp_path / "list.txt")}}))
    with pytest.raises(InputError, match=r"^no usable photo in .*: 2 missing, such as no.jpg$"):
        make(folder, run)
