"""Cameras as OpenCV writes them: camera matrix and distortion coefficients in JSON, YAML or XML.

OpenCV counts pixels from the center of the first one, which is (0.5, 0.5) here.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from sfm_app.geometry.lenses.camera_models import calibration_from_model
from sfm_app.types import Calibration

FIRST_PIXEL = 0.5
"""Our coordinates of the pixel that OpenCV calls (0, 0)."""
MATRIX = ("cameramatrix", "k", "mtx", "intrinsicmatrix")
DISTORTION = ("distcoeffs", "distortioncoefficients", "distortioncoeffs", "distortion", "dist", "d")
WIDTH, HEIGHT, SIZE = ("imagewidth", "width"), ("imageheight", "height"), ("imagesize", "resolution")
MODEL = ("fisheyemodel", "distortionmodel", "cameramodel", "model", "projection", "lens", "fisheye")
"""Keys by which programs around OpenCV call each value, in small letters without underscores."""
FISHEYE_WORDS = ("fisheye", "equidistant", "kannala")
COUNTS = (0, 4, 5, 8, 12, 14)
"""Numbers of coefficients that OpenCV knows: k1 k2 p1 p2, k3, k4 k5 k6, s1 s2 s3 s4, and two of a tilted sensor."""


def is_opencv_camera(values: Mapping[str, Any]) -> bool:
    """Return whether there is a camera matrix among the values."""
    return _value(values, MATRIX) is not None


def opencv_camera(values: Mapping[str, Any]) -> Calibration:
    """Return the camera of OpenCV's values.

    Args:
        values: camera matrix, and optionally distortion coefficients, size, and whether the lens is a fisheye.

    Raises:
        ValueError: they are no camera, or one with coefficients that no run can use.
    """
    K = _numbers(_value(values, MATRIX), "the camera matrix")
    if K.size != 9:
        raise ValueError(f"the camera matrix has {K.size} values instead of 3 x 3")
    (fx, skew, cx), (below, fy, cy), last = K.reshape(3, 3)
    if skew != 0.0 or below != 0.0 or last.tolist() != [0.0, 0.0, 1.0]:
        raise ValueError("the camera matrix is not [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    said = _value(values, DISTORTION)
    coefficients = [] if said is None else _numbers(said, "the distortion").ravel().tolist()
    model, terms = _model_and_terms(coefficients, fisheye=_is_fisheye(_value(values, MODEL)))
    params = [fx, fy, cx + FIRST_PIXEL, cy + FIRST_PIXEL, *terms]
    return calibration_from_model(model, params, _size(values))


def read_file_storage(text: str) -> dict[str, Any]:
    """Return the entries of OpenCV's YAML or XML: numbers, texts, lists and matrices.

    Raises:
        ValueError: OpenCV cannot read it.
    """
    try:
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        return {name: _node_value(root.getNode(name)) for name in root.keys()}  # noqa: SIM118 -- no mapping
    except (cv2.error, SystemError):  # the constructor's own error comes as a SystemError
        raise ValueError("OpenCV cannot read it") from None


def _node_value(node: Any) -> Any:
    if node.isInt() or node.isReal():
        return node.real()
    if node.isString():
        return node.string()
    if node.isSeq():
        return [_node_value(node.at(k)) for k in range(node.size())]
    if node.isMap() and "data" not in node.keys():  # noqa: SIM118 -- no mapping
        return {name: _node_value(node.getNode(name)) for name in node.keys()}  # noqa: SIM118
    return node.mat()


def _model_and_terms(terms: list[float], *, fisheye: bool) -> tuple[str, list[float]]:
    """Return COLMAP's model, and its terms in COLMAP's order, which is OpenCV's."""
    if fisheye:
        if len(terms) not in (0, 4):
            raise ValueError(f"a fisheye of OpenCV has 4 distortion coefficients, not {len(terms)}")
        return "OPENCV_FISHEYE", terms or [0.0] * 4
    if len(terms) not in COUNTS:
        raise ValueError(f"{len(terms)} distortion coefficients; OpenCV has {', '.join(map(str, COUNTS[1:]))}")
    if any(terms[8:]):
        raise ValueError("coefficients of a thin prism or of a tilted sensor cannot be used")
    return "FULL_OPENCV", [*terms, *[0.0] * 8][:8]


def _is_fisheye(said: Any) -> bool:
    if isinstance(said, str):
        return any(word in said.lower() for word in FISHEYE_WORDS)
    return bool(said)


def _size(values: Mapping[str, Any]) -> tuple[int, int]:
    """Return width and height in pixels; 0 where they are not said."""
    both = _value(values, SIZE)
    if isinstance(both, Sequence) and not isinstance(both, str) and len(both) == 2:
        width, height = both
    else:
        width, height = _value(values, WIDTH) or 0, _value(values, HEIGHT) or 0
    if bool(width) != bool(height) or width < 0 or height < 0:
        raise ValueError(f"a size of {width} x {height} pixels")
    return int(width), int(height)


def _value(values: Mapping[str, Any], names: Sequence[str]) -> Any:
    """Return the value that goes by one of these names; None where there is none."""
    plain = {str(key).lower().replace("_", "").replace(" ", ""): value for key, value in values.items()}
    return next((plain[name] for name in names if plain.get(name) is not None), None)


def _numbers(value: Any, what: str) -> NDArray[np.float64]:
    """Return numbers from nested lists, or from a mapping with "data", as ROS and OpenCV write matrices."""
    if isinstance(value, Mapping):
        value = value.get("data")
    try:
        found = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{what} is not made of numbers") from None
    if not np.isfinite(found).all():
        raise ValueError(f"{what} is not finite")
    return found
