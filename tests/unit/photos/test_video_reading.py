import os
import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest

from sfm_app.photos import video
from sfm_app.photos.decode import UnreadableError
from sfm_app.photos.files import is_video, read_head
from sfm_app.photos.video import open_video

pytestmark = pytest.mark.slow

SIZE = WIDTH, HEIGHT = 160, 96
COUNT = 24


def write(path, code="MJPG", count=COUNT):
    """Frames of a growing gray; the left half is darker."""
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*code), 30.0, SIZE)
    for k in range(count):
        picture = np.full((HEIGHT, WIDTH, 3), 80 + 6 * k, np.uint8)
        picture[:, : WIDTH // 2] //= 2
        writer.write(picture)
    writer.release()
    return path


def brightness(path, numbers):
    with open_video(path) as found:
        return {number: decoded(data)[:, -20:].mean() for number, data in found.jpegs(numbers)}


def decoded(data):
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


CONTAINERS = [
    ("a.avi", "MJPG"), ("a.mp4", "mp4v"), ("a.mov", "mp4v"), ("a.mkv", "MJPG"), ("a.webm", "VP80"), ("a.ts", "mp4v"),
    ("a.mpg", "MPG1"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "code"), CONTAINERS)
def test_frames_keep_their_numbers(tmp_path, name, code):
    path = write(tmp_path / name, code)

    assert is_video(read_head(path))
    with open_video(path) as found:
        small = list(found.small_frames())
    assert found.frames == COUNT and not found.is_cut_short
    assert [number for number, _ in small] == list(range(COUNT))
    assert all(picture.shape == (HEIGHT, WIDTH) for _, picture in small)
    full = brightness(path, [3, 10, 23])
    assert full == pytest.approx({3: 98, 10: 140, 23: 218}, abs=4)


def test_large_frames_are_looked_at_small_and_kept_whole(tmp_path):
    writer = cv2.VideoWriter(
        str(tmp_path / "a.avi"), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"MJPG"), 120.0, (960, 720)
    )
    for _ in range(9):
        writer.write(np.full((720, 960, 3), 90, np.uint8))
    writer.release()

    with open_video(tmp_path / "a.avi") as found:
        small = list(found.small_frames())
    with open_video(tmp_path / "a.avi") as found:
        full = list(found.jpegs([5]))

    assert [number for number, _ in small] == [0, 4, 8]  # 30 in a second
    assert {picture.shape for _, picture in small} == {(360, 480)}
    assert [decoded(data).shape for _, data in full] == [(720, 960, 3)]


def test_phones_that_were_turned_give_upright_frames(tmp_path):
    data = bytearray(write(tmp_path / "a.mp4", "mp4v").read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40
    data[matrix : matrix + 36] = struct.pack(">9i", 0, 1 << 16, 0, -(1 << 16), 0, 0, HEIGHT << 16, 0, 1 << 30)
    (tmp_path / "a.mp4").write_bytes(data)

    with open_video(tmp_path / "a.mp4") as found:
        _, picture = next(found.small_frames())

    assert picture.shape == (WIDTH, HEIGHT)
    assert picture[:20].mean() < 0.6 * picture[-20:].mean()  # what was left is up


def cut(path):
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 6 // 10])


@pytest.mark.parametrize(("name", "code"), [("a.avi", "MJPG"), ("a.mkv", "MJPG"), ("a.webm", "VP80")])
def test_what_comes_before_the_damage_is_read(tmp_path, name, code):
    path = write(tmp_path / name, code)
    cut(path)

    with open_video(path) as found:
        frames = len(list(found.small_frames()))

    assert 5 <= frames <= 20
    assert found.is_cut_short


def test_a_file_without_its_index_is_damaged(tmp_path):
    path = write(tmp_path / "a.mp4", "mp4v")
    cut(path)

    with pytest.raises(UnreadableError, match="damaged"), open_video(path):
        pass


def test_ffmpeg_is_silent(tmp_path):
    """In a process of its own: FFmpeg learns how much to say when it is first used."""
    paths = [write(tmp_path / name, code) for name, code in (("a.avi", "MJPG"), ("a.mkv", "MJPG"), ("a.mp4", "mp4v"))]
    script = "import sys, pathlib, contextlib; from sfm_app.photos.decode import UnreadableError\n"
    script += "from sfm_app.photos.video import open_video\n"
    script += "for name in sys.argv[1:]:\n"
    script += " with contextlib.suppress(UnreadableError), open_video(pathlib.Path(name)) as found:\n"
    script += "  print(len(list(found.small_frames())))"
    for path in paths:
        cut(path)

    done = subprocess.run([sys.executable, "-c", script, *paths], capture_output=True, text=True, check=True)

    assert done.stderr == ""
    assert len(done.stdout.split()) == 2


@pytest.mark.parametrize("name", ["img%03d.avi", "concat:a.avi", "http:a.avi", "-i.avi", "*.avi", "\u00e4 b.avi"])
def test_a_name_is_but_a_name(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "plain.avi").rename(tmp_path / name)

    with open_video((tmp_path / name).relative_to(tmp_path)) as found:
        assert len(list(found.small_frames())) == COUNT


LISTS = {
    "ffconcat": "ffconcat version 1.0\nfile {}\n",
    "m3u8": "#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{}\n#EXT-X-ENDLIST\n",
    "sdp": "v=0\no=- 0 0 IN IP4 127.0.0.1\nc=IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
}


@pytest.mark.parametrize("kind", LISTS)
@pytest.mark.parametrize("ending", ["mp4", "list"])
def test_lists_of_other_files_are_not_followed(tmp_path, monkeypatch, kind, ending):
    write(tmp_path / "a.ts", "mp4v")
    path = tmp_path / f"x.{kind if ending == 'list' else ending}"
    path.write_text(LISTS[kind].format("a.ts"))

    with pytest.raises(UnreadableError, match="not a video"), open_video(path):
        pass
    monkeypatch.setattr(video, "is_video", bool)  # and FFmpeg would not, either
    with pytest.raises(UnreadableError, match="damaged"), open_video(path):
        pass


def test_nothing_but_regular_files_is_opened(tmp_path):
    os.mkfifo(tmp_path / "pipe.mp4")

    assert not is_video(read_head(tmp_path / "pipe.mp4"))
    assert not is_video(read_head(tmp_path))
    assert not is_video(read_head(tmp_path / "nothing.mp4"))


def test_other_users_of_opencv_notice_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", "rtsp_transport;tcp")
    monkeypatch.delenv("OPENCV_FFMPEG_LOGLEVEL", raising=False)
    before = dict(os.environ), cv2.utils.logging.getLogLevel()

    with open_video(write(tmp_path / "a.avi")) as found:
        next(found.small_frames())

    assert (dict(os.environ), cv2.utils.logging.getLogLevel()) == before


HEADS = {
    "heic": b"\0\0\0\x18ftypheic", "avif": b"\0\0\0\x18ftypavif", "raw": b"\0\0\0\x18ftypcrx ",
    "sound": b"RIFF\0\0\0\0WAVE",
    "webp": b"RIFF\0\0\0\0WEBP", "jpeg": b"\xff\xd8\xff\xe0", "G": b"G" + bytes(399), "empty": b"",
}  # fmt: skip


@pytest.mark.parametrize("kind", HEADS)
def test_photos_and_sound_are_no_videos(kind):
    assert not is_video(HEADS[kind].ljust(400, b"\0") if HEADS[kind] else b"")
