"""Panoramas are recognized by what their files or their pixels say; nothing else is taken for one."""

import numpy as np
import pytest
from PIL import Image

from sfm_app.photos.decode import UnreadableError, read_picture, upright_image
from sfm_app.photos.panoramas import looks_like_panorama, is_panorama, read_panorama_entries
from sfm_app.synthetic.cameras import Views, look_at, panorama_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder
from sfm_app.synthetic.scenes import courtyard

XMP = b"<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:Description %s/></x:xmpmeta>"


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """A panorama of the court."""
    folder = tmp_path_factory.mktemp("panorama")
    views = Views.from_poses(panorama_camera(512), [look_at(np.array([0.3, 1.6, 3.0]), np.array([1.0, 1.6, 0.0]))])
    write_photo_folder(folder, courtyard(), views, PhotoOptions(supersampling=1))
    return Image.open(next(folder.glob("*.jpg"))).convert("RGB")


def saved(folder, image, **entries):
    path = folder / "photo.jpg"
    said = b" ".join(b'GPano:%s="%s"' % (name.encode(), str(value).encode()) for name, value in entries.items())
    image.save(path, xmp=XMP % said) if entries else image.save(path)
    return read_picture(path)


def asked(picture):
    return is_panorama(picture, upright_image(picture))


def test_a_panorama_is_recognized_by_its_pixels(rendered, tmp_path):
    assert asked(saved(tmp_path, rendered))


@pytest.mark.parametrize("turn_deg", [90, 200])
def test_its_heading_does_not_matter(rendered, turn_deg):
    pixels = np.roll(np.asarray(rendered), turn_deg * 512 // 360, axis=1)

    assert looks_like_panorama(Image.fromarray(pixels))


def test_parts_and_mirrored_pictures_are_none(rendered):
    pixels = np.asarray(rendered)
    part = Image.fromarray(pixels[64:192, 100:356])
    mirrored = Image.fromarray(np.hstack([pixels[:, :256], pixels[:, 255::-1]]))  # its borders are equal
    turned = Image.fromarray(np.roll(pixels, 60, axis=0))  # no row is a pole

    assert not looks_like_panorama(part) and not looks_like_panorama(turned)
    assert not looks_like_panorama(Image.fromarray(np.full((256, 512, 3), 128, np.uint8)))
    assert part.size == (256, 128) and mirrored.size == (512, 256)


@pytest.mark.parametrize("seed", range(3))
def test_photos_twice_as_wide_as_high_are_none(seed):
    rng = np.random.default_rng(seed)
    coarse = Image.fromarray(rng.integers(0, 255, (20, 40, 3), np.uint8))

    assert not looks_like_panorama(coarse.resize((800, 400), Image.Resampling.BICUBIC))


def test_metadata_decides_where_it_is(rendered, tmp_path):
    whole = {"ProjectionType": "equirectangular", "FullPanoWidthPixels": 512, "CroppedAreaImageWidthPixels": 512}
    gray = Image.new("RGB", (512, 256), "gray")

    assert asked(saved(tmp_path, gray, **whole))
    assert read_panorama_entries(saved(tmp_path, gray, **whole).image) == {k: str(v) for k, v in whole.items()}


@pytest.mark.parametrize(
    ("entries", "reason"),
    [
        ({"ProjectionType": "cylindrical"}, "cylindrical"),
        (
            {"ProjectionType": "equirectangular", "FullPanoWidthPixels": 1024, "CroppedAreaImageWidthPixels": 512},
            "180 x 180 degrees",
        ),
    ],
)
def test_other_panoramas_are_refused_with_a_reason(rendered, tmp_path, entries, reason):
    with pytest.raises(UnreadableError, match=reason):
        asked(saved(tmp_path, rendered, **entries))


def test_a_cropped_panorama_that_says_it_is_whole_is_refused(rendered, tmp_path):
    with pytest.raises(UnreadableError, match="twice as wide as high"):
        asked(saved(tmp_path, rendered.crop((0, 0, 512, 200)), ProjectionType="equirectangular"))
