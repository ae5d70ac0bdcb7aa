"""When the photos of a model were taken, if they are frames of a video: by the video itself, or by their names."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

import numpy as np

from sfm_app.bundle_adjustment.path_velocity import path_velocities
from sfm_app.colmap.model import poses_and_points
from sfm_app.colmap.types import Reconstruction
from sfm_app.types import MatchedImage

MIN_FRAMES, MIN_NUMBERED = 10, 20
"""Fewest frames of a video, and of a folder whose photos may be frames by their names. Numbered photos are mostly no
frames; a set of twenty or more photos rarely is one of a few steps round an object. Chosen by hand."""
MAX_FRAMES = 300
"""Most photos of which a readout is measured: the time grows with the square of their number, and the memory."""
SMOOTH = 0.3
"""Largest error of the path's prediction of a left-out position, in steps, of frames of a video. fox50 and
kitchen1000 have 0.16 and 0.28, walks with random stops (`synthetic.cameras.arc`) 0.5 to 0.8."""
NUMBERED = re.compile(r"(.*?)(\d+)")


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """When frames of a video were taken."""

    times: Mapping[int, float]
    """By photo id; in seconds, or in numbers of frames."""
    interval: float
    """Between two frames of the video, in the same unit."""
    in_seconds: bool


def frame_times(images: Sequence[MatchedImage], model: Reconstruction) -> FrameTimes | None:
    """Return when the photos of a model were taken; None where they are not known to be frames of one video.

    Photos whose names differ only in a number are frames of a video if the model shows them along a smooth path, with
    places according to their numbers, and no EXIF says otherwise.

    Args:
        images: photos of the model.
        model: COLMAP's reconstruction.
    """
    numbers = _frame_numbers(images)
    if numbers is None or not MIN_FRAMES <= len(images) <= MAX_FRAMES:
        return None
    moments = {image.id: image.time_s for image in images if image.time_s is not None}
    if len(moments) == len(images):
        order = sorted(numbers, key=numbers.__getitem__)
        seconds, steps = (np.diff([of[key] for key in order]) for of in (moments, numbers))
        known = bool((seconds > 0.0).all())
        return FrameTimes(moments, float(np.median(seconds / steps)), True) if known else None
    if moments or len(images) < MIN_NUMBERED or any(image.exif_focal_px or image.gps for image in images):
        return None
    return FrameTimes(numbers, 1.0, False) if _is_smooth(numbers, model) else None


def _frame_numbers(images: Sequence[MatchedImage]) -> dict[int, float] | None:
    """Return the numbers at the ends of the photos' names, by id; None where the names differ in anything else."""
    found = {image.id: NUMBERED.fullmatch(str(PurePosixPath(image.name).with_suffix(""))) for image in images}
    stems = {match[1] if match else None for match in found.values()}
    numbers = {key: float(match[2]) for key, match in found.items() if match}
    return numbers if len(stems) == 1 and len(set(numbers.values())) == len(images) else None


def _is_smooth(numbers: Mapping[int, float], model: Reconstruction) -> bool:
    """Return whether positions follow from those of the photos before and after them."""
    poses, _ = poses_and_points(model)
    order = sorted(poses, key=lambda key: numbers[key])
    R, t = (np.array([poses[key][:, part] for key in order]) for part in (slice(0, 3), 3))
    path = path_velocities(R, t, np.array([numbers[key] for key in order]))
    fit = path.select_most_predictive()[1]
    errors = np.linalg.norm(path.errors[fit, :, 3:], axis=1)
    steps = np.linalg.norm(np.diff(-np.einsum("nji,nj->ni", R, t), axis=0), axis=1)
    return bool(np.median(errors) <= SMOOTH * np.median(steps))
