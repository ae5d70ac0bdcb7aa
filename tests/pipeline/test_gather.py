"""Several inputs are gathered into one folder, whatever their order; bad archives are refused in words."""

import json
import shutil
import zipfile
from contextlib import suppress
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from filelock import FileLock
from PIL import Image

from sfm_app.api import reconstruct
from sfm_app.errors import InputError, SfmError
from sfm_app.exports import StoredScene
from sfm_app.photos import gather
from sfm_app.photos.gather import expand, fill, find
from sfm_app.products import read_photo_list
from sfm_app.runtime.workspace import LOCK, Workspace
from sfm_app.settings import Settings
from sfm_app.stages import photos as photos_stage


@pytest.fixture
def archive(tmp_path):
    place = tmp_path / "z.zip"
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as packed:
        packed.writestr("in/a.jpg", b"a photo")
        packed.writestr("__MACOSX/in/._a.jpg", b"copy")
    return place


def gathered(inputs, target):
    fill(target, find(expand(inputs), target.parent), map)
    return {path.relative_to(target).as_posix(): path.read_bytes() for path in target.rglob("*") if path.is_file()}


def picture(seed, place):
    place.parent.mkdir(exist_ok=True)
    small = Image.fromarray(np.random.default_rng(seed).integers(0, 255, (12, 16, 3), np.uint8))
    small.resize((128, 96), Image.Resampling.BICUBIC).save(place)


def video(path, frames, seed=6):
    """A picture that moves to the left."""
    wide = Image.fromarray(np.random.default_rng(seed).integers(0, 255, (12, 80, 3), np.uint8))
    wide = np.asarray(wide.resize((640, 96), Image.Resampling.BICUBIC))
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (128, 96))
    for at in range(0, 8 * frames, 8):
        writer.write(np.ascontiguousarray(wide[:, at : at + 128, ::-1]))
    writer.release()


def packed(place, *files):
    with zipfile.ZipFile(place, "w") as made:
        for name, path in files:
            made.write(path, name)


def run(inputs, out, *, report=False, **photos):
    chosen = Settings.from_mapping({"workers": 1, "report": report, "photos": photos})
    return reconstruct(inputs, out, chosen, last="photos").manifest["stages"]["photos"]


@pytest.fixture
def mixed(tmp_path):
    """Two photos, one in a folder, and an archive of a photo, a copy and a text."""
    for seed, name in enumerate(("a.png", "more/b.png", "c.png")):
        picture(seed, tmp_path / name)
    (tmp_path / "x.txt").write_text("a text")
    files = (("in/c.png", "c.png"), ("in/b.png", "more/b.png"), ("x.txt", "x.txt"))
    packed(tmp_path / "z.zip", *((name, tmp_path / path) for name, path in files))
    return [tmp_path / "a.png", tmp_path / "more", tmp_path / "z.zip"]


