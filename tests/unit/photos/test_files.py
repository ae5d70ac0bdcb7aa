"""Every file is looked at or has a reason, and nothing outside the folder is opened."""

import pytest

from sfm_app.photos.files import is_video, list_files, resolve_file


@pytest.fixture
def folder(tmp_path):
    place = tmp_path / "photos"
    (place / "inner").mkdir(parents=True)
    for name in ("b.jpg", "a.jpg", "inner/a.jpg"):
        (place / name).write_bytes(b"x")
    return place


@pytest.fixture
def out(tmp_path):
    return tmp_path / "out"


def test_all_files_below_in_order(folder, out):
    assert list_files(folder, out) == ["a.jpg", "b.jpg", "inner/a.jpg"]
    assert resolve_file(folder, "inner/a.jpg") == (folder / "inner/a.jpg").resolve()


def test_the_output_folder_is_left_out(folder):
    (folder / "out").mkdir()
    (folder / "out" / "page.jpg").write_bytes(b"x")
    assert list_files(folder, folder / "out") == ["a.jpg", "b.jpg", "inner/a.jpg"]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_list_names_the_photos(folder, out, tmp_path, encoding):
    names = tmp_path / "list.txt"
    names.write_text("inner/a.jpg\r\n\nb.jpg\nb.jpg\nmissing.jpg\n../secret.jpg\n/etc/passwd\n", encoding)
    found = {name: resolve_file(folder, name) for name in list_files(folder, out, names)}
    assert [name for name, place in found.items() if not isinstance(place, str)] == ["b.jpg", "inner/a.jpg"]
    assert found["missing.jpg"] == "missing"
    assert found["../secret.jpg"] == found["/etc/passwd"] == "outside the folder"


HEADS = {
    "heic": b"\0\0\0\x18ftypheic", "avif": b"\0\0\0\x18ftypavif", "raw": b"\0\0\0\x18ftypcrx ",
    "sound": b"RIFF\0\0\0\0WAVE",
    "webp": b"RIFF\0\0\0\0WEBP", "jpeg": b"\xff\xd8\xff\xe0", "G": b"G" + bytes(399), "empty": b"",
}  # fmt: skip


@pytest.mark.parametrize("kind", HEADS)
def test_photos_and_sound_are_no_videos(kind):
    assert not is_video(HEADS[kind].ljust(400, b"\0") if HEADS[kind] else b"")
