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
from sfm_app.photos.panoramas import shrink
from sfm_app.types.arrays import BoolArray, FloatArray

Picture = NDArray[np.uint8]
Float32Array = NDArray[np.float32]

BLURRED = 0.5
"""A frame with less than this share of its neighbors' sharpness is blurred."""
MIN_CORNERS = 20
"""Motion is not estimated from fewer corners."""

FFMPEG = {
    "OPENCV_FFMPEG_CAPTURE_OPTIONS": "protocol_whitelist;file|format_whitelist;mov,matroska,webm,avi,mpeg,mpegts",
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
}
"""Variables that OpenCV reads when it opens a file. Without the first, FFmpeg follows playlists and file patterns."""


@contextmanager
def open_video(path: Path) -> Iterator["Video"]:
    """Provide a video that is open for one pass, with FFmpeg silenced; raise an UnreadableError if there is none."""
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
        """Number of entirely black sampled frames; OpenCV returns interlaced frames black."""

    @property
    def stride(self) -> int:
        """Sampling interval in frames, for about 30 samples per second; rates above 240 are taken as wrong."""
        return max(1, round(self.rate / 30)) if self.rate <= 240 else 1

    @property
    def is_cut_short(self) -> bool:
        """Whether the file ended before 95 % of its stated length; valid once all frames are read."""
        if not (self.rate and self.claimed):
            return False
        # by time: a frame count derived from a wrong rate is wrong, too
        return self.seconds + 2 / self.rate < 0.95 * self.claimed / self.rate

    def small_frames(self) -> Iterator[tuple[int, Picture]]:
        """Yield gray pictures of the sampled frames, with a longer side of 480 pixels, with their numbers."""
        for number in self._grab_frames():
            if number % self.stride:
                continue
            decoded, picture = self._capture.retrieve()
            if not decoded:
                continue
            if not picture.any():
                self.black += 1
                continue
            small = shrink(picture, 480 / max(picture.shape[:2]))
            yield number, np.asarray(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY) if small.ndim == 3 else small, np.uint8)

    def jpegs(self, numbers: Sequence[int]) -> Iterator[tuple[int, bytes]]:
        """Yield these frames at full size as JPEG, in ascending order; fewer if the file has changed."""
        missing = set(numbers)
        for number in self._grab_frames():
            if number in missing:
                decoded, picture = self._capture.retrieve()
                if decoded:
                    yield number, cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
                missing.remove(number)
            if not missing:
                return

    def _grab_frames(self) -> Iterator[int]:
        """Yield frame numbers; each frame can be retrieved until the next one is grabbed."""
        while self._capture.grab():
            self.frames += 1
            self.seconds = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
            yield self.frames - 1


@contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
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


@dataclass(frozen=True, slots=True)
class TrackingOptions:
    """Constants of the measurement of motion and sharpness."""

    step: float = 0.05
    """One step of motion: the median displacement of the corners, as a share of the longer side."""
    max_blurred_steps: float = 1.5
    """A blurred frame becomes the reference only after this many steps."""
    min_tracked: float = 0.6
    """Tracking a smaller share of the corners also counts as a step, since the overlap shrinks."""
    recent: int = 30
    """Number of frames that sharpness is compared with; a blur longer than most of them counts as normal."""
    sharp_percentile: int = 80
    """Percentile of the recent sharpness that stands for a sharp frame, even if most are blurred."""
    corners: int = 200
    forward_backward_px: float = 1.0
    """Largest forward-backward error of a tracked corner."""
    window_px: int = 15
    """Window of the Lucas-Kanade method."""
    levels: int = 3
    """Its pyramid levels."""


OPTIONS = TrackingOptions()


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """Measurements of one frame."""

    frame: int
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
        self.has_texture = False
        """Whether any frame had enough corners to track."""
        self._reference_steps = 0.0
        self._reference: Picture | None = None
        self._corners = np.zeros((0, 1, 2), np.float32)
        self._last = self._corners
        self._motion = 0.0
        self._recent: deque[float] = deque(maxlen=OPTIONS.recent)

    def track(self, frame: int, gray: Picture) -> TrackedFrame:
        """Measure sharpness and accumulated motion of the next frame, a gray picture (H, W) of constant size."""
        sharpness = float(cv2.Laplacian(gray, cv2.CV_32F).var())
        self._recent.append(sharpness)
        if self._reference is None or len(self._corners) < MIN_CORNERS:
            self._set_reference(gray)
            return TrackedFrame(frame, sharpness, self._reference_steps)
        self._motion, tracked = self._track_corners(self._reference, gray)
        # corners lost to blur reappear later, so they do not count as lost overlap
        blurred = sharpness < BLURRED * float(np.percentile(self._recent, OPTIONS.sharp_percentile))
        lost = 0.0 if blurred else min(1.0, (1 - tracked) / (1 - OPTIONS.min_tracked))
        steps = max(self._motion / OPTIONS.step, lost)
        path_steps = self._reference_steps + steps
        if steps >= (OPTIONS.max_blurred_steps if blurred else 1.0):
            self._reference_steps = path_steps
            self._set_reference(gray)
        return TrackedFrame(frame, sharpness, path_steps)

    def _set_reference(self, gray: Picture) -> None:
        corners = cv2.goodFeaturesToTrack(gray, OPTIONS.corners, qualityLevel=0.01, minDistance=max(gray.shape) / 60)
        self._reference, self._motion = gray, 0.0
        self._corners = np.zeros((0, 1, 2), np.float32) if corners is None else np.asarray(corners, np.float32)
        self._last = self._corners
        self.has_texture = self.has_texture or len(self._corners) >= MIN_CORNERS

    def _track_corners(self, reference: Picture, gray: Picture) -> tuple[float, float]:
        """Return the median displacement of the corners in longer sides, and the share of tracked corners."""
        forward, found = _optical_flow(reference, gray, self._corners, self._last)
        back, found_back = _optical_flow(gray, reference, forward, self._corners)
        error = np.linalg.norm(back - self._corners, axis=2)[:, 0]
        inside = np.all((forward[:, 0] >= 0) & (forward[:, 0] < gray.shape[::-1]), axis=1)
        tracked = found & found_back & (error < OPTIONS.forward_backward_px) & inside
        if np.count_nonzero(tracked) < MIN_CORNERS:
            return self._motion, float(np.mean(tracked))
        flow = (forward - self._corners)[tracked, 0]
        # the next search for lost corners starts from the median flow
        guess = np.where(tracked[:, None, None], forward, self._corners + np.median(flow, axis=0))
        self._last = guess.astype(np.float32)
        return float(np.median(np.linalg.norm(flow, axis=1))) / max(gray.shape), float(np.mean(tracked))


