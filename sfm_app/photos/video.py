"""Frames of a video: read, tracked and chosen."""

import os
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.photos.decode import UnreadableError
from sfm_app.photos.files import is_video, read_head
from sfm_app.types.arrays import BoolArray, FloatArray

# Read a video frame by frame. FFmpeg opens one regular file, but no file or network address named in it.

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


# Measure image motion and sharpness of a video, frame by frame.

Float32Array = NDArray[np.float32]

STEP = 0.05
"""One step of motion: the median displacement of the corners, as a share of the longer side."""
MAX_BLURRED_STEPS = 1.5
"""A blurred frame becomes a reference only after this many steps."""
LEAST_TRACKED = 0.6
"""Tracking a smaller share of the corners also counts as a step, since the overlap is shrinking."""
BLURRED = 0.5
"""A frame with less than this share of its neighbors' sharpness is blurred."""
RECENT = 30
"""Number of frames that sharpness is compared with; a blur longer than most of them counts as normal."""
SHARP_PERCENTILE = 80
"""Percentile of the recent sharpness that stands for a sharp frame, even if most are blurred."""
CORNERS = 200
MIN_CORNERS = 20
"""Motion is not estimated from fewer corners."""
FORWARD_BACKWARD_PX = 1.0
"""Largest forward-backward error of a tracked corner; beyond, it is lost."""
WINDOW_PX, LEVELS = 15, 3
"""Window and pyramid levels of the Lucas-Kanade method."""


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """Measurements of one frame."""

    frame: int
    """Frame number."""
    sharpness: float
    """Variance of the Laplacian; comparable only between neighboring frames."""
    path_steps: float
    """Accumulated motion from the first frame to this one, in steps."""


class CornerTracker:
    """Tracks corners from a reference to each frame; after one step, the next sharp frame becomes the reference.

    Frames are compared with the reference, not with the previous frame: otherwise noise and camera shake would add up
    to motion of a camera that stands still.
    """

    def __init__(self) -> None:
        self.seen = False
        """Whether any frame had enough corners to track."""
        self._passed = 0.0
        self._reference: Picture | None = None
        self._corners = np.zeros((0, 1, 2), np.float32)
        self._last = self._corners
        self._moved = 0.0
        self._recent: deque[float] = deque(maxlen=RECENT)

    def track(self, frame: int, gray: Picture) -> TrackedFrame:
        """Measure sharpness and accumulated motion of the next frame."""
        sharpness = float(cv2.Laplacian(gray, cv2.CV_32F).var())
        self._recent.append(sharpness)
        if self._reference is None or len(self._corners) < MIN_CORNERS:
            self._set_reference(gray)
            return TrackedFrame(frame, sharpness, self._passed)
        self._moved, followed = self._track_corners(self._reference, gray)
        # corners lost to blur reappear later, so they do not count as lost overlap
        blurred = sharpness < BLURRED * float(np.percentile(self._recent, SHARP_PERCENTILE))
        lost = 0.0 if blurred else min(1.0, (1 - followed) / (1 - LEAST_TRACKED))
        part = max(self._moved / STEP, lost)
        way = self._passed + part
        if part >= (MAX_BLURRED_STEPS if blurred else 1.0):
            self._passed = way
            self._set_reference(gray)
        return TrackedFrame(frame, sharpness, way)

    def _set_reference(self, gray: Picture) -> None:
        corners = cv2.goodFeaturesToTrack(gray, CORNERS, qualityLevel=0.01, minDistance=max(gray.shape) / 60)
        self._reference, self._moved = gray, 0.0
        self._corners = np.zeros((0, 1, 2), np.float32) if corners is None else np.asarray(corners, np.float32)
        self._last = self._corners
        self.seen = self.seen or len(self._corners) >= MIN_CORNERS

    def _track_corners(self, reference: Picture, gray: Picture) -> tuple[float, float]:
        """Return the median displacement of the corners, in longer sides, and the share of corners that are tracked."""
        there, found = _optical_flow(reference, gray, self._corners, self._last)
        back, found_back = _optical_flow(gray, reference, there, self._corners)
        off = np.linalg.norm(back - self._corners, axis=2)[:, 0]
        inside = np.all((there[:, 0] >= 0) & (there[:, 0] < gray.shape[::-1]), axis=1)
        alive = found & found_back & (off < FORWARD_BACKWARD_PX) & inside
        if np.count_nonzero(alive) < MIN_CORNERS:
            return self._moved, float(np.mean(alive))
        flow = (there - self._corners)[alive, 0]
        # the next search for lost corners starts from the median flow
        self._last = np.where(alive[:, None, None], there, self._corners + np.median(flow, axis=0)).astype(np.float32)
        return float(np.median(np.linalg.norm(flow, axis=1))) / max(gray.shape), float(np.mean(alive))


