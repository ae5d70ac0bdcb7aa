"""Select the frames of a video that become photos: the sharpest frame around each step of motion."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.photos.video.feature_tracking import BLURRED, TrackedFrame

FloatArray = NDArray[np.float64]

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
