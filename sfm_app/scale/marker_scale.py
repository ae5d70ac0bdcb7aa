"""The scale of a model from printed markers of known size."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.similarity import umeyama
from sfm_app.scale.evidence import ScaleEvidence
from sfm_app.scale.markers import SeenMarker
from sfm_app.scale.sighted_points import Sight, SightedPoint, locate_point

FloatArray = NDArray[np.float64]

SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
"""Corners of a marker of side 1 about its middle, clockwise from its own top left."""
EDGE_BIAS_PX = 0.05
"""Standard deviation in pixels of what edges leave of a side's length: 0.014 to 0.1 pixels for markers of 30 to 45
pixels and blur of 0.5 to 1.5, less for larger ones (`tests/unit/scale/test_marker_edges.py`)."""
MAX_SHAPE_ERROR = 0.05
"""Largest distance of a corner from the square, in sides, that is still a marker. Chosen by hand: a wrong detection, or
one number in two places, is off by a side or more."""


@dataclass(frozen=True, slots=True)
class MarkerScales:
    """What the markers of a set tell."""

    evidence: tuple[ScaleEvidence, ...]
    not_used: Mapping[str, str]
    """Markers that tell nothing, by name, with the reason."""


def marker_scales(
    seen: Mapping[str, Sequence[SeenMarker]], rays: Mapping[str, Sequence[Sequence[Sight]]], side_m: float
) -> MarkerScales:
    """Return the scale of a model by each marker.

    Args:
        seen: markers by photo.
        rays: by photo, for each of these markers, the rays of its four corners.
        side_m: side of each marker's dark square, in meters.
    """
    sights: dict[str, list[Sequence[Sight]]] = defaultdict(list)
    sizes: dict[str, list[float]] = defaultdict(list)
    for photo, markers in seen.items():
        names = [marker.name for marker in markers]
        for marker, corners in zip(markers, rays[photo], strict=True):
            if names.count(marker.name) == 1:  # two of one number in a photo: which is which is unknown
                sights[marker.name].append(corners)
                sizes[marker.name].append(side_px(marker.corners))
    evidence, not_used = [], {}
    for name in sorted(sights):
        found = _measure_marker(name, sights[name], float(np.median(sizes[name])), side_m)
        if isinstance(found, str):
            not_used[name] = found
        else:
            evidence.append(found)
    return MarkerScales(tuple(evidence), not_used)


def side_px(corners: FloatArray) -> float:
    """Return the mean side of a quadrilateral (4, 2)."""
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).mean())


def _measure_marker(name: str, sights: Sequence[Sequence[Sight]], size_px: float, side_m: float) -> ScaleEvidence | str:
    """Return the scale by one marker that several photos show, or why it tells none."""
    corners: list[SightedPoint] = []
    for k in range(4):
        point = locate_point([photo[k] for photo in sights])
        if isinstance(point, str):
            return point.replace("it is marked", "it is seen")
        corners.append(point)
    places = np.array([corner.place for corner in corners])
    fit = umeyama(SQUARE, places)
    off = np.linalg.norm(fit(SQUARE) - places, axis=1).max() / fit.scale
    if off > MAX_SHAPE_ERROR:
        return f"it is no square in the model: a corner is off by {100 * off:.0f} % of its side; one number twice?"
    # the side is linear in the corners: s = sum a'R'b / sum a'a
    arms = SQUARE @ fit.R.T / (SQUARE**2).sum()
    variance = sum(arm @ corner.covariance @ arm for arm, corner in zip(arms, corners, strict=True))
    deviation = float(np.hypot(np.sqrt(variance) / fit.scale, EDGE_BIAS_PX / size_px))
    return ScaleEvidence(f"marker {name}", side_m / fit.scale, deviation, min(len(one.photos) for one in corners))
