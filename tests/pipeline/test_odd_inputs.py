"""Folders and machines as people have them: every file is used or left out with a reason, every refusal is a line."""

import json
import os
import zipfile
import zlib
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from filelock import FileLock
from PIL import Image, features

from sfm_app.cli.program import main
from sfm_app.runtime.workspace import LOCK

SIZE = (128, 96)
USED = "used"


def picture(seed=0, size=SIZE):
    """A picture of its own, of soft blots."""
    blots = Image.fromarray(np.random.default_rng(seed).integers(0, 255, (12, 16, 3), np.uint8))
    return blots.resize(size, Image.Resampling.BICUBIC)


def call(*arguments):
    return CliRunner().invoke(main, [*map(str, arguments), "--workers", "1", "-q"])


@pytest.fixture
def folder(tmp_path):
    """Two good photos."""
    place = tmp_path / "photos"
    place.mkdir()
    picture(1).save(place / "a.jpg")
    picture(2).save(place / "b.png")
    return place


def saved(name, kind=None, mode=None, **options):
    """A picture in another format or mode."""

    def make(folder):
        image = picture()
        (image.convert(mode) if mode else image).save(folder / name, kind, **options)

    return make


def written(name, content):
    return lambda folder: (folder / name).write_bytes(content)


def gray(name, kind, factor):
    return lambda folder: Image.fromarray(np.asarray(picture())[..., 0].astype(kind) * kind(factor)).save(folder / name)


def bomb(folder):
    picture().save(folder / "x.png")
    data = bytearray((folder / "x.png").read_bytes())
    data[16:24] = (60_000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    (folder / "x.png").write_bytes(data)


def bad_exif(folder):
    exif = Image.Exif()
    exif[0x0110] = "Box Brownie"
    picture().save(folder / "x.jpg", exif=exif)
    data = (folder / "x.jpg").read_bytes()
    at = data.index(b"Exif\0\0") + 6
    (folder / "x.jpg").write_bytes(data[:at] + b"\xff" * 20 + data[at + 20 :])


def turned(folder):
    exif = Image.Exif()
    exif[0x0112] = 6
    picture().save(folder / "x.jpg", exif=exif)


def below(name):
    def make(folder):
        (folder / name).parent.mkdir()
        picture().save(folder / name)

    return make


def link(name, target):
    return lambda folder: (folder / name).symlink_to(target)


def copied(source, name, end=None):
    return lambda folder: (folder / name).write_bytes((folder / source).read_bytes()[:end])


def damaged(folder):
    """Zeros stand for half of the data."""
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (96, 128, 3), np.uint8)).save(folder / "x.jpg")
    data = (folder / "x.jpg").read_bytes()
    (folder / "x.jpg").write_bytes(data[: len(data) // 2].ljust(len(data), b"\0"))


def output_of_a_run(folder):
    (folder / "old" / "dense" / "images").mkdir(parents=True)
    (folder / "old" / "manifest.json").write_text('{"program": "sfm-app"}')
    picture(8).save(folder / "old" / "dense" / "images" / "a.jpg")


def smaller_copy(folder):
    Image.open(folder / "a.jpg").resize((96, 72), Image.Resampling.LANCZOS).save(folder / "x.jpg", quality=95)


def video(path, shifts, code="MJPG"):
    """A picture that moves to the left by so many pixels from frame to frame."""
    wide = np.asarray(picture(6, (640, 96)))
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*code), 30.0, SIZE)
    for at in np.cumsum(shifts):
        writer.write(np.ascontiguousarray(wide[:, at : at + SIZE[0], ::-1]))
    writer.release()


def video_as_photo(folder):
    video(folder / "x.mp4", [9] * 3, "mp4v")
    (folder / "x.mp4").rename(folder / "x.jpg")


def moving_gif(folder):
    picture(6).save(folder / "x.gif", save_all=True, append_images=[picture(7)], duration=40)


