"""Distances in a finished model, with deviations."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.scale.sighted_points import ray_information

FloatArray = NDArray[np.float64]

NEIGHBORS = 12
"""Points of the sparse model next to a place whose photos are taken for those that show it. Chosen by hand."""
LEAST_SIGMA_PX = 0.5
"""Least standard deviation of a place picked on a surface, in pixels."""


@dataclass(frozen=True, slots=True)
class Distance:
    """A distance between two places of a model."""

    value: float
    """In the unit of the exported files."""
    deviation: float
    """Standard deviation, in the same unit; without that of the unit where it is arbitrary."""
    metric: bool
    """Whether the unit is the meter."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        return {"distance": self.value, "deviation": self.deviation, "unit": "meter" if self.metric else "arbitrary"}


@dataclass(frozen=True, slots=True, eq=False)
class Sightlines:
    """The cameras of a model, and which of them see which points."""

    centers: FloatArray
    """(C, 3)."""
    focals: FloatArray
    """(C,) pixels per radian."""
    points: FloatArray
    """(P, 3)."""
    seen_by: tuple[NDArray[np.int64], ...]
    """For each point, the rows of the cameras that see it."""
    residual_px: float
    """Mean reprojection error."""


def place_covariance(place: FloatArray, model: Sightlines) -> FloatArray:
    """Return the covariance (3, 3) of a place on the surface, as the photos that see it determine it.

    Args:
        place: (3,) in the frame of the model.
        model: cameras and points.
    """
    near = np.argsort(np.linalg.norm(model.points - place, axis=1))[:NEIGHBORS]
    counts = np.bincount(np.concatenate([model.seen_by[k] for k in near]), minlength=len(model.centers))
    # as many photos as see one of the points, those that see most of them
    typical = max(int(np.median([len(model.seen_by[k]) for k in near])), 2)
    seeing = np.argsort(-counts, kind="stable")[:typical]
    towards = place - model.centers[seeing]
    rays = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-300)
    information = ray_information(place, model.centers[seeing], rays, model.focals[seeing])
    return np.asarray(max(model.residual_px, LEAST_SIGMA_PX) ** 2 * np.linalg.pinv(information))


def measure_distance(
    a: FloatArray, b: FloatArray, model: Sightlines, scale: float, deviation: float | None
) -> Distance:
    """Return the distance between two places.

    Args:
        a, b: (3,) in the frame of the model.
        model: cameras and points in that frame.
        scale: units of exported files per unit of the model.
        deviation: relative, of the scale; None where the unit is arbitrary.

    Raises:
        ValueError: both places are the same.
    """
    apart = float(np.linalg.norm(b - a))
    if apart == 0:
        raise ValueError("both places are the same")
    along = (b - a) / apart
    variance = along @ (place_covariance(a, model) + place_covariance(b, model)) @ along
    value = scale * apart
    spread = np.hypot(scale * np.sqrt(max(float(variance), 0.0)), value * (deviation or 0.0))
    return Distance(value, float(spread), deviation is not None)
