"""Follow the rolling shutter of a video: measure its readout, compensate the keypoints, adjust again, and repeat."""

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from sfm_app.bundle.rolling_shutter import ReadoutEstimate
from sfm_app.colmap.backend import translate_errors
from sfm_app.colmap.bundle import NO_RULES, Adjustment, Rules, adjust_or_keep
from sfm_app.colmap.model import posed_photo_ids
from sfm_app.colmap.readout import measure_readout, read_keypoints, straighten_model
from sfm_app.numerical import FAILURES, Json
from sfm_app.progress import Progress
from sfm_app.types import MatchedImage, MatchGraph

# When the photos of a model were taken, if they are frames of a video.

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


logger = logging.getLogger("sfm_app")

MAX_FRAMES = 120
"""Frames of which a readout is measured, at most: the time grows with the cube of their number (100 frames with 120 000
observations: 2 minutes). Chosen by hand."""
ROUNDS, SETTLED = 4, 0.25
"""Most rounds of measuring and compensating, and the change of the readout, in deviations, below which they end: two or
three are needed (`python -m benchmarks.videos.shutter`)."""
SURE = 3.0
"""Readout in deviations from which on it is taken for one. Chosen by hand."""
LONGEST = 1.05
"""Longest readout, in intervals between frames: no sensor reads longer than a frame lasts. By definition, with room for
the error of the measurement."""


@dataclass(frozen=True, slots=True)
class Readout:
    """What is known of the shutter of a video."""

    readout: float
    """Seconds; negative where the last row is read first."""
    deviation: float
    interval: float
    """Seconds between two frames of the video."""
    refused: str = ""
    """Why nothing is compensated; empty where keypoints and poses are those of the middle rows."""

    def to_dict(self) -> dict[str, Json]:
        """Return plain values for the manifest, in milliseconds."""
        figures = {"readout": self.readout, "deviation": self.deviation, "interval": self.interval}
        found: dict[str, Json] = {f"{name}_ms": round(1e3 * value, 4) for name, value in figures.items()}
        return found | {"compensated": not self.refused} | ({"because": self.refused} if self.refused else {})


@dataclass(frozen=True, slots=True)
class Unmeasured:
    """A video whose shutter is not asked for."""

    reason: str

    def to_dict(self) -> dict[str, Json]:
        """Return plain values for the manifest."""
        return {"compensated": False, "because": self.reason}


def follow_shutter(
    adjusted: Adjustment, matches: MatchGraph, database: Path, progress: Progress, rules: Rules = NO_RULES
) -> tuple[Adjustment, Readout | Unmeasured | None]:
    """Return the model as a global shutter would have given it, and what is known of the shutter.

    The given adjustment is returned where the photos are not known to be frames of a video, where they are too many,
    where no readout is found, and where the compensated model explains the photos no better.

    Args:
        adjusted: a model after the last adjustment.
        matches: all photos.
        database: has all keypoints and matches.
        progress: told of the measurement before it begins.
        rules: what the user laid down about its cameras, as in `adjust`.
    """
    if adjusted.failure or not adjusted.lenses:
        return adjusted, None
    images = [matches.images[photo] for photo in posed_photo_ids(adjusted.model)]
    frames = frame_times(images)
    if frames is None:
        return adjusted, None
    if len(images) > MAX_FRAMES:
        return adjusted, Unmeasured(f"more than {MAX_FRAMES} frames would take too long to measure")
    progress.say(f"measuring the shutter of the video, with {len(images)} frames")
    try:
        with translate_errors("following the shutter"):
            measured = _compensate(adjusted, frames, database, rules)
    except FAILURES as err:
        logger.info("the shutter could not be followed", exc_info=err)
        return adjusted, None
    straight, estimate = measured[-1]
    refused = _reason_to_refuse(adjusted, straight, estimate, frames)
    found = Readout(estimate.readout, estimate.deviation, frames.interval, refused)
    return (adjusted if refused else straight), found


def _compensate(
    adjusted: Adjustment, frames: FrameTimes, database: Path, rules: Rules
) -> Sequence[tuple[Adjustment, ReadoutEstimate]]:
    """Return the adjusted models of all rounds with the readouts that they were compensated for.

    The first round is the last one where the readout is smaller than its deviation; the model is then the given one.
    """
    found: list[tuple[Adjustment, ReadoutEstimate]] = []
    keypoints, current = read_keypoints(adjusted.model), adjusted
    estimate: ReadoutEstimate | None = None
    for _ in range(ROUNDS):
        before, estimate = estimate, measure_readout(current, keypoints, frames.times, estimate)
        if abs(estimate.readout) <= estimate.deviation:
            return [*found, (adjusted, estimate)]
        current = adjust_or_keep(straighten_model(current.model, estimate, keypoints), database, rules)
        found.append((current, estimate))
        if current.failure or _is_settled(before, estimate):
            break
    return found


def _is_settled(before: ReadoutEstimate | None, after: ReadoutEstimate) -> bool:
    """Return whether the readout has not changed since the round before."""
    return before is not None and abs(after.readout - before.readout) <= SETTLED * after.deviation


def _reason_to_refuse(adjusted: Adjustment, straight: Adjustment, estimate: ReadoutEstimate, frames: FrameTimes) -> str:
    """Return why the compensated model is not taken; empty where it is."""
    if SURE * estimate.deviation >= frames.interval:
        return "the motion of the camera does not tell it"
    if abs(estimate.readout) < SURE * estimate.deviation:
        return "none is seen"
    if abs(estimate.readout) > LONGEST * frames.interval:
        return "it would be longer than a frame lasts"
    if straight.failure:
        return f"the adjustment failed: {straight.failure}"
    before, after = (one.model.compute_mean_reprojection_error() for one in (adjusted, straight))
    return "" if after < before else "the photos contradict it"
