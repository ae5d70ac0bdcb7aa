"""Videos: reading frame by frame, motion of the camera, and the choice of frames."""

import os
import struct
import subprocess
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfm_app.photos import video
from sfm_app.photos.decode import UnreadableError
from sfm_app.photos.files import is_video, read_head
from sfm_app.photos.video import CornerTracker, TrackedFrame, open_video, select_keyframes

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


pytestmark = pytest.mark.slow

VIEW = VIEW_WIDTH, VIEW_HEIGHT = 240, 160
STEP_PX = 0.05 * VIEW_WIDTH


@pytest.fixture(scope="module")
def wall():
    """A wide texture."""
    blots = np.random.default_rng(1).integers(0, 255, (VIEW_HEIGHT, 2400)).astype(np.uint8)
    return cv2.GaussianBlur(blots, (0, 0), 2.0)


def film(wall, places, blurred=(), noise=0.0):
    """What frames from these places show."""
    rng = np.random.default_rng(2)
    for k, at in enumerate(places):
        shift = np.array([[1.0, 0.0, -at], [0.0, 1.0, 0.0]])
        frame = cv2.warpAffine(wall, shift, VIEW, flags=cv2.INTER_LINEAR).astype(np.float64)
        if k in blurred:
            frame = cv2.GaussianBlur(frame, (0, 0), 3.0)
        yield np.clip(frame + rng.normal(0, noise, frame.shape), 0, 255).astype(np.uint8)


def looks_at(frames):
    follower = CornerTracker()
    return [follower.track(k, frame) for k, frame in enumerate(frames)]


@pytest.fixture(scope="module")
def slide(wall):
    """FaceViews at 600 pixels of the way, three for each frame."""
    return looks_at(film(wall, np.arange(0, 600, 3.0)))


def chosen_from(frames, most=100):
    return list(select_keyframes(looks_at(frames), most).frames)


@pytest.mark.parametrize("speed_px", [0.7, 2.5, 5.0])
def test_frames_are_one_step_apart(wall, speed_px):
    places = np.arange(0, 60 + 100 * speed_px, speed_px)
    gaps = np.diff(places[chosen_from(film(wall, places))])
    assert gaps.min() >= 0.5 * STEP_PX - speed_px
    assert gaps.max() <= 1.5 * STEP_PX + speed_px
    assert 0.9 * STEP_PX < gaps.mean() < 1.1 * STEP_PX


@pytest.mark.parametrize(
    ("speed_px", "blurred"), [(2.0, range(1, 400, 2)), (2.0, range(40, 44)), (9.0, range(1, 99, 2))]
)
def test_a_blurred_frame_is_not_chosen_beside_a_sharp_one(wall, speed_px, blurred):
    places = np.arange(0, 300, speed_px)
    chosen = chosen_from(film(wall, places, blurred))
    assert not set(chosen) & set(blurred)
    assert len(chosen) >= 0.9 * 300 / max(STEP_PX, 2 * speed_px)


def test_where_all_is_blurred_the_overlap_is_kept(wall):
    places = np.arange(0, 400, 4.0)
    blurred = range(30, 75)
    chosen = chosen_from(film(wall, places, blurred))
    assert any(k in blurred for k in chosen)
    assert np.diff(places[chosen]).max() < 2.5 * STEP_PX


@pytest.mark.parametrize("noise", [0.0, 10.0])
def test_a_camera_that_stands_gives_one_frame(wall, noise):
    shaking = 300 + np.random.default_rng(3).uniform(-2.0, 2.0, 150)
    assert len(chosen_from(film(wall, shaking, range(40, 60), noise))) == 1


def test_a_rest_adds_nothing(wall):
    ways = np.arange(0, 200, 4.0), np.arange(200, 400, 4.0)
    rest = np.full(120, 200.0)
    without = chosen_from(film(wall, np.concatenate(ways)))
    resting = chosen_from(film(wall, np.concatenate([ways[0], rest, ways[1]]), noise=3.0))
    assert abs(len(resting) - len(without)) <= 1
    assert sum(len(ways[0]) <= k < len(ways[0]) + len(rest) for k in resting) <= 1


@pytest.mark.parametrize("most", [2, 5, 17])
def test_no_more_than_wanted_and_evenly(slide, most):
    places = np.arange(0, 600, 3.0)
    choice = select_keyframes(slide, most)
    gaps = np.diff(places[list(choice.frames)])
    assert len(choice.frames) == most
    assert gaps.max() < 600 / (most - 1) + STEP_PX + 3
    assert gaps.min() > 0.5 * 600 / (most - 1) - STEP_PX
    assert choice.rejected["more than max_frames"] == pytest.approx(
        len(select_keyframes(slide, 2000).frames) - most, abs=most
    )


def test_every_shot_of_a_cut_video_is_seen(wall):
    shots = np.repeat([0.0, 700.0, 1400.0], 20)
    chosen = chosen_from(film(wall, shots))
    assert [k // 20 for k in chosen] == [0, 1, 2]


def test_where_every_frame_shows_something_else_all_are_taken(wall):
    assert chosen_from(film(wall, np.arange(0, 2000, 130.0))) == list(range(16))


def test_forward_and_back_counts_both_ways(wall):
    there = np.arange(0, 240, 3.0)
    chosen = chosen_from(film(wall, np.concatenate([there, there[::-1]])))
    assert 2 * 240 / STEP_PX - 3 <= len(chosen) <= 2 * 240 / STEP_PX + 1


@pytest.mark.parametrize("value", [0, 255])
def test_an_empty_picture_shows_nothing_to_follow(value):
    follower = CornerTracker()
    looks = [follower.track(k, np.full((VIEW_HEIGHT, VIEW_WIDTH), value, np.uint8)) for k in range(5)]
    assert not follower.has_texture
    assert [look.path_steps for look in looks] == [0.0] * 5


@given(st.lists(st.tuples(st.floats(0, 1e5), st.floats(-0.9, 1.2)), min_size=1, max_size=60), st.integers(2, 20))
def test_any_looks_give_a_choice_in_order(steps, most):
    way = np.maximum(0.0, np.cumsum([step for _, step in steps]) - steps[0][1])
    looks = [TrackedFrame(3 * k, sharp, float(at)) for k, ((sharp, _), at) in enumerate(zip(steps, way, strict=True))]
    choice = select_keyframes(looks, most)
    assert 1 <= len(choice.frames) <= most
    assert list(choice.frames) == sorted(set(choice.frames))
    assert set(choice.frames) <= {look.frame for look in looks}
    assert len(choice.frames) + sum(choice.rejected.values()) == len(looks)
    assert min(choice.rejected.values(), default=1) > 0
