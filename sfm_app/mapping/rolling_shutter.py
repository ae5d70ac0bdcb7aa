"""Follow the rolling shutter of a video: measure its readout, compensate the keypoints, adjust again, and repeat."""

import logging
import math
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


class OPTIONS:
    """Measurement of the readout."""

    min_frames: int = 10
    """Least frames of a measurement: a path needs some. Chosen by hand."""
    max_frames: int = 120
    """Most frames: the time grows with the cube of their number. Chosen by hand."""
    rounds: int = 4
    """Most rounds of measurement and compensation; two or three suffice. Measured."""
    converged: float = 0.25
    """Change of the readout, in deviations, below which they end. Chosen by hand."""
    significance: float = 3.0
    """Readout in deviations from which on it is significant. Chosen by hand."""
    longest: float = 1.05
    """Longest readout, in intervals between frames: a frame lasts one. By definition, with room for errors."""


logger = logging.getLogger("sfm_app")

NUMBERED = re.compile(r"(.*?)(\d+)")


def frame_times(images: Sequence[MatchedImage]) -> tuple[dict[int, float], float] | None:
    """Return the times of photos named by number, by id, and the interval between frames of their video, in seconds.

    None where they are not known to be frames of one video.
    """
    numbers = _frame_numbers(images)
    times = {image.id: image.time_s for image in images if image.time_s is not None}
    if numbers is None or len(times) < len(images) or len(images) < OPTIONS.min_frames:
        return None
    order = sorted(numbers, key=numbers.__getitem__)
    seconds, steps = (np.diff([of[key] for key in order]) for of in (times, numbers))
    return (times, float(np.median(seconds / steps))) if (seconds > 0.0).all() else None


def _frame_numbers(images: Sequence[MatchedImage]) -> dict[int, float] | None:
    """Return the numbers at the ends of the photos' names, by id; None where the names differ in anything else."""
    matches = {image.id: NUMBERED.fullmatch(str(PurePosixPath(image.name).with_suffix(""))) for image in images}
    stems = {match[1] if match else None for match in matches.values()}
    numbers = {key: float(match[2]) for key, match in matches.items() if match}
    return numbers if len(stems) == 1 and len(set(numbers.values())) == len(images) else None


@dataclass(frozen=True, slots=True)
class Readout:
    """Shutter of a video; its times are NaN where it was not measured."""

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
        measured = {name: value for name, value in figures.items() if not math.isnan(value)}
        rounded: dict[str, Json] = {f"{name}_ms": round(1e3 * value, 4) for name, value in measured.items()}
        return rounded | {"compensated": not self.refused} | ({"because": self.refused} if self.refused else {})


def follow_shutter(
    adjusted: Adjustment, matches: MatchGraph, database: Path, progress: Progress, rules: Rules = NO_RULES
) -> tuple[Adjustment, Readout | None]:
    """Return the model as a global shutter would have given it, and the measurement of the shutter.

    The given adjustment is returned where the photos are not known to be frames of a video, where they are too many,
    where no readout is found, and where the compensated model explains the photos no better.
    """
    if adjusted.failure or not adjusted.lenses:
        return adjusted, None
    images = [matches.images[photo] for photo in posed_photo_ids(adjusted.model)]
    frames = frame_times(images)
    if frames is None:
        return adjusted, None
    times, interval = frames
    if len(images) > OPTIONS.max_frames:
        reason = f"more than {OPTIONS.max_frames} frames would take too long to measure"
        return adjusted, Readout(math.nan, math.nan, math.nan, reason)
    progress.say(f"measuring the shutter of the video, with {len(images)} frames")
    try:
        with translate_errors("measuring the shutter"):
            rounds = _compensate(adjusted, times, database, rules)
    except FAILURES as err:
        logger.info("the shutter could not be measured", exc_info=err)
        return adjusted, None
    compensated, estimate = rounds[-1]
    refused = _reason_to_refuse(adjusted, compensated, estimate, interval)
    readout = Readout(estimate.readout, estimate.deviation, interval, refused)
    return (adjusted if refused else compensated), readout


def _compensate(
    adjusted: Adjustment, times: Mapping[int, float], database: Path, rules: Rules
) -> Sequence[tuple[Adjustment, ReadoutEstimate]]:
    """Return the adjusted models of all rounds with their readouts; an insignificant one has the given model."""
    rounds: list[tuple[Adjustment, ReadoutEstimate]] = []
    keypoints, current = read_keypoints(adjusted.model), adjusted
    estimate: ReadoutEstimate | None = None
    for _ in range(OPTIONS.rounds):
        before, estimate = estimate, measure_readout(current, keypoints, times, estimate)
        if abs(estimate.readout) <= estimate.deviation:
            return [*rounds, (adjusted, estimate)]
        current = adjust_or_keep(straighten_model(current.model, estimate, keypoints), database, rules)
        rounds.append((current, estimate))
        changed = OPTIONS.converged * estimate.deviation
        if current.failure or (before is not None and abs(estimate.readout - before.readout) <= changed):
            break
    return rounds


def _reason_to_refuse(adjusted: Adjustment, compensated: Adjustment, estimate: ReadoutEstimate, interval: float) -> str:
    if OPTIONS.significance * estimate.deviation >= interval:
        return "the motion of the camera does not determine it"
    if abs(estimate.readout) < OPTIONS.significance * estimate.deviation:
        return "it is not significant"
    if abs(estimate.readout) > OPTIONS.longest * interval:
        return "it would be longer than a frame lasts"
    if compensated.failure:
        return f"the adjustment failed: {compensated.failure}"
    before, after = (one.model.compute_mean_reprojection_error() for one in (adjusted, compensated))
    return "" if after < before else "the photos contradict it"
