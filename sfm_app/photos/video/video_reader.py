"""Read a video frame by frame. FFmpeg opens one regular file, but no file or network address named in it."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.photos.decode import UnreadableError
from sfm_app.photos.video.video_formats import is_video, read_head

Picture = NDArray[np.uint8]

SMALL_PX = 480
"""Longer side of the pictures that frames are selected from."""
SAMPLES_PER_S = 30
"""Faster videos are subsampled to about this rate."""
FASTEST = 240
"""Frames per second; a higher rate in the file is taken as wrong."""
CUT_SHORT = 0.95
"""A file that ends before this share of its stated length is cut off or damaged."""
JPEG_QUALITY = 95

FFMPEG = {
    "OPENCV_FFMPEG_CAPTURE_OPTIONS": "protocol_whitelist;file|format_whitelist;mov,matroska,webm,avi,mpeg,mpegts",
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
}
"""Variables that OpenCV reads when it opens a file. Without the first, FFmpeg follows playlists and file patterns."""


@contextmanager
def open_video(path: Path) -> Iterator["Video"]:
    """Provide a video that is open for one pass, with FFmpeg's messages silenced.

    Raises:
        UnreadableError: the file is not a video, or nothing in it can be read.
    """
    place = path.resolve()  # FFmpeg takes a relative name with a colon for a protocol
    if not is_video(read_head(place)):
        raise UnreadableError("not a video")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        with _environment(FFMPEG):
            software = (cv2.CAP_PROP_HW_ACCELERATION, cv2.VIDEO_ACCELERATION_NONE)  # same pixels on every machine
            capture = cv2.VideoCapture(str(place), cv2.CAP_FFMPEG, software)
        if not capture.isOpened():
            raise UnreadableError("damaged, cut off, or of an unknown kind")
        yield Video(capture)
        capture.release()
    finally:
        cv2.utils.logging.setLogLevel(level)


class Video:
    """An open video, with its rotation applied; frames are numbered from 0."""

    def __init__(self, capture: cv2.VideoCapture) -> None:
        self._capture = capture
        self.rate = max(0.0, capture.get(cv2.CAP_PROP_FPS))
        """Frames per second as stated in the file; 0 if it is not."""
        self.claimed = max(0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        """Number of frames as stated in the file, which may be wrong."""
        self.frames = 0
        """Number of frames read so far."""
        self.seconds = 0.0
        """Timestamp of the last of them."""
        self.black = 0
        """Number of sampled frames that are entirely black, which is how OpenCV returns interlaced frames."""

    @property
    def stride(self) -> int:
        """Sampling interval in frames."""
        return max(1, round(self.rate / SAMPLES_PER_S)) if self.rate <= FASTEST else 1

    @property
    def sample_count(self) -> int:
        """Approximate number of frames that will be sampled."""
        return max(1, self.claimed // self.stride)

    @property
    def is_cut_short(self) -> bool:
        """Whether the file ended before its stated length; known once all frames were read."""
        if not (self.rate and self.claimed):
            return False
        # by time: a frame count that was derived from a wrong rate is wrong, too
        return self.seconds + 2 / self.rate < CUT_SHORT * self.claimed / self.rate

    def small_frames(self) -> Iterator[tuple[int, Picture]]:
        """Yield small gray pictures of the sampled frames, with their numbers."""
        size: tuple[int, int] | None = None
        for number in self._grab_frames():
            if number % self.stride:
                continue
            found, picture = self._capture.retrieve()
            if not found:
                continue
            if not picture.any():
                self.black += 1
                continue
            if size is None:
                shrunk = min(1.0, SMALL_PX / max(picture.shape[:2]))
                size = max(1, round(picture.shape[1] * shrunk)), max(1, round(picture.shape[0] * shrunk))
            yield number, _to_gray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA))

    def jpegs(self, numbers: Sequence[int]) -> Iterator[tuple[int, bytes]]:
        """Yield frames at full size as JPEG, with their numbers, in ascending order; fewer if the file has changed."""
        wanted = set(numbers)
        for number in self._grab_frames():
            if number in wanted:
                found, picture = self._capture.retrieve()
                if found:
                    yield number, cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
                wanted.remove(number)
            if not wanted:
                return

    def _grab_frames(self) -> Iterator[int]:
        """Yield frame numbers in order; a frame can be retrieved only until the next one is grabbed."""
        while self._capture.grab():
            self.frames += 1
            self.seconds = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            yield self.frames - 1


def _to_gray(picture: NDArray[np.uint8]) -> Picture:
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if picture.ndim == 3 else picture, np.uint8)


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables, and restore them afterwards."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
