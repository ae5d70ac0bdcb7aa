"""The shutter of a synthetic video is followed where there is one, and else the model stays as it is."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.common.metrics import pose_errors_deg
from benchmarks.synthetic.walks import WalkOptions
from benchmarks.videos.sequences import Kind, draw_sequence, map_sequence
from benchmarks.videos.shutter import timed_matches
from sfm_app.colmap.bundle import Adjustment, adjust
from sfm_app.colmap.model import posed_images
from sfm_app.mapping import rolling_shutter
from sfm_app.mapping.rolling_shutter import OPTIONS, Readout, follow_shutter, frame_times
from sfm_app.progress import Progress
from sfm_app.types import MatchedImage, MatchGraph

KIND = Kind(walk=WalkOptions(swing_deg_s=60.0), frames=16, points=400)


@dataclass(frozen=True)
class Video:
    """Frames of a video after the last adjustment, which knows of no shutter."""

    adjusted: Adjustment
    matches: MatchGraph
    database: Path
    truth: dict[str, np.ndarray]


class Said(Progress):
    """A display that keeps its messages."""

    def __init__(self):
        self.texts = []

    def say(self, text):
        self.texts.append(text)


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    """Makes a video with a readout in seconds."""

    def shoot(readout_s):
        sequence = draw_sequence(KIND, readout_s, 0)
        model, database = map_sequence(sequence, 0, tmp_path_factory.mktemp("video"))
        adjusted = adjust(model, database)
        matches = timed_matches(adjusted.model, sequence.times_s)
        return Video(adjusted, matches, database, dict(sequence.drawn.views.cam_from_world))

    return shoot


@pytest.fixture(scope="module")
def still(video):
    """A video with a global shutter."""
    return video(0.0)


def follow(video, said=None):
    return follow_shutter(video.adjusted, video.matches, video.database, said or Said())


def turn_errors_deg(found, truth):
    poses = {image.name: np.asarray(image.cam_from_world().matrix()) for image in posed_images(found.model)}
    return float(np.median(pose_errors_deg(poses, truth)))


@pytest.mark.slow
def test_a_rolling_shutter_is_measured_and_its_poses_are_put_right(video):
    rolling, said = video(0.02), Said()
    straight, found = follow(rolling, said)
    assert isinstance(found, Readout) and not found.refused
    assert found.readout == pytest.approx(0.02, rel=0.1)
    assert abs(found.readout - 0.02) < 3.0 * found.deviation
    assert 1e-4 < found.deviation < 0.003
    assert found.interval == pytest.approx(1 / 30)
    assert turn_errors_deg(straight, rolling.truth) < 0.5 * turn_errors_deg(rolling.adjusted, rolling.truth)
    assert said.texts == ["measuring the shutter of the video, with 16 frames"]


@pytest.mark.slow
def test_a_global_shutter_is_measured_and_left_alone(still):
    model, found = follow(still)
    assert model is still.adjusted
    assert found.refused == "it is not significant" and found.to_dict()["because"] == "it is not significant"
    assert abs(found.readout) < 3.0 * found.deviation < 0.01


@pytest.mark.slow
def test_photos_of_a_folder_have_no_shutter_to_follow(still):
    images = {key: replace(image, time_s=None) for key, image in still.matches.images.items()}
    said = Said()
    model, found = follow(replace(still, matches=MatchGraph(images, {}, {})), said)
    assert model is still.adjusted and found is None and not said.texts


@pytest.mark.slow
def test_a_model_that_could_not_be_adjusted_is_not_asked(still):
    failed = replace(still.adjusted, failure="it diverged")
    assert follow(replace(still, adjusted=failed)) == (failed, None)


@pytest.mark.slow
def test_too_many_frames_are_not_asked_and_the_reason_is_given(still, monkeypatch):
    monkeypatch.setattr(rolling_shutter.OPTIONS, "max_frames", KIND.frames - 1)
    said = Said()
    model, found = follow(still, said)
    assert model is still.adjusted and not said.texts
    assert found.to_dict() == {
        "compensated": False, "because": "more than 15 frames would take too long to measure"
    }  # fmt: skip


def frames(numbers, times=None, stem="clip_"):
    seconds = [number / 30.0 for number in numbers] if times is None else times
    return [
        MatchedImage(place, f"{stem}{number:06d}.jpg", "g", 640, 480, time_s=second)
        for place, (number, second) in enumerate(zip(numbers, seconds, strict=True), start=1)
    ]


def test_times_are_those_of_the_video_and_the_interval_that_of_its_frames():
    times, interval = frame_times(frames(range(0, 60, 5)))
    assert interval == pytest.approx(1 / 30) and times[3] == pytest.approx(10 / 30)


@pytest.mark.parametrize(
    "images",
    [
        frames(range(OPTIONS.min_frames - 1)),
        frames(range(20), times=[None] * 20),
        frames(range(20), times=[*(k / 30 for k in range(19)), None]),
        frames(range(20), times=[0.0] * 20),
        [*frames(range(20)), *frames([30], stem="other_")],
    ],
    ids=["few", "photos", "a photo among frames", "stopped clock", "two videos"],
)
def test_other_photos_have_no_times(images):
    assert frame_times(images) is None
