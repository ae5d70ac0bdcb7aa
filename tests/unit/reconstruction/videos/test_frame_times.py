"""Frames of a video are known by their times, and their interval by their numbers."""

import pytest

from sfm_app.mapping.rolling_shutter import OPTIONS, frame_times
from sfm_app.types import MatchedImage


def frames(numbers, times=None, stem="clip_"):
    seconds = [number / 30.0 for number in numbers] if times is None else times
    return [
        MatchedImage(place, f"{stem}{number:06d}.jpg", "g", 640, 480, time_s=second)
        for place, (number, second) in enumerate(zip(numbers, seconds, strict=True), start=1)
    ]


def test_times_are_those_of_the_video_and_the_interval_that_of_its_frames():
    found = frame_times(frames(range(0, 60, 5)))

    assert found.interval == pytest.approx(1 / 30) and found.times[3] == pytest.approx(10 / 30)


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