def panorama(**entries):
    """A picture with Google's Photo Sphere metadata."""
    said = " ".join(f'GPano:{name}="{value}"' for name, value in entries.items())
    return saved("x.jpg", xmp=f"<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:Description {said}/></x:xmpmeta>".encode())


FILES = {
    "CMYK": (saved("x.jpg", mode="CMYK"), "x.jpg", USED),
    "progressive": (saved("x.jpg", progressive=True), "x.jpg", USED),
    "color profile": (saved("x.jpg", icc_profile=b"no profile at all"), "x.jpg", USED),
    "gray": (saved("x.png", mode="L"), "x.png", USED),
    "palette": (saved("x.png", mode="P"), "x.png", USED),
    "bilevel": (saved("x.png", mode="1"), "x.png", USED),
    "alpha": (saved("x.png", mode="RGBA"), "x.png", USED),
    "16 bit": (gray("x.png", np.uint16, 257), "x.png", USED),
    "floating point": (gray("x.tif", np.float32, 1), "x.tif", USED),
    "TIFF": (saved("x.tif"), "x.tif", USED),
    "WebP": (saved("x.webp"), "x.webp", USED),
    "BMP": (saved("x.bmp"), "x.bmp", USED),
    "AVIF": (saved("x.avif"), "x.avif", USED) if features.check("avif") else (turned, "x.jpg", USED),
    "JPEG named PNG": (saved("x.png", "JPEG"), "x.png", USED),
    "no suffix": (saved("x", "PNG"), "x", USED),
    "upper-case name": (saved("X.JPG"), "X.JPG", USED),
    "EXIF orientation": (turned, "x.jpg", USED),
    "damaged EXIF": (bad_exif, "x.jpg", USED),
    "spaces in the name": (saved("  x  .jpg"), "  x  .jpg", USED),
    "umlauts in the name": (saved("\u00e4\u00f6\u00fc.jpg"), "\u00e4\u00f6\u00fc.jpg", USED),
    "line break in the name": (saved("x\ny.jpg"), "x\ny.jpg", USED),
    "escape sequence in the name": (saved("\x1b[2J.jpg"), "\x1b[2J.jpg", USED),
    "name that is not UTF-8": (saved("\udcff.jpg"), "\udcff.jpg", USED),
    "name like an option": (saved("--help.jpg"), "--help.jpg", USED),
    "same name in two folders": (below("in/a.jpg"), "in/a.jpg", USED),
    "a folder named like a photo": (below("in.jpg/x.jpg"), "in.jpg/x.jpg", USED),
    "HEIC": (written("x.heic", b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(90)), "x.heic", ""),
    "blurred": (lambda folder: picture(5, (800, 600)).save(folder / "x.jpg"), "x.jpg", "blurred beyond use"),
    "cylindrical panorama": (panorama(ProjectionType="cylindrical"), "x.jpg", "a panorama of the projection"),
    "part of a panorama": (
        panorama(ProjectionType="equirectangular", FullPanoWidthPixels=600, CroppedAreaImageWidthPixels=300),
        "x.jpg",
        "a panorama of 180 x 180 degrees",
    ),
    "GIF": (saved("x.gif"), "x.gif", USED),
    "text": (written("x.txt", b"a text"), "x.txt", "not a photo"),
    "PDF": (written("x.pdf", b"%PDF-1.7\n"), "x.pdf", "not a photo"),
    "empty": (written("x.jpg", b""), "x.jpg", "empty"),
    "truncated": (copied("a.jpg", "x.jpg", -500), "x.jpg", "truncated or damaged"),
    "damaged data": (damaged, "x.jpg", "truncated or damaged"),
    "output of a run": (output_of_a_run, "old", "a folder that sfm-app made"),
    "noise": (written("x.jpg", bytes(range(256)) * 30), "x.jpg", "not a photo"),
    "decompression bomb": (bomb, "x.png", "too many pixels"),
    "tiny": (lambda folder: picture(5, (40, 40)).save(folder / "x.png"), "x.png", "smaller than 64 px"),
    "hidden": (saved(".x.jpg"), ".x.jpg", "hidden"),
    "exact copy": (copied("b.png", "x.png"), "x.png", "the same picture as b.png"),
    "smaller copy": (smaller_copy, "x.jpg", "the same picture as a.jpg"),
    "link inside the folder": (link("x.jpg", "a.jpg"), "x.jpg", "the same picture as a.jpg"),
    "link out of the folder": (link("x.jpg", "../secret.jpg"), "x.jpg", "a link out of the folder"),
    "broken link": (link("x.jpg", "nothing.jpg"), "x.jpg", "a broken link"),
    "link to itself": (link("x.jpg", "x.jpg"), "x.jpg", "a broken link"),
    "link to the parent folder": (link("x", ".."), "x", "a link out of the folder"),
    "video": (lambda folder: video(folder / "x.avi", [9] * 3), "x.avi", "a video; run it alone: sfm-app run x.avi"),
    "video named like a photo": (video_as_photo, "x.jpg", "a video; run it alone"),
    "GIF that moves": (moving_gif, "x.gif", "a video; run it alone"),
    "audio": (written("x.m4a", b"\0\0\0\x18ftypM4A " + bytes(90)), "x.m4a", "not a photo"),
    "pipe": (lambda folder: os.mkfifo(folder / "x.jpg"), "x.jpg", "not a file"),
}


