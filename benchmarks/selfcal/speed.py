"""CPU seconds of self-calibration: the thesis's curves, the production consensus, and its growth with the pairs."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial

import numpy as np

from benchmarks.common.results import Row
from benchmarks.selfcal.coverage import estimate_pairs
from benchmarks.selfcal.methods import PRODUCTION, WITHOUT_MATCHES, MatchedSet
from sfm_app.estimation.calibrating import photo_pairs
from sfm_app.plugins import load_plugins
from sfm_app.selfcal.pairs import prepare
from sfm_app.selfcal.thesis.zero_curves import algorithm_4
from sfm_app.settings import Settings, merge_nested
from sfm_app.synthetic.correspondences import TrackOptions, make_tracks
from sfm_app.types import CameraPairs

REPEATS, ENOUGH_SECONDS = 5, 5.0
"""Limits on the number and total time of the measured calls; at least one follows the unmeasured first."""
SAMPLES = 100
THESIS_CAMERAS = 10
"""45 pairs."""
CAMERAS = (7, 10, 14, 20)
"""21 to 190 pairs: each step about doubles them."""


def measure_speed(subject: MatchedSet | None, overrides: Mapping[str, Mapping[str, object]]) -> list[Row]:
    """Return one row per measurement: CPU seconds of one call, the minimum of a few after an unmeasured one."""
    rows = [_time_curves(synthetic_pairs(THESIS_CAMERAS))]
    for label, others in {"": {}, **overrides}.items():
        settings = Settings.from_mapping(merge_nested({"seed": 0}, others))
        for method in (PRODUCTION, WITHOUT_MATCHES):
            title = f"{method}{', ' if label else ''}{label}"
            if subject is not None:
                images = subject.groups[0]
                own = photo_pairs(images, subject.matches, subject.views).to_camera_pairs(
                    [image.id for image in images]
                )
                pairs = _method_inputs(own, method)
                seconds = _cpu_seconds(partial(_calibrate, pairs, settings))
                rows.append(_row(f"{title}: {subject.photos.name}", len(pairs.Fs), seconds))
                rows[-1]["matching seconds"] = subject.matching_seconds
            rows += _time_growth(title, method, settings)
    return rows


def _method_inputs(pairs: CameraPairs, method: str) -> CameraPairs:
    return replace(pairs, inliers=()) if method == WITHOUT_MATCHES else pairs


@cache
def synthetic_pairs(cameras: int, seed: int = 0) -> CameraPairs:
    """Make all pairs of `cameras` synthetic photos, estimated from noisy matches."""
    # all cameras must see the same points, so they stand closer together than in the thesis
    options = TrackOptions(cameras=cameras, sigma_px=0.5, max_rotation_deg=20.0, max_shift=0.4)
    return estimate_pairs(make_tracks(options, seed), Settings(), seed)


def _time_curves(pairs: CameraPairs) -> Row:
    width, height = pairs.size
    usable = prepare(pairs, unit_px=width, origin_px=(0.0, 0.0))
    seconds = _cpu_seconds(lambda: algorithm_4(usable, height / width, samples=SAMPLES, evidence={}))
    return _row(f"zero-curves-thesis: all curves of {SAMPLES} samples and their meeting points", len(usable), seconds)


def _time_growth(title: str, method: str, settings: Settings) -> list[Row]:
    rows = []
    for cameras in CAMERAS:
        pairs = _method_inputs(synthetic_pairs(cameras), method)
        name = f"{title}: {cameras} synthetic photos"
        rows.append(_row(name, len(pairs.Fs), _cpu_seconds(partial(_calibrate, pairs, settings))))
    counts, seconds = ([row[key] for row in rows] for key in ("pairs", "seconds"))
    power = float(np.polyfit(np.log(counts), np.log(seconds), 1)[0])
    return [*rows, {"method": f"{title}: seconds grow with the pairs to the power", "power": round(power, 2)}]


def _calibrate(pairs: CameraPairs, settings: Settings) -> object:
    return load_plugins().calibrator(PRODUCTION).calibrate(pairs, settings.calibration, 0)


def _row(name: str, pairs: int, seconds: float) -> Row:
    return {"method": name, "pairs": pairs, "seconds": round(seconds, 4), "ms a pair": round(1e3 * seconds / pairs, 3)}


def _cpu_seconds(work: Callable[[], object]) -> float:
    work()
    found: list[float] = []
    while len(found) < REPEATS and sum(found) < ENOUGH_SECONDS:
        # not wall-clock time, which would include other processes on the machine
        start = time.process_time()
        work()
        found.append(time.process_time() - start)
    return min(found)
