"""How far the picture of a video has moved on, and how sharp it is, frame by frame."""

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]
BoolArray = NDArray[np.bool_]
Picture = NDArray[np.uint8]

STEP = 0.05
"""One step: the median corner has moved by this share of the longer side."""
LONGEST = 1.5
"""A blurred frame is no reference before so many steps."""
LEAST_FOLLOWED = 0.6
"""It is a step, too, when a smaller share of the corners is found again: the overlap goes."""
BLURRED = 0.5
"""A frame with less than this share of its neighbors' sharpness is blurred."""
RECENT = 30
"""Frames that sharpness is compared with; a longer blur than most of them is taken for what there is."""
SHARP_PERCENTILE = 80
"""Of the recent frames: what a sharp one has, even where most are blurred."""
CORNERS = 200
FEWEST = 20
"""With fewer corners nothing is said about motion."""
THERE_AND_BACK_PX = 1.0
"""A corner that is followed and followed back lands so near to where it was, or it is lost."""
WINDOW_PX, LEVELS = 15, 3
"""Of the Lucas-Kanade method."""


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """What is kept of one frame."""

    frame: int
    """Its number."""
    sharpness: float
    """Variance of the Laplacian; to be compared with that of neighbors only."""
    way: float
    """Steps from the first frame to here."""


class Follower:
    """Follows corners from a reference to each frame; after a step, a frame that is not blurred is the next reference.

    Frames are compared with the reference, not with the one before: otherwise noise and a shaking hand would add up to
    a way where the camera stands still.
    """

    def __init__(self) -> None:
        self.seen = False
        """Whether there was ever something to follow."""
        self._passed = 0.0
        self._reference: Picture | None = None
        self._corners = np.zeros((0, 1, 2), np.float32)
        self._last = self._corners
        self._moved = 0.0
        self._recent: deque[float] = deque(maxlen=RECENT)

    def look(self, frame: int, gray: Picture) -> TrackedFrame:
        """Measure the next frame: how sharp it is, and how far the picture has moved on.

        Args:
            frame: its number.
            gray: (H, W); all frames are of one size.
        """
        sharpness = float(cv2.Laplacian(gray, cv2.CV_32F).var())
        self._recent.append(sharpness)
        if self._reference is None or len(self._corners) < FEWEST:
            self._refer(gray)
            return TrackedFrame(frame, sharpness, self._passed)
        self._moved, followed = self._follow(self._reference, gray)
        # blur loses corners that come back: no reason to take such a frame
        blurred = sharpness < BLURRED * float(np.percentile(self._recent, SHARP_PERCENTILE))
        lost = 0.0 if blurred else min(1.0, (1 - followed) / (1 - LEAST_FOLLOWED))
        part = max(self._moved / STEP, lost)
        way = self._passed + part
        if part >= (LONGEST if blurred else 1.0):
            self._passed = way
            self._refer(gray)
        return TrackedFrame(frame, sharpness, way)

    def _refer(self, gray: Picture) -> None:
        corners = cv2.goodFeaturesToTrack(gray, CORNERS, qualityLevel=0.01, minDistance=max(gray.shape) / 60)
        self._reference, self._moved = gray, 0.0
        self._corners = np.zeros((0, 1, 2), np.float32) if corners is None else np.asarray(corners, np.float32)
        self._last = self._corners
        self.seen = self.seen or len(self._corners) >= FEWEST

    def _follow(self, reference: Picture, gray: Picture) -> tuple[float, float]:
        """Return by how many longer sides the median corner moved, and the share of the corners that is found again."""
        there, found = _tracked(reference, gray, self._corners, self._last)
        back, found_back = _tracked(gray, reference, there, self._corners)
        off = np.linalg.norm(back - self._corners, axis=2)[:, 0]
        inside = np.all((there[:, 0] >= 0) & (there[:, 0] < gray.shape[::-1]), axis=1)
        alive = found & found_back & (off < THERE_AND_BACK_PX) & inside
        if np.count_nonzero(alive) < FEWEST:
            return self._moved, float(np.mean(alive))
        flow = (there - self._corners)[alive, 0]
        # corners that are lost now are looked for beside the others the next time
        self._last = np.where(alive[:, None, None], there, self._corners + np.median(flow, axis=0)).astype(np.float32)
        return float(np.median(np.linalg.norm(flow, axis=1))) / max(gray.shape), float(np.mean(alive))


def _tracked(before: Picture, after: Picture, points: FloatArray, guess: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Find where points (N, 1, 2) of one picture are in another, and which of them were found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, points, guess.copy(),
        winSize=(WINDOW_PX, WINDOW_PX), maxLevel=LEVELS, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return there, found[:, 0] > 0