@pytest.mark.parametrize("case", FILES)
def test_every_file_is_accounted_for(folder, tmp_path, case):
    make, name, expected = FILES[case]
    picture(9).save(tmp_path / "secret.jpg")
    make(folder)

    result = call("run", folder, "-o", tmp_path / "out", "--until", "photos", "--json")

    assert result.exit_code == 0, result.stderr
    found = json.loads(result.stdout)["photos"]
    assert found["usable"] == (3 if expected == USED else 2)
    assert list(found["unusable"]) == ([] if expected == USED else [name])
    assert expected in found["unusable"].get(name, USED)
    stored = [path for path in (tmp_path / "out" / "photos").rglob("*") if path.is_file()]
    assert len(stored) == found["usable"] and all("".join(path.name.split()).isprintable() for path in stored)
    told = call("run", folder, "-o", tmp_path / "out", "--until", "photos").stdout
    assert all(line.isprintable() for line in told.splitlines())
    assert sorted(tmp_path.iterdir()) == [tmp_path / "out", folder, tmp_path / "secret.jpg"]


def test_a_file_that_may_not_be_read(folder, tmp_path, as_ordinary_user):
    picture(3).save(folder / "x.jpg")
    (folder / "x.jpg").chmod(0)
    result = as_ordinary_user("-m", "sfm_app", "run", folder, "-o", tmp_path / "out", "--until", "photos", "--json")
    assert json.loads(result.stdout)["photos"]["unusable"] == {"x.jpg": "not readable: permission denied"}