def test_files_wildcards_folders_and_archives_in_any_order(tmp_path, archive):
    for name in ("p/a.jpg", "q/a.jpg", "r/c.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(name.encode())
    inputs = [tmp_path / "p" / "*.jpg", tmp_path / "q" / "a.jpg", tmp_path / "r", archive]
    found = gathered(inputs, tmp_path / "out" / "inputs")
    assert found == {"a.jpg": b"p/a.jpg", "_a.jpg": b"q/a.jpg", "r/c.jpg": b"r/c.jpg", "z/in/a.jpg": b"a photo"}
    assert gathered(inputs[::-1], tmp_path / "out" / "inputs") == found


@pytest.mark.parametrize(("name", "content"), [("../x.jpg", b"x"), ("x.jpg", bytes(10**6))])
def test_archives_that_lead_out_or_explode_are_refused(tmp_path, name, content):
    with zipfile.ZipFile(tmp_path / "z.zip", "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr(name, content)
    with pytest.raises(SfmError, match=r"leads out|too many"):
        gathered([tmp_path / "z.zip"], tmp_path / "out" / "inputs")


def test_a_member_with_too_long_a_name_is_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "z.zip", "w") as packed:
        packed.writestr(f"in/{'ä' * 130}.jpg", b"a photo")
    with pytest.raises(InputError, match="too long"):
        gathered([tmp_path / "z.zip"], tmp_path / "out" / "inputs")


def test_damaged_archives_raise_named_errors_only(tmp_path, archive):
    data, rng = archive.read_bytes(), np.random.default_rng(0)
    for _ in range(200):
        damaged = bytearray(data)
        damaged[rng.integers(len(data))] = rng.integers(256)
        archive.write_bytes(damaged)
        with suppress(SfmError):
            gathered([archive], tmp_path / "out" / "inputs")


def encrypt(archive):
    data = archive.read_bytes()
    directory = data.index(b"PK\1\2")
    archive.write_bytes(data[: directory + 8] + b"\1" + data[directory + 9 :])


def clear(archive):
    with zipfile.ZipFile(archive, "w"):
        pass


def spoil(archive):
    with zipfile.ZipFile(archive, "w") as made:
        made.writestr("a.jpg", b"a photo")
    archive.write_bytes(archive.read_bytes().replace(b"a photo", b"a phot0"))


@pytest.mark.parametrize(("change", "words"), [(encrypt, "encrypted"), (clear, "no file"), (spoil, "is damaged")])
def test_a_refused_archive_leaves_nothing_behind(tmp_path, mixed, archive, change, words):
    change(archive)
    with pytest.raises(InputError, match=words):
        run([mixed[0], archive], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_no_inputs_are_a_named_error(tmp_path):
    with pytest.raises(InputError, match="no photos are named"):
        run([], tmp_path / "out")


def test_a_run_names_the_users_files_and_resumes_in_any_order_and_place(tmp_path, mixed):
    first = run(mixed, tmp_path / "out")
    copy, text = f"{mixed[2]}: in/b.png", f"{mixed[2]}: x.txt"
    assert first["counts"]["unusable"] == {
        copy: f"the same picture as {tmp_path / 'more' / 'b.png'}",
        text: "not a photo",
    }
    named = {one["named"] for one in json.loads((tmp_path / "out" / "photos.json").read_text())["photos"]}
    assert named == {str(tmp_path / "a.png"), str(tmp_path / "more" / "b.png"), f"{mixed[2]}: in/c.png"}
    written = [(tmp_path / "out" / name).stat().st_mtime_ns for name in ("photos.json", ".inputs")]
    (tmp_path / "out").rename(tmp_path / "moved")
    assert run(mixed[::-1], tmp_path / "moved") == first
    assert [(tmp_path / "moved" / name).stat().st_mtime_ns for name in ("photos.json", ".inputs")] == written
    picture(9, tmp_path / "a.png")
    assert run(mixed, tmp_path / "moved")["fingerprint"] != first["fingerprint"]


def test_the_report_and_exports_have_the_users_names(tmp_path, mixed):
    run(mixed, tmp_path / "out", report=True)
    page = (tmp_path / "out" / "report.html").read_text()
    labels = [str(mixed[0]), str(mixed[1] / "b.png"), f"{mixed[2]}: in/c.png", f"{mixed[2]}: x.txt"]
    assert all(label in page for label in labels) and ".inputs" not in page
    scene = StoredScene.__new__(StoredScene)  # of a folder without poses
    scene._run = SimpleNamespace(workspace=Workspace(tmp_path / "out"))
    names = [photo.name for photo in read_photo_list(scene._run.workspace).photos]
    scene._place, scene.images = None, {f"{number}.jpg": name for number, name in enumerate(names)}
    scene.scene = SimpleNamespace(unregistered={})
    assert sorted(scene.record_entries("colmap")["photo_of"].values()) == sorted(labels[:3])


def test_a_later_run_of_one_folder_removes_what_was_gathered(tmp_path, mixed):
    run(mixed, tmp_path / "out")
    picture(8, mixed[1] / "d.png")
    with FileLock(tmp_path / "out" / LOCK), pytest.raises(InputError, match="another run"):
        run(mixed[1], tmp_path / "out")
    assert (tmp_path / "out" / ".inputs" / "a.png").is_file()
    assert run(mixed[1], tmp_path / "out")["counts"]["usable"] == 2
    assert not list((tmp_path / "out").glob(".inputs*"))
    assert run(mixed, tmp_path / "out")["counts"]["usable"] == 4


def test_a_folder_of_videos_with_what_cameras_write_beside_them_is_one_of_videos(tmp_path):
    (tmp_path / "films").mkdir()
    for seed, name in enumerate(("a.avi", "b.avi")):
        video(tmp_path / "films" / name, 20, seed)
    shutil.copy(tmp_path / "films" / "a.avi", tmp_path / "films" / "GL1.LRV")
    picture(1, tmp_path / "films" / "x.jpg")
    (tmp_path / "films" / "x.jpg").rename(tmp_path / "films" / "GX1.THM")
    for name in ("a.srt", "a.xmp", "notes.txt"):
        (tmp_path / "films" / name).write_text("a text")
    found = run([tmp_path / "films"], tmp_path / "out")["counts"]
    assert found["cameras"] == 2 and found["usable"] == found["video"]["chosen"]
    reasons = {name.rpartition("/")[2]: reason for name, reason in found["unusable"].items()}
    assert reasons == dict.fromkeys(("GL1.LRV", "GX1.THM"), "a small copy of a video") | dict.fromkeys(
        ("a.srt", "a.xmp", "notes.txt"), "not a photo"
    )


def test_inputs_stay_as_they_are_while_another_run_holds_the_folder(tmp_path, mixed):
    run(mixed, tmp_path / "out")
    before = sorted((tmp_path / "out" / ".inputs").rglob("*"))
    with FileLock(tmp_path / "out" / LOCK), pytest.raises(InputError, match="another run"):
        run(mixed[1:], tmp_path / "out")
    assert sorted((tmp_path / "out" / ".inputs").rglob("*")) == before


def test_masks_have_the_gathered_names(tmp_path, mixed):
    for name in ("a.png", "z/in/c.png.png"):
        (tmp_path / "masks" / name).parent.mkdir(parents=True, exist_ok=True)
        half = np.full((96, 128), 255, np.uint8)
        half[:, :64] = 0
        Image.fromarray(half).save(tmp_path / "masks" / name)
    found = run(mixed, tmp_path / "out", masks=str(tmp_path / "masks"))["counts"]
    assert found["masks"] == {"photos": 2, "unused": []}


def test_positions_of_several_inputs_are_merged_or_refused(tmp_path, mixed):
    (tmp_path / "more" / "geo.txt").write_text("EPSG:4326\nb.png 8.5 47.3 400\n")
    (tmp_path / "geo.txt").write_text("EPSG:4326\na.png 8.6 47.3 400\n")
    found = run([*mixed, tmp_path / "geo.txt"], tmp_path / "out")["counts"]
    assert found["gps"] == 2 and not any("geo.txt" in name for name in found["unusable"])
    (tmp_path / "geo.txt").write_text("EPSG:4326\nmore/b.png 8.6 47.3 400\n")
    with pytest.raises(InputError, match=r"two geo\.txt give"):
        run([*mixed, tmp_path / "geo.txt"], tmp_path / "out")


def test_frames_of_several_videos_join_the_photos(tmp_path, mixed):
    video(tmp_path / "long.avi", 40)
    video(tmp_path / "short.avi", 20, 7)
    packed(tmp_path / "films.zip", ("short.avi", tmp_path / "short.avi"))
    picture(5, tmp_path / "live" / "p.png")
    shutil.copy(tmp_path / "short.avi", tmp_path / "live" / "p.avi")
    (tmp_path / "bad.avi").write_bytes((tmp_path / "long.avi").read_bytes()[:6000])
    names = ("bad.avi", "films.zip", "live", "long.avi")
    inputs = [*mixed[:2], *(tmp_path / name for name in names)]
    found = run(inputs, tmp_path / "out", max_frames=12)
    frames = tmp_path / "out" / "frames"
    long, short = (len(list((frames / name).iterdir())) for name in ("long.avi", "films/short.avi"))
    assert long > short >= 2 and long + short <= 12
    assert found["counts"]["video"]["chosen"] == long + short
    assert found["counts"]["usable"] == long + short + 3 and found["counts"]["cameras"] == 3
    reasons = found["counts"]["unusable"]
    assert list(reasons) == [str(tmp_path / "bad.avi"), str(tmp_path / "live" / "p.avi")]
    assert "no frame of its mjpeg" in reasons[str(tmp_path / "bad.avi")] and ".inputs" not in str(reasons)
    (tmp_path / "out").rename(tmp_path / "moved")
    assert run(inputs, tmp_path / "moved", max_frames=12) == found


def test_a_killed_run_of_several_videos_keeps_its_choices(tmp_path, monkeypatch):
    for seed, name in enumerate(("films/a.avi", "films/b.avi")):
        (tmp_path / "films").mkdir(exist_ok=True)
        video(tmp_path / name, 20, seed)
    looked = []
    choose = photos_stage.choose_frames
    monkeypatch.setattr(photos_stage, "choose_frames", lambda *given: looked.append(given[0].name) or choose(*given))

    def kill(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr(photos_stage, "read_all", kill)
        with pytest.raises(KeyboardInterrupt):
            run([tmp_path / "films"], tmp_path / "out")
    assert looked == ["a.avi", "b.avi"]
    found = run([tmp_path / "films"], tmp_path / "out")["counts"]
    assert looked == ["a.avi", "b.avi"] and found["cameras"] == 2
    assert not list((tmp_path / "out" / "frames").rglob("*.txt"))


def test_a_kill_while_inputs_are_gathered_leaves_the_earlier_ones(tmp_path, mixed, monkeypatch):
    run(mixed, tmp_path / "out")
    inputs = tmp_path / "out" / ".inputs"
    before = sorted(path.relative_to(inputs) for path in inputs.rglob("*"))

    def kill(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as broken:
        broken.setattr(gather, "_unpack", kill)
        with pytest.raises(KeyboardInterrupt):
            run(mixed[1:], tmp_path / "out")
    assert sorted(path.relative_to(inputs) for path in inputs.rglob("*")) == before
    assert run(mixed[1:], tmp_path / "out")["counts"]["usable"] == 2
    assert not (inputs / "a.png").exists()
