"""What was measured on photos is read back exactly, or not at all."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from sfm_app.photos.probe import read_photo
from sfm_app.photos.selection import PhotoStats, read_stats, write_stats
from sfm_app.settings import PhotoSettings
from sfm_app.types import GpsPosition, Photo

OPTIONS = PhotoSettings()
DIGESTS = {"a.jpg": "1", "sub/b.jpg": "2"}
FULL = Photo(
    "sub/b.jpg", 640, 480, "camera", 700.5, True, GpsPosition(47.1, 8.2, None), "sub/B.webp", False, 90, ("scaled",),
    (10, 0, 600, 480), "b.png", "equirectangular", 1.25,
)  # fmt: skip


@pytest.fixture
def stats():
    rng = np.random.default_rng(0)
    thumbnails = rng.integers(0, 256, (2, 32, 32)).astype(np.float32)
    plain = Photo("a.jpg", 64, 64, "")
    return {"a.jpg": PhotoStats(plain, thumbnails[0], 0.301, 0.5), "sub/b.jpg": PhotoStats(FULL, thumbnails[1])}


def test_a_photo_is_the_same_after_json():
    assert Photo.from_dict(FULL.to_dict()) == FULL
    assert "time_s" not in replace(FULL, time_s=None).to_dict()


def test_statistics_come_back_as_they_were(stats, tmp_path):
    write_stats(tmp_path / "stats.npz", stats, DIGESTS, OPTIONS)

    found = read_stats(tmp_path / "stats.npz", DIGESTS, OPTIONS)

    assert list(found) == list(stats)
    for name, one in found.items():
        assert (one.photo, one.blur, one.flat) == (stats[name].photo, stats[name].blur, stats[name].flat)
        assert one.thumbnail.dtype == np.float32 and np.array_equal(one.thumbnail, stats[name].thumbnail)


def test_a_real_photo_has_a_thumbnail_of_whole_gray_levels(tmp_path):
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 256, (90, 120, 3), np.uint8)).save(tmp_path / "a.jpg")
    read = read_photo(tmp_path, "a.jpg", options=OPTIONS)

    write_stats(tmp_path / "stats.npz", {"a.jpg": read}, DIGESTS, OPTIONS)

    again = read_stats(tmp_path / "stats.npz", DIGESTS, OPTIONS)["a.jpg"]
    assert again.photo == read.photo and np.array_equal(again.thumbnail, read.thumbnail)


def test_only_files_with_the_same_bytes_are_known(stats, tmp_path):
    write_stats(tmp_path / "stats.npz", stats, DIGESTS, OPTIONS)

    assert list(read_stats(tmp_path / "stats.npz", {"a.jpg": "1", "sub/b.jpg": "3"}, OPTIONS)) == ["a.jpg"]
    assert read_stats(tmp_path / "stats.npz", {"c.jpg": "1"}, OPTIONS) == {}


def test_photos_whose_bytes_are_not_known_are_left_out(stats, tmp_path):
    write_stats(tmp_path / "stats.npz", stats, {"a.jpg": "1"}, OPTIONS)

    assert list(read_stats(tmp_path / "stats.npz", DIGESTS, OPTIONS)) == ["a.jpg"]


@pytest.mark.parametrize(("change", "known"), [({"max_megapixels": 3.0}, 0), ({"masks": "masks"}, 2)])
def test_only_settings_that_decide_how_files_are_read_matter(change, known, stats, tmp_path):
    write_stats(tmp_path / "stats.npz", stats, DIGESTS, OPTIONS)

    assert len(read_stats(tmp_path / "stats.npz", DIGESTS, OPTIONS.model_copy(update=change))) == known


def test_a_damaged_or_missing_file_knows_nothing(stats, tmp_path):
    path = tmp_path / "stats.npz"
    assert read_stats(path, DIGESTS, OPTIONS) == {}
    write_stats(path, stats, DIGESTS, OPTIONS)
    whole = path.read_bytes()

    for place in range(0, len(whole), 97):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
        found = read_stats(path, DIGESTS, OPTIONS)
        for name, one in found.items():
            assert one.photo == stats[name].photo and np.array_equal(one.thumbnail, stats[name].thumbnail)
    path.write_bytes(whole[: len(whole) // 2])
    assert read_stats(path, DIGESTS, OPTIONS) == {}