def half_a_photo_set(out):
    whole = (out / "photos.json").read_bytes()
    (out / "photos.json").write_bytes(whole[: len(whole) // 2] + b"!" * (len(whole) - len(whole) // 2))


def manifest(content):
    return lambda out: (out / "manifest.json").write_bytes(content)


DISTURBED = {
    "nothing": lambda _: None,
    "no text": manifest(b"\xff\x00{]"),
    "half a manifest": lambda out: os.truncate(out / "manifest.json", (out / "manifest.json").stat().st_size // 2),
    "foreign manifest": manifest(b'{"stages": {"photos": {"made": "by another program"}, "scene": 3}}'),
    "list as manifest": manifest(b'["stages"]'),
    "stages as list": manifest(b'{"stages": ["photos"]}'),
    "half a photo set": half_a_photo_set,
    "photo changed": lambda out: picture(30).save(out.with_name("photos") / "a.jpg"),
}


@pytest.mark.parametrize("case", DISTURBED)
def test_what_lies_in_the_output_folder_never_stops_a_run(folder, tmp_path, case):
    command = ("run", folder, "-o", tmp_path / "out", "--until", "photos", "--json")
    assert call(*command).exit_code == 0
    DISTURBED[case](tmp_path / "out")
    result = call(*command)
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["photos"]["usable"] == 2


COMMANDS = {
    "a missing folder": ("{here}/nowhere -o {here}/out", 3, "not found"),
    "a photo alone": ("{photos}/a.jpg -o {here}/out", 3, "neither a folder, a video nor a ZIP archive"),
    "a missing video": ("{here}/none.mp4 -o {here}/out", 3, "not found"),
    "a text file named like a video": ("{videos}/text.mp4 -o {here}/out", 3, "not a video"),
    "a list of videos": ("{videos}/list.mp4 -o {here}/out", 3, "not a video"),
    "a URL": ("http://127.0.0.1/clip.mp4 -o {here}/out", 3, "not found"),
    "an empty video": ("{videos}/empty.mov -o {here}/out", 3, "empty.mov is empty"),
    "a folder named like a video": ("{videos}/folder.mp4 -o {here}/out", 3, "the folder is empty"),
    "the first half of a video": ("{videos}/half.mp4 -o {here}/out", 3, "damaged, cut off, or no QuickTime"),
    "only the start of a video": ("{videos}/head.avi -o {here}/out", 3, "no frame of its mjpeg"),
    "a video in an unknown codec": ("{videos}/codec.mp4 -o {here}/out", 3, "its codec, xyz1, cannot be decoded"),
    "an encrypted video": ("{videos}/closed.mp4 -o {here}/out", 3, "encrypted"),
    "sound without a video": ("{videos}/sound.avi -o {here}/out", 3, "sound, but no video in this AVI"),
    "a camera that does not move": ("{videos}/still.avi -o {here}/out", 3, "the camera does not move"),
    "several inputs without an output folder": ("{photos} {photos}/a.jpg", 2, "no folder for the results"),
    "a wildcard without a file": ("{here}/none*.jpg -o {here}/out", 3, "not found"),
    "a missing photo among others": ("{photos}/a.jpg {here}/none.jpg -o {here}/out", 3, "not found"),
    "a list of photos with several inputs":
        ("{photos} {photos}/a.jpg -o {here}/out --images {here}/list.txt", 2, "--images"),
    "an input as masks": ("{photos} {photos}/a.jpg -o {here}/out --masks {photos}", 3, "photos and masks"),
    "one photo and a list": ("{photos}/a.jpg {here}/list.txt -o {here}/out", 3, "one usable photo in the inputs"),
    "an empty ZIP": ("{archives}/empty.zip -o {here}/out", 3, "empty.zip holds no file"),
    "an encrypted ZIP": ("{archives}/closed.zip -o {here}/out", 3, "closed.zip is encrypted"),
    "half a ZIP": ("{archives}/half.zip {photos}/a.jpg -o {here}/out", 3, "one usable photo in the inputs"),
    "a ZIP with a damaged file": ("{archives}/bad.zip -o {here}/out", 3, "bad.zip is damaged"),
    "a ZIP that leads out": ("{archives}/out.zip -o {here}/out", 3, "leads out of it: ../a.jpg"),
    "a ZIP that explodes": ("{archives}/bomb.zip -o {here}/out", 3, "would unpack to"),
    "a ZIP where the run writes": ("{here}/old/photos/x.zip -o {here}/old", 3, "keeps its own files"),
    "a folder of videos that do not move": ("{videos}/stills -o {here}/out", 3, "the camera does not move in it"),
    "a list of photos with a video": ("{videos}/clip.avi -o {here}/out --images {here}/list.txt", 2, "--images"),
    "a video where the run writes": ("{here}/old/photos/x.avi -o {here}/old", 3, "keeps its own files"),
    "at most one frame of a video": ("{videos}/clip.avi -o {here}/out --max-frames 1", 2, "photos.max_frames"),
    "output folder equal to the photo folder": ("{photos} -o {photos}", 3, "cannot be both the photos and the output"),
    "photos where the run writes": ("{photos} -o {here}", 3, "keeps its own files"),
    "the run's own photos": ("{here}/old/photos -o {here}/old", 3, "keeps its own files"),
    "a folder of links to photos elsewhere": ("{here}/old/photos -o {here}/new", 3, "1 a link out of the folder"),
    "photos/ of another origin in the output": ("{photos} -o {here}/old", 3, "no run has made it"),
    "sparse/ of another origin in the output": ("{photos} -o {here}/colmap", 3, "no run has made it"),
    "a file as output": ("{photos} -o {photos}/a.jpg", 3, "cannot write to"),
    "output in use by another run": ("{photos} -o {here}/held", 3, "another run is at work"),
    "a missing list": ("{photos} -o {here}/out --images {here}/none.txt", 3, "cannot read"),
    "an empty list": ("{photos} -o {here}/out --images {here}/empty.txt", 3, "no usable photo"),
    "a list of files outside the folder": ("{photos} -o {here}/out --images {here}/list.txt", 3, "outside the folder"),
    "a missing settings file": ("{photos} -o {here}/out --config {here}/none.toml", 2, "cannot read"),
    "a settings file that is not TOML": ("{photos} -o {here}/out --config {photos}/a.jpg", 2, "is not a TOML file"),
    "an unknown table of settings": ("{photos} -o {here}/out --set colmap.x=1", 2, "unknown setting"),
    "a setting of the wrong type": ("{photos} -o {here}/out --set mesh.faces=many", 2, "mesh.faces"),
    "a setting out of range": ("{photos} -o {here}/out --seed -1", 2, "seed"),
    "a setting that is not finite":
        ("{photos} -o {here}/out --set mesh.min_island=nan", 2, "mesh.min_island"),
    "a plug-in that is not loaded":
        ("{photos} -o {here}/out --no-plugins --estimator poselib-lo-ransac", 2, "no estimator is named"),
    "too little memory": ("{photos} -o {here}/out --max-memory 0.1", 2, "more than --max-memory"),
    "a missing mask folder": ("{photos} -o {here}/out --masks {here}/none", 3, "no such folder of masks"),
    "masks of other photos": ("{photos} -o {here}/out --masks {here}/held", 3, "is the mask of a photo"),
    "photos as masks": ("{photos} -o {here}/out --masks {photos}", 3, "the masks lie among the photos"),
    "an unknown value of --cameras": ("{photos} -o {here}/out --cameras two", 2, "is not one of 'auto', 'single'"),
    "an unknown stage": ("{photos} -o {here}/out --until lunch", 2, "lunch"),
}  # fmt: skip


def some_videos(place, another):
    """One that can be used, and others."""
    (place / "folder.mp4").mkdir(parents=True)
    (place / "text.mp4").write_text("a text")
    (place / "list.mp4").write_text("ffconcat version 1.0\nfile clip.avi\n")
    (place / "empty.mov").write_bytes(b"")
    video(place / "clip.avi", [4] * 12)
    video(place / "still.avi", [0] * 12)
    video(place / "whole.mp4", [4] * 12, "mp4v")
    (place / "stills").mkdir()
    (place / "stills" / "a.avi").write_bytes((place / "still.avi").read_bytes())
    another.write_bytes((place / "clip.avi").read_bytes())
    whole = (place / "whole.mp4").read_bytes()
    (place / "half.mp4").write_bytes(whole[: len(whole) // 2])
    for name, code in (("codec.mp4", b"xyz1"), ("closed.mp4", b"encv")):
        (place / name).write_bytes(whole.replace(b"mp4v\0\0\0\0\0\0", code + bytes(6)).replace(b"esds", b"none"))
    with av.open(str(place / "sound.avi"), "w") as made:
        made.add_stream("pcm_s16le", rate=8000)
        made.start_encoding()
    (place / "head.avi").write_bytes((place / "clip.avi").read_bytes()[:6000])


def some_archives(place):
    """None can be used."""
    place.mkdir()
    for name, member, content in (
        ("closed", "a.jpg", b"a photo"), ("half", "a.jpg", b"a photo"), ("bad", "a.jpg", b"a photo"),
        ("out", "../a.jpg", b"a photo"), ("bomb", "a.jpg", bytes(10**6)),
    ):  # fmt: skip
        with zipfile.ZipFile(place / f"{name}.zip", "w", zipfile.ZIP_DEFLATED if name == "bomb" else 0) as made:
            made.writestr(member, content)
    zipfile.ZipFile(place / "empty.zip", "w").close()
    whole = (place / "half.zip").read_bytes()
    directory = whole.index(b"PK\1\2")
    (place / "half.zip").write_bytes(whole[:directory])
    (place / "bad.zip").write_bytes(whole.replace(b"a photo", b"a phot0"))
    (place / "closed.zip").write_bytes(whole[: directory + 8] + b"\1" + whole[directory + 9 :])


@pytest.mark.parametrize("case", COMMANDS)
def test_every_refusal_is_one_line_and_a_hint(folder, tmp_path, case):
    arguments, code, words = COMMANDS[case]
    (tmp_path / "old" / "photos").mkdir(parents=True)
    (tmp_path / "old" / "photos" / "a.jpg").symlink_to(folder / "a.jpg")
    some_videos(tmp_path / "videos", tmp_path / "old" / "photos" / "x.avi")
    some_archives(tmp_path / "archives")
    (tmp_path / "old" / "photos" / "x.zip").write_bytes((tmp_path / "archives" / "bad.zip").read_bytes())
    for name in ("held", "colmap/sparse"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "empty.txt").write_text("")
    (tmp_path / "list.txt").write_text("../held\n/etc/passwd\n")

    with FileLock(tmp_path / "held" / LOCK):
        before = {path: path.lstat().st_mtime_ns for path in tmp_path.rglob("*")}
        places = {"here": tmp_path, "photos": folder, "videos": tmp_path / "videos", "archives": tmp_path / "archives"}
        result = call("run", *(word.format(**places) for word in arguments.split()))

    assert result.exit_code == code, result.stderr
    assert words in result.stderr and "Traceback" not in result.output and result.stdout == ""
    assert all(path.lstat().st_mtime_ns == stamp for path, stamp in before.items())  # nothing is lost, nothing left


def odd_inputs_page():
    """docs/odd-inputs.md."""

    def plain(text):
        return "".join(c if c.isprintable() and c not in "|\udcff" else repr(c)[1:-1] for c in text)

    by_result = dict[str, list[str]]()
    for case, (*_, says) in FILES.items():
        by_result.setdefault("used" if says == USED else f"left out: {says}".rstrip(": "), []).append(case)
    places, end = {name: name.upper() for name in ("here", "photos", "videos", "archives")}, "\n"
    commands = [(case, words.format(**places), code, says) for case, (words, code, says) in COMMANDS.items()]
    return f"""# Odd inputs and their results

Each input is a test case of `tests/pipeline/test_odd_inputs.py`, which also checks this page.

## Files beside two good photos (exit code 0)

| inputs | result |
|---|---|
{"".join(f"| {', '.join(cases)} | {plain(says)} |{end}" for says, cases in by_result.items())}
## Refused inputs: one line and a hint

| input | `sfm-app run` | exit code | the line contains |
|---|---|---|---|
{"".join(f"| {case} | `{plain(words)}` | {code} | {plain(says)} |{end}" for case, words, code, says in commands)}"""


def test_the_page_of_odd_inputs_is_up_to_date():
    assert (
        (Path(__file__).parents[2] / "docs" / "odd-inputs.md").read_text(encoding="utf-8").startswith(odd_inputs_page())
    )
