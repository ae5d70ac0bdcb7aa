"""Calibrations against the truth: one row of plain figures per photo set and method."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.metrics import focal_error_percent
from benchmarks.common.photo_sets import TrueCamera
from benchmarks.common.results import Row
from benchmarks.selfcal.methods import MethodResult
from sfm_app.types import Calibration

PARAMETER_ENTRIES = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
INSIDE = 3.0
"""Standard deviations within which the truth should lie."""


def row(photos: str, found: MethodResult, truth: Mapping[str, TrueCamera]) -> Row:
    """Return medians over the photos that have a truth; with one camera for all, these are its errors."""
    cameras = list(dict.fromkeys(found.cameras.values()))
    known = sum(camera.identifiable for camera in found.cameras.values())
    reasons = [camera.reason for camera in cameras if camera.reason]
    line: Row = {
        "photos": photos,
        "method": found.method,
        "known": _share(known, len(found.cameras)),
        **dict.fromkeys(COLUMNS),
        "held": ", ".join(cameras[0].held),
        "k1": _rounded_median([camera.radial for camera in cameras], 4),
        "pairs": found.pairs,
        "seconds": round(found.seconds, 3),
        "reason": reasons[0] if reasons else "",
    }
    both = [(camera, truth[photo]) for photo, camera in found.cameras.items() if photo in truth]
    if both:
        line |= _errors([camera for camera, _ in both], [true for _, true in both])
    return line


COLUMNS = (
    "e_focal %", "worst e_focal %", "center % of width", "fy/fx %", "k1 error", "sd of f %",
    "fx sd", "fy sd", "cx sd", "cy sd", "in 3 sd",
)  # fmt: skip
"""Columns that need the truth. "fx sd" is the error of fx in its own standard deviations, and so on."""


def deviations(camera: Calibration, K: NDArray[np.float64]) -> dict[str, float]:
    """Return |error| over the stated standard deviation, for the parameters that have one."""
    stated = {name: camera.spread[name] for name in PARAMETER_ENTRIES if camera.spread.get(name, 0.0) > 0}
    return {
        name: float(abs(camera.K[PARAMETER_ENTRIES[name]] - K[PARAMETER_ENTRIES[name]]) / sd)
        for name, sd in stated.items()
    }


def center_error_percent(camera: Calibration, K: NDArray[np.float64]) -> float:
    """Compute the distance of the optical centers in percent of the width."""
    return float(100 * np.linalg.norm(camera.K[:2, 2] - K[:2, 2]) / camera.width)


def aspect_error_percent(camera: Calibration, K: NDArray[np.float64]) -> float:
    """Compute the error of fy / fx in percent."""
    return float(100 * abs((camera.K[1, 1] / camera.K[0, 0]) / (K[1, 1] / K[0, 0]) - 1))


def _errors(cameras: Sequence[Calibration], truth: Sequence[TrueCamera]) -> Row:
    both = list(zip(cameras, truth, strict=True))
    stated = [deviations(camera, true.K) for camera, true in both if camera.identifiable]
    stated = [values for values in stated if values]
    focal = [focal_error_percent(camera.K, true.K) for camera, true in both]
    line: Row = {
        "e_focal %": _rounded_median(focal),
        "worst e_focal %": _rounded_median([max(focal)]) if len({true.K.tobytes() for true in truth}) > 1 else None,
        "center % of width": _rounded_median([center_error_percent(camera, true.K) for camera, true in both]),
        "fy/fx %": _rounded_median([aspect_error_percent(camera, true.K) for camera, true in both]),
        "k1 error": _rounded_median([abs(camera.radial - true.k1) for camera, true in both if true.k1 is not None], 4),
        "sd of f %": _rounded_median([100 * c.spread["fx"] / c.K[0, 0] for c in cameras if c.spread.get("fx")]),
    }
    line |= {
        f"{name} sd": _rounded_median([values[name] for values in stated if name in values])
        for name in PARAMETER_ENTRIES
    }
    inside = sum(max(values.values()) <= INSIDE for values in stated)
    return line | {"in 3 sd": _share(inside, len(stated)) if stated else None}


def _rounded_median(values: Sequence[float], digits: int = 2) -> float | None:
    return round(float(np.median(values)), digits) if len(values) else None


def _share(count: int, of: int) -> str:
    return "yes" if count == of else "no" if count == 0 else f"{count}/{of}"