def _optical_flow(
    before: Picture, after: Picture, points: Float32Array, guess: Float32Array
) -> tuple[Float32Array, BoolArray]:
    """Find points (N, 1, 2) of one picture in another; return their positions, and (N,) whether each was found."""
    positions, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, guess.copy(),
        winSize=(OPTIONS.window_px, OPTIONS.window_px), maxLevel=OPTIONS.levels, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return positions, found[:, 0] > 0


@dataclass(frozen=True, slots=True)
class Choice:
    """Chosen frames in ascending order, and why the others were not chosen."""

    frames: tuple[int, ...]
    rejected: dict[str, int]
    """Number of frames by reason; each measured frame is either chosen or counted once."""


def select_keyframes(frames: Sequence[TrackedFrame], most: int) -> Choice:
    """Choose one frame per step of motion; the spacing grows if that would be more than `most` >= 2 frames."""
    path = np.array([frame.path_steps for frame in frames], np.float64)
    sharpness = np.array([frame.sharpness for frame in frames], np.float64)
    if not len(path):
        return Choice((), {})
    every, candidates = sharpest_frames(path, sharpness, 1.0)
    chosen = every
    if len(every) > most:
        chosen, candidates = sharpest_frames(path, sharpness, float(path.max()) / (most - 1) * (1 - 1e-12))
    others = set(range(len(frames))) - set(chosen)
    too_many = others & set(every)
    less_sharp = (others & candidates) - too_many
    counts = {
        "hardly moved on": len(others) - len(too_many) - len(less_sharp),
        "less sharp than a neighbor": len(less_sharp),
        "more than max_frames": len(too_many),
    }
    return Choice(tuple(frames[k].frame for k in chosen), {reason: count for reason, count in counts.items() if count})


def sharpest_frames(path: FloatArray, sharpness: FloatArray, spacing: float) -> tuple[list[int], set[int]]:
    """Return the sharpest frame near every multiple of a spacing >= 1, and all candidates.

    It lies within 0.25 steps of the multiple, or within 0.5 steps if the nearer frames are all blurred. A blurred frame
    is chosen only 1.5 steps or more after the last one. The path is the accumulated motion in steps.
    """
    chosen: list[int] = []
    candidates: set[int] = set()
    for target in np.arange(0.0, path.max() + 1e-9, spacing):
        moment = int(np.argmax(path >= min(target, path.max())))
        if chosen and moment <= chosen[-1]:
            continue
        first = chosen[-1] + 1 if chosen else 0
        near = _nearby_frames(path, moment, target, 0.25, first)
        sharp = BLURRED * sharpness[_nearby_frames(path, moment, target, 1.0, 0)].max()
        best = _sharpest_frame(sharpness, near)
        if sharpness[best] < sharp:
            best = _sharpest_frame(sharpness, _nearby_frames(path, moment, target, 0.5, first))
        candidates.update(map(int, near))
        if sharpness[best] >= sharp or not chosen or path[best] - path[chosen[-1]] >= 1.5:
            chosen.append(best)
    return chosen, candidates


def _sharpest_frame(sharpness: FloatArray, frames: NDArray[np.int64]) -> int:
    return int(frames[np.argmax(sharpness[frames])])


def _nearby_frames(path: FloatArray, moment: int, target: float, reach: float, first: int) -> NDArray[np.int64]:
    """Return the consecutive frames around a moment whose motion is within `reach` steps of the target."""
    outside = np.abs(path - target) > reach
    outside[:first] = True
    before = np.flatnonzero(outside[:moment])
    after = np.flatnonzero(outside[moment + 1 :])
    start = int(before[-1]) + 1 if len(before) else 0
    end = moment + 1 + int(after[0]) if len(after) else len(path)
    return np.arange(max(start, first), end, dtype=np.int64)
