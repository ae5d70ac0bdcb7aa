"""Measure image motion and sharpness of a video, frame by frame."""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
Picture = NDArray[np.uint8]

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
        """Measure sharpness and accumulated motion of the next frame.

        Args:
            frame: its number.
            gray: (H, W); all frames have one size.
        """
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
    before: Picture, after: Picture, points: FloatArray, guess: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Find points (N, 1, 2) of one picture in another; return their positions and whether each was found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, guess.copy(),
        winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return there, found[:, 0] > 0
