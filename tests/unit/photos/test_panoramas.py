"""Recognition of panoramas by metadata or pixels, and views of them."""

import numpy as np
import pytest
from PIL import Image

from sfm_app.photos.decode import UnreadableError, read_picture, upright_image
from sfm_app.photos.panoramas import (
    PanoramaViews,
    is_panorama,
    looks_like_panorama,
    mask_part,
    panorama_parts,
    read_panorama_entries,
    resample,
    show_part,
    shrink,
)
from sfm_app.synthetic.cameras import Views, look_at, panorama_camera
from sfm_app.synthetic.photo_folder import PhotoOptions, write_photo_folder
from sfm_app.synthetic.scenes import courtyard
from tests.unit.colored_photos import colors_of

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


def test_parts_pictures_without_poles_and_plain_ones_are_none(rendered):
    pixels = np.asarray(rendered)
    for other in (pixels[64:192, 100:356], np.roll(pixels, 60, axis=0), np.full((256, 512, 3), 128, np.uint8)):
        assert other.shape[1] == 2 * other.shape[0]
        assert not looks_like_panorama(Image.fromarray(other))


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
    ("entries", "height", "reason"),
    [
        ({"ProjectionType": "cylindrical"}, 256, "cylindrical"),
        ({"FullPanoWidthPixels": 1024, "CroppedAreaImageWidthPixels": 512}, 256, "180 x 180 degrees"),
        ({}, 200, "twice as wide as high"),
    ],
)
def test_other_panoramas_are_refused_with_a_reason(rendered, tmp_path, entries, height, reason):
    cropped = rendered.crop((0, 0, 512, height))
    with pytest.raises(UnreadableError, match=reason):
        asked(saved(tmp_path, cropped, **{"ProjectionType": "equirectangular"} | entries))


WIDTH = 512


def panorama(width=WIDTH):
    """A panorama whose colors are directions."""
    across = ((np.arange(width) + 0.5) / width - 0.5) * 2.0 * np.pi
    longitude, latitude = np.meshgrid(across, 0.5 * across[::2] + 0.25 * (across[1] - across[0]))
    level = np.cos(latitude)
    return colors_of(np.stack([level * np.sin(longitude), np.sin(latitude), level * np.cos(longitude)], -1))


def test_painted_parts_show_their_directions_all_round():
    whole = panorama()
    parts = panorama_parts((WIDTH, WIDTH // 2))
    assert len(parts) == 6
    for part in parts:
        wrong = np.abs(show_part(whole, part).astype(int) - colors_of(part.rays()))
        assert wrong.max() <= 4 and wrong.mean() < 1.0


def test_masks_of_parts_are_those_of_their_pixels():
    used = np.ones((WIDTH // 2, WIDTH), np.bool_)
    used[:, : WIDTH // 2] = False  # the left half
    for part in panorama_parts((WIDTH, WIDTH // 2)):
        rays = part.rays()
        clear = np.abs(rays[..., 0]) > 0.02
        np.testing.assert_array_equal(mask_part(used, part)[clear], rays[..., 0][clear] > 0.0)


@pytest.mark.parametrize("view", range(12))
def test_feature_views_show_their_directions(view):
    views = PanoramaViews.cover((WIDTH, WIDTH // 2), 1000)
    shown = views.render(panorama(), view)
    pixels = np.array([[0.5, 0.5], [views.side_px / 2, views.side_px / 2], [views.side_px - 0.5, 0.5]])
    plain = np.column_stack([(pixels - views.side_px / 2) / views.focal_px, np.ones(3)])
    column, row = pixels.astype(int).T
    wrong = np.abs(shown[row, column].astype(int) - colors_of(plain @ views.rotations[view]))
    assert wrong.max() <= 4


def test_every_direction_belongs_to_one_feature_view():
    views = PanoramaViews.cover((WIDTH, WIDTH // 2), 1000)
    pixels = np.random.default_rng(0).uniform(0.0, views.side_px, (4000, 2))
    own = [views.is_nearest(pixels, view) for view in range(12)]
    # half of the pixels of a view of 80 degrees are nearest to its axis
    assert all(0.4 < share.mean() < 0.6 for share in own)
    at = np.concatenate([views.to_panorama(pixels[mine], view) for view, mine in enumerate(own)])
    cells = np.histogram2d(*(at / [WIDTH, WIDTH / 2]).T, bins=(8, 4))[0]
    assert cells.min() > 0


def test_sampling_goes_around_the_border_of_a_panorama():
    photo = np.zeros((20, 40, 3), np.uint8)
    photo[:, -1] = photo[:, 0] = 200
    at = np.array([[[0.0, 10.0], [40.0, 10.0], [20.0, 10.0]]])
    assert resample(photo, at, (40, 20), wraps=True)[0, :, 0].tolist() == pytest.approx([230, 230, 0], abs=12)
    assert resample(photo, at, (40, 20))[0, 0, 0] > 190


def test_shrinking_averages_and_never_enlarges():
    photo = np.zeros((10, 20, 3), np.uint8)
    photo[:, ::2] = 200
    assert shrink(photo, 0.5).shape == (5, 10, 3) and (shrink(photo, 0.5) == 100).all()
    assert shrink(photo, 1.5) is photo