def _optical_flow(
    before: Picture, after: Picture, points: Float32Array, guess: Float32Array
) -> tuple[Float32Array, BoolArray]:
    """Find points (N, 1, 2) of one picture in another; return their positions and whether each was found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, guess.copy(),
        winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return there, found[:, 0] > 0


# Select the frames of a video that become photos: the sharpest frame around each step of motion.

NEAR, FAR = 0.25, 0.5
"""The sharpest frame is searched within NEAR steps on either side; within FAR steps if those are all blurred."""
GAP = 1.5
"""Longest gap between chosen frames, in steps, while all frames are blurred; then a blurred one is chosen."""
HARDLY_MOVED, LESS_SHARP, TOO_MANY = "hardly moved on", "less sharp than a neighbor", "more than max_frames"


@dataclass(frozen=True, slots=True)
class Choice:
    """Chosen frames in ascending order, and why the others were not chosen."""

    frames: tuple[int, ...]
    left_out: dict[str, int]
    """Number of frames by reason; each measured frame is either chosen or counted once."""


def select_keyframes(looks: Sequence[TrackedFrame], most: int) -> Choice:
    """Choose one frame per step of motion; the spacing grows if that would be more than `most` frames.

    Args:
        looks, most: measurements of the frames, in order; largest number of chosen frames, >= 2.
    """
    way = np.array([look.path_steps for look in looks], np.float64)
    sharpness = np.array([look.sharpness for look in looks], np.float64)
    if not len(way):
        return Choice((), {})
    every, near = sharpest_frames(way, sharpness, 1.0)
    chosen = every
    if len(every) > most:
        chosen, near = sharpest_frames(way, sharpness, float(way.max()) / (most - 1) * (1 - 1e-12))
    others = set(range(len(looks))) - set(chosen)
    too_many = others & set(every)
    less_sharp = (others & near) - too_many
    counts = {
        HARDLY_MOVED: len(others) - len(too_many) - len(less_sharp),
        LESS_SHARP: len(less_sharp),
        TOO_MANY: len(too_many),
    }
    return Choice(tuple(looks[k].frame for k in chosen), {reason: count for reason, count in counts.items() if count})


def sharpest_frames(way: FloatArray, sharpness: FloatArray, spacing: float) -> tuple[list[int], set[int]]:
    """Return the sharpest frame around every multiple of a spacing, and all candidates.

    Args:
        way, sharpness: (N,) accumulated motion in steps, (N,) sharpness.
        spacing: steps, >= 1.
    """
    chosen: list[int] = []
    candidates: set[int] = set()
    for target in np.arange(0.0, way.max() + 1e-9, spacing):
        moment = int(np.argmax(way >= min(target, way.max())))
        if chosen and moment <= chosen[-1]:
            continue
        first = chosen[-1] + 1 if chosen else 0
        near = _nearby_frames(way, moment, target, NEAR, first)
        sharp = BLURRED * sharpness[_nearby_frames(way, moment, target, 1.0, 0)].max()
        best = _sharpest_frame(sharpness, near)
        if sharpness[best] < sharp:
            best = _sharpest_frame(sharpness, _nearby_frames(way, moment, target, FAR, first))
        candidates.update(map(int, near))
        if sharpness[best] >= sharp or not chosen or way[best] - way[chosen[-1]] >= GAP:
            chosen.append(best)
    return chosen, candidates


def _sharpest_frame(sharpness: FloatArray, frames: NDArray[np.int64]) -> int:
    return int(frames[np.argmax(sharpness[frames])])


def _nearby_frames(way: FloatArray, moment: int, target: float, reach: float, first: int) -> NDArray[np.int64]:
    """Return the consecutive frames around a moment whose accumulated motion lies within reach of the target."""
    outside = np.abs(way - target) > reach
    outside[:first] = True
    before = np.flatnonzero(outside[:moment])
    after = np.flatnonzero(outside[moment + 1 :])
    start = int(before[-1]) + 1 if len(before) else 0
    end = moment + 1 + int(after[0]) if len(after) else len(way)
    return np.arange(max(start, first), end, dtype=np.int64)
