"""Every file is looked at or has a reason, and nothing outside the folder is opened."""

import json

import pytest
from PIL import Image

from sfm_app.photos.files import is_video, list_files, list_photos, resolve_file


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
    found = {name: resolve_file(folder, name) for name in list_photos(folder, out, names)}
    assert [name for name, place in found.items() if not isinstance(place, str)] == ["b.jpg", "inner/a.jpg"]
    assert found["missing.jpg"] == "missing"
    assert found["../secret.jpg"] == found["/etc/passwd"] == "outside the folder"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_lists_name_photos_from_any_folder(folder, out, tmp_path, monkeypatch, encoding):
    monkeypatch.chdir(tmp_path)
    (folder / "#1.jpg").write_bytes(b"x")
    (folder / " c.jpg").write_bytes(b"x")
    lines = ["# mine", "#1.jpg", f"{folder}/a.jpg", "photos/b.jpg", "inner/../inner/a.jpg  ", " c.jpg", "d.jpg"]
    (folder / "list.txt").write_text("\n".join(lines), encoding)
    found = list_photos(folder, out, folder / "list.txt")
    assert list(found) == [" c.jpg", "#1.jpg", "a.jpg", "b.jpg", "d.jpg", "inner/a.jpg"]


def fill(folder, *names, size=(60, 40), mode="RGB"):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        Image.new(mode, size).save(folder / name, "PNG")


def reasons(folder):
    found = list_photos(folder, folder / "no output")
    return {name: reason for name, reason in found.items() if reason}


RUN = {"manifest.json": json.dumps({"program": "sfm-app", "stages": {}})}
KILLED = {".lock": "", "log.txt": ""}
EXPORT = {"export.json": json.dumps({"files": ["images/a.png"]})}


@pytest.mark.parametrize("files", [RUN, KILLED, EXPORT])
@pytest.mark.parametrize("place", ["first", "deep/er/first"])
def test_what_an_earlier_run_or_export_made_is_no_photo(folder, files, place):
    fill(folder, f"{place}/dense/images/a.png", f"{place}/images/a.png")
    for name, text in files.items():
        (folder / place / name).write_text(text)
    assert reasons(folder) == {place: "a folder that sfm-app made"}


def test_photos_beside_the_files_of_a_run_are_photos(folder):
    for name, text in RUN.items():
        (folder / name).write_text(text)
    fill(folder, "dense/images/a.png", "photos/b.png")
    assert reasons(folder) == dict.fromkeys(["dense", "photos"], "a folder that sfm-app made")


@pytest.mark.parametrize("files", [{"manifest.json": '{"name": "a web page"}'}, {".lock": ""}, {"export.json": "[]"}])
def test_files_of_other_programs_mark_no_run(folder, files):
    for name, text in files.items():
        (folder / "inner" / name).write_text(text)
    assert reasons(folder) == {}


@pytest.mark.parametrize(
    ("name", "reason"),
    [("masks/a.png", "a mask"), ("a_mask.png", "a mask"), ("x/Segment Masks/a.jpg.png", "a mask"),
     ("mask-a.png", "a mask"), ("depth_maps/a.png", "a depth map"),
     ("a_depth_0001.png", "a depth map"), ("normals/a.png", "a normal map"),
     ("images_8/a.png", "a smaller copy"), ("thumbs/a.jpg", "a smaller copy"), ("thumb_a.jpg", "a smaller copy"),
     ("undistorted/images/a.tif", "an undistorted copy"), ("colmap/dense/images/a.jpg", "an undistorted copy")],
)  # fmt: skip
def test_what_programs_make_of_photos_is_no_photo(tmp_path, name, reason):
    fill(tmp_path, name, size=(30, 20))
    assert reasons(tmp_path) == {}  # nothing else is there
    fill(tmp_path, "images/a.png")
    assert [text.startswith(reason) for text in reasons(tmp_path).values()] == [True]
    assert list(reasons(tmp_path)) == [name]


def test_a_word_alone_is_no_proof(tmp_path):
    fill(tmp_path, "carnival/street.png", "carnival/masks/venice.png", "depth of field/x.png", "mask_7.png")
    fill(tmp_path, "images/0001.png", "images_2/0001.png")  # two cameras
    assert reasons(tmp_path) == {}


def test_gray_pictures_in_a_folder_of_depth_maps_need_no_name_of_a_photo(tmp_path):
    fill(tmp_path, "rgb/130.175.png")
    fill(tmp_path, "depth/130.160.png", mode="I;16")
    assert reasons(tmp_path) == {"depth/130.160.png": "a depth map"}


def test_textures_of_models_are_no_photos(tmp_path):
    fill(tmp_path, "a.jpg", "chair_0.jpg")
    (tmp_path / "chair.mtl").write_text("newmtl page\nmap_Kd chair_0.jpg\n")
    assert reasons(tmp_path) == {"chair_0.jpg": "a texture of chair.mtl"}


@pytest.mark.parametrize("name", ["@eaDir", "__MACOSX"])
def test_folders_of_systems_are_not_entered(folder, name):
    fill(folder, f"{name}/b.jpg/SYNOPHOTO_THUMB_XL.jpg")
    assert reasons(folder) == {name: "a folder of the system, not of photos"}


HEADS = {
    "heic": b"\0\0\0\x18ftypheic", "avif": b"\0\0\0\x18ftypavif", "raw": b"\0\0\0\x18ftypcrx ",
    "sound": b"RIFF\0\0\0\0WAVE",
    "webp": b"RIFF\0\0\0\0WEBP", "jpeg": b"\xff\xd8\xff\xe0", "G": b"G" + bytes(399), "empty": b"",
}  # fmt: skip


@pytest.mark.parametrize("kind", HEADS)
def test_photos_and_sound_are_no_videos(kind):
    assert not is_video(HEADS[kind].ljust(400, b"\0") if HEADS[kind] else b"")
