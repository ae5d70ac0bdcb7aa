"""The chosen frames of a video as a folder of photos."""

import json
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from PIL import Image

from sfm_app.errors import InputError
from sfm_app.plugins import load_plugins
from sfm_app.runtime.context import RunContext
from sfm_app.runtime.parallel import make_executor
from sfm_app.runtime.workspace import Workspace
from sfm_app.settings import Settings
from sfm_app.stages.photos import frame_stem, video_frames

pytestmark = pytest.mark.slow

SIZE = WIDTH, HEIGHT = 160, 96


@pytest.fixture
def run(tmp_path):
    workspace = Workspace(tmp_path / "out")
    workspace.create()
    with make_executor(1) as executor:
        yield RunContext(Settings(), workspace, load_plugins(installed=False), executor, 1, fingerprint="one")


@pytest.fixture
def clip(tmp_path):
    """Twenty frames of a wall that slides by, half a step each."""
    return write(tmp_path / "clip.avi", range(0, 80, 4))


def pictures(places):
    wall = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 255, (HEIGHT, 400, 3)).astype(np.uint8), (0, 0), 1.5)
    for at in places:
        yield np.ascontiguousarray(wall[:, at : at + WIDTH])


def write(path, places):
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"MJPG"), 30.0, SIZE)
    for picture in pictures(places):
        writer.write(picture)
    writer.release()
    return path


def frames_of(source, run):
    with video_frames(source, run):
        return sorted(path.name for path in run.workspace.frames.iterdir())


def test_a_video_becomes_a_folder_of_frames_with_their_times(clip, run):
    with video_frames(clip, run) as times_s:
        numbers = {path.name: int(path.stem.removeprefix("clip_")) for path in run.workspace.frames.glob("*.jpg")}

    counts = run.statistics["video"]
    assert 9 <= len(numbers) <= 11
    assert times_s == pytest.approx({name: number / 30 for name, number in numbers.items()}, abs=0.002)
    with Image.open(run.workspace.frames / next(iter(numbers))) as frame:
        assert frame.size == SIZE
    assert counts["frames"] == counts["looked_at"] == 20
    assert counts["chosen"] == len(numbers) == 20 - sum(counts["left_out"].values())
    assert counts["seconds"] == pytest.approx(19 / 30, abs=0.05)
    assert not run.workspace.frames_marker.exists()


class KilledError(Exception):
    pass


def killed(source, run):
    with pytest.raises(KilledError), video_frames(source, run):
        raise KilledError


def test_a_killed_run_does_not_choose_again(clip, run):
    killed(clip, run)
    marker = json.loads(run.workspace.frames_marker.read_text())
    for part in ("frames", "times_s"):
        marker[part] = marker[part][:3]  # nobody would choose so
    run.workspace.frames_marker.write_text(json.dumps(marker))
    first, second = sorted(run.workspace.frames.iterdir())[:2]
    second.unlink()
    second.with_name(f".{second.stem}.123.jpg").write_bytes(b"half")
    stamp = first.stat().st_mtime_ns

    killed(clip, run)

    assert len(json.loads(run.workspace.frames_marker.read_text())["frames"]) == 3
    assert not list(run.workspace.frames.glob(".*"))
    assert second.exists() and first.stat().st_mtime_ns == stamp


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"made_from": "one"}', '{"made_from": "one", "frames": 3, "counts": 0}']
)
def test_a_marker_that_cannot_be_read_counts_as_none(clip, run, text):
    run.workspace.frames_marker.write_text(text)
    assert len(frames_of(clip, run)) >= 9


def test_other_inputs_choose_anew(clip, tmp_path, run):
    killed(clip, run)
    assert len(frames_of(write(clip, range(0, 40, 4)), run.with_fingerprint("another"))) <= 6


def test_a_video_that_is_cut_off_says_so(clip, run):
    data = clip.read_bytes()
    clip.write_bytes(data[: len(data) * 7 // 10])
    names = frames_of(clip, run)
    assert 5 <= len(names) <= 8
    assert "cut off" in run.statistics["video"]["notes"][0]


def test_what_was_done_to_the_frames_is_noted(tmp_path, run):
    with av.open(str(tmp_path / "clip.ts"), "w") as made:
        stream = made.add_stream("mpeg2video", rate=25, options={"flags": "+ildct+ilme"})
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = *SIZE, "yuv420p", 4_000_000
        stream.sample_aspect_ratio = Fraction(16, 11)
        for picture in pictures(range(0, 80, 4)):
            made.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "bgr24")))
        made.mux(stream.encode())

    names = frames_of(tmp_path / "clip.ts", run)

    assert 9 <= len(names) <= 11
    assert [note.split()[-1] for note in run.statistics["video"]["notes"]] == ["deinterlaced", "square"]
    with Image.open(run.workspace.frames / names[0]) as frame:
        assert frame.size == (round(2.21 * HEIGHT), HEIGHT)  # of MPEG-2's four ratios, the nearest


def test_a_video_without_frames_names_its_codec(tmp_path, run):
    write(tmp_path / "clip.avi", range(0, 80, 4))
    (tmp_path / "clip.avi").write_bytes((tmp_path / "clip.avi").read_bytes()[:6000])
    with pytest.raises(InputError, match="no frame of its mjpeg, of at most 67 megapixels"):
        frames_of(tmp_path / "clip.avi", run)


@pytest.mark.parametrize(
    ("name", "stem"),
    [("a b.mp4", "a b"), (".clip.mp4", "clip"), ("..mp4", "frame"), ("x\ny\udcff.mp4", "x_y_"),
     ("x" * 200 + ".mp4", "x" * 40)],
)  # fmt: skip
def test_frames_have_names_that_can_be_used(tmp_path, name, stem):
    assert frame_stem(tmp_path / name) == stem
