"""When the photos of a model were taken, if they are frames of a video."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from sfm_app.types import MatchedImage

MIN_FRAMES = 10
"""Frames of which a readout is measured, at least: a path needs some. Chosen by hand."""
NUMBERED = re.compile(r"(.*?)(\d+)")


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """When frames of a video were taken."""

    times: Mapping[int, float]
    """Seconds, by photo id."""
    interval: float
    """Between two frames of the video, in seconds."""


def frame_times(images: Sequence[MatchedImage]) -> FrameTimes | None:
    """Return when the photos of a model were taken; None where they are not known to be frames of one video.

    Args:
        images: photos of the model; frames are named by their numbers in the video.
    """
    numbers = _frame_numbers(images)
    moments = {image.id: image.time_s for image in images if image.time_s is not None}
    if numbers is None or len(moments) < len(images) or len(images) < MIN_FRAMES:
        return None
    order = sorted(numbers, key=numbers.__getitem__)
    seconds, steps = (np.diff([of[key] for key in order]) for of in (moments, numbers))
    return FrameTimes(moments, float(np.median(seconds / steps))) if (seconds > 0.0).all() else None


def _frame_numbers(images: Sequence[MatchedImage]) -> dict[int, float] | None:
    """Return the numbers at the ends of the photos' names, by id; None where the names differ in anything else."""
    found = {image.id: NUMBERED.fullmatch(str(PurePosixPath(image.name).with_suffix(""))) for image in images}
    stems = {match[1] if match else None for match in found.values()}
    numbers = {key: float(match[2]) for key, match in found.items() if match}
    return numbers if len(stems) == 1 and len(set(numbers.values())) == len(images) else None
