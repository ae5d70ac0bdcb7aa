"""Photos that were taken beside each other: by name, by time and by GPS."""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sfm_app.types import MatchedImage, PairId


def pairs_in_order(images: Sequence[MatchedImage], steps: Sequence[int]) -> set[PairId]:
    """Return pairs of photos that are some steps apart in time, or in the order of their names within a folder.

    Args:
        images: all photos.
        steps: numbers of steps, > 0.
    """
    rows: dict[str, list[MatchedImage]] = {}
    for image in images:
        rows.setdefault(image.name.rpartition("/")[0], []).append(image)
    found = set()
    for row in rows.values():
        ordered = [image.id for image in sorted(row, key=_order_key)]
        found |= {_pair(a, b) for step in steps for a, b in zip(ordered, ordered[step:], strict=False)}
    return found


def pairs_nearby(images: Sequence[MatchedImage], count: int) -> set[PairId]:
    """Return pairs of photos with those whose GPS positions are nearest.

    Args:
        images: all photos; those without a position have no such pairs.
        count: photos that each one is paired with.
    """
    located = [(image.id, image.gps) for image in images if image.gps is not None]
    if len(located) < 2:
        return set()
    angles = np.radians([(gps.latitude_deg, gps.longitude_deg) for _, gps in located])
    places = _unit_vectors(angles)
    nearest = np.atleast_2d(cKDTree(places).query(places, k=min(count + 1, len(located)))[1]).tolist()
    ids = [photo for photo, _ in located]
    return {_pair(ids[row], ids[k]) for row, others in enumerate(nearest) for k in others if k != row}


def _unit_vectors(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 3) unit vectors of latitudes and longitudes in radians."""
    north, east = angles.T
    return np.column_stack([np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)])


def _order_key(image: MatchedImage) -> tuple[float, list[tuple[int, str]], int]:
    """Return a key by time, then by name with numbers in their order."""
    parts = [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", image.name)]
    return (image.time_s if image.time_s is not None else 0.0), parts, image.id


def _pair(a: int, b: int) -> PairId:
    return (a, b) if a < b else (b, a)
