"""Find printed ArUco and AprilTag markers in photos."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sfm_app.scale.marker_edges import fit_pattern

FloatArray = NDArray[np.float64]

AUTO = "auto"
FAMILIES = MappingProxyType({
    "apriltag-36h11": "DICT_APRILTAG_36h11", "aruco-6x6": "DICT_6X6_250", "aruco-5x5": "DICT_5X5_250",
    "aruco-4x4": "DICT_4X4_50", "aruco-7x7": "DICT_7X7_250", "aruco-original": "DICT_ARUCO_ORIGINAL",
    "apriltag-25h9": "DICT_APRILTAG_25h9", "apriltag-16h5": "DICT_APRILTAG_16h5", "aruco-4x4-1000": "DICT_4X4_1000",
    "aruco-5x5-1000": "DICT_5X5_1000", "aruco-6x6-1000": "DICT_6X6_1000", "aruco-7x7-1000": "DICT_7X7_1000",
    "aruco-mip-36h12": "DICT_ARUCO_MIP_36h12",
})  # fmt: skip
"""OpenCV's dictionaries, by our names."""
TRIED = ("apriltag-36h11", "aruco-6x6", "aruco-5x5", "aruco-4x4", "aruco-7x7")
"""Families that `auto` looks for. Families of few bits and many markers are left out: they are found in brickwork,
and aruco-original in windows."""


@dataclass(frozen=True, slots=True, eq=False)
class SeenMarker:
    """A marker in one photo."""

    family: str
    number: int
    corners: FloatArray
    """(4, 2) in pixels, clockwise from the marker's own top left; pixel centers at +0.5."""
    sigma_px: float

    @property
    def name(self) -> str:
        """What the marker is called in messages."""
        return f"{self.family} {self.number}"


def find_markers_in_file(photo_dir: Path, family: str, name: str) -> list[SeenMarker]:
    """Return the markers in a photo; none where the photo cannot be read.

    Args:
        photo_dir: folder of the photo.
        family: one of `FAMILIES`, or `AUTO`.
        name: of the photo.
    """
    try:
        with Image.open(photo_dir / name) as image:
            gray = np.asarray(image.convert("L"))
    except OSError:
        return []
    return find_markers(gray, TRIED if family == AUTO else (family,))


def find_markers(gray: NDArray[np.uint8], families: Sequence[str]) -> list[SeenMarker]:
    """Return the markers of some families in a photo, each with corners from all edges of its pattern.

    Args:
        gray: (H, W) photo.
        families: names in `FAMILIES`.
    """
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    found: list[SeenMarker] = []
    for family in families:
        dictionary = load_dictionary(family)
        corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, options).detectMarkers(gray)
        for outline, number in zip(corners, [] if numbers is None else numbers.ravel(), strict=True):
            pattern = draw_pattern(family, int(number))
            fitted = fit_pattern(gray, pattern, np.asarray(outline, np.float64).reshape(4, 2) + 0.5)
            if fitted is not None:
                found.append(SeenMarker(family, int(number), fitted.corners, fitted.sigma_px))
    return found


def load_dictionary(family: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of a family.

    Args:
        family: name in `FAMILIES`.
    """
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[family]))


def draw_pattern(family: str, number: int) -> NDArray[np.uint8]:
    """Return the (N, N) cells of a marker with its dark border, 0 or 255.

    Args:
        family: name in `FAMILIES`.
        number: of the marker in the family.
    """
    dictionary = load_dictionary(family)
    return np.asarray(cv2.aruco.generateImageMarker(dictionary, number, dictionary.markerSize + 2), np.uint8)


def marker_count(family: str) -> int:
    """Return how many markers a family has.

    Args:
        family: name in `FAMILIES`.
    """
    return len(load_dictionary(family).bytesList)
