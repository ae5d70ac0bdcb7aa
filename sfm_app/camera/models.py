"""Camera matrices, the usual camera, and COLMAP's camera models: names of parameters, and cameras made from them.

A model with fewer parameters is a larger one with zeros: every perspective one of FULL_OPENCV (Brown 1971), every
fisheye of THIN_PRISM_FISHEYE (Kannala and Brandt 2006; Weng et al. 1992).
"""

from collections.abc import Mapping, Sequence

import numpy as np

from sfm_app.camera import rows as families
from sfm_app.types.arrays import FloatArray
from sfm_app.types.camera import EQUIRECTANGULAR, FISHEYE, GIVEN, PERSPECTIVE, Calibration

GUESSED_FOCAL = 1.2
"""Focal length of an unknown camera, in longer sides of its photo: COLMAP's guess, by definition."""
CENTER, ASPECT, LENS, FOCAL = range(4)
"""Parts of a camera that the photos may free from their usual values: the middle, square pixels, no lens, a claim."""
NARROW = {CENTER: 0.012, ASPECT: 0.002, LENS: 0.005}
"""Standard deviations about the usual value: of the center in longer sides, of log fy/fx, of k1.
docs/algorithms/zero-curves.md, 3; by hand."""
WIDE = {CENTER: 0.15, ASPECT: 0.25, LENS: 0.2}
"""The same for freed parts. docs/algorithms/zero-curves.md, 3; by hand."""
FREE_SHARE = {CENTER: 0.3, ASPECT: 0.05, LENS: 0.5, FOCAL: 0.3}
"""Share of photo sets in which the wide prior is the right one; for FOCAL, in which a claim is wrong.
docs/algorithms/zero-curves.md, 3; by hand."""


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> FloatArray:
    """Return the (3, 3) camera matrix without skew, in the unit of its arguments."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def guessed_camera_matrix(size: tuple[int, int], focal_px: float | None = None) -> FloatArray:
    """Return the (3, 3) matrix of a camera with square pixels, a central principal point, and a focal or a guess."""
    focal = GUESSED_FOCAL * max(size) if focal_px is None else focal_px
    return camera_matrix(focal, focal, size[0] / 2, size[1] / 2)


def panorama_matrix(size: tuple[float, float]) -> FloatArray:
    """Return the (3, 3) matrix with the scale of an equirectangular photo at its center, in pixels per radian."""
    return camera_matrix(size[0] / (2.0 * np.pi), size[1] / np.pi, size[0] / 2, size[1] / 2)


def panorama_camera(size: tuple[int, int]) -> Calibration:
    """Return the camera of panoramas of (width, height) pixels."""
    spread = dict.fromkeys(TWO_FOCALS, 0.0)
    return Calibration(panorama_matrix(size), *size, "panorama", True, projection=EQUIRECTANGULAR, spread=spread)


SHARED = ("k1", "k2", "p1", "p2", "k3", "k4")
TERMS: Mapping[str, tuple[str, ...]] = {PERSPECTIVE: (*SHARED, "k5", "k6"), FISHEYE: (*SHARED, "sx1", "sy1")}
"""Names of the eight terms of `Calibration.distortion`, by projection."""
ONE_FOCAL, TWO_FOCALS = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")
PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "SIMPLE_PINHOLE": ONE_FOCAL,
    "PINHOLE": TWO_FOCALS,
    "SIMPLE_RADIAL": (*ONE_FOCAL, "k1"),
    "RADIAL": (*ONE_FOCAL, "k1", "k2"),
    "OPENCV": (*TWO_FOCALS, "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": (*TWO_FOCALS, *TERMS[PERSPECTIVE]),
    "SIMPLE_FISHEYE": ONE_FOCAL,
    "FISHEYE": TWO_FOCALS,
    "SIMPLE_RADIAL_FISHEYE": (*ONE_FOCAL, "k1"),
    "RADIAL_FISHEYE": (*ONE_FOCAL, "k1", "k2"),
    "OPENCV_FISHEYE": (*TWO_FOCALS, "k1", "k2", "k3", "k4"),
    "THIN_PRISM_FISHEYE": (*TWO_FOCALS, *TERMS[FISHEYE]),
    "EQUIRECTANGULAR": ("w", "h"),
}
"""Names of the parameters of the supported models, in COLMAP's order. By definition."""


FAMILIES = {PERSPECTIVE: families.PERSPECTIVE, FISHEYE: families.FISHEYE, EQUIRECTANGULAR: families.PANORAMA}
"""Families of `camera.rows`, by projection."""
INDEX = {name: k for terms in TERMS.values() for k, name in enumerate((*TWO_FOCALS, *terms))}
"""Index in a row (12,) of `camera.rows` of each parameter but f, w and h."""
FILE_MODELS = {
    families.PERSPECTIVE: ("OPENCV", "FULL_OPENCV"),
    families.FISHEYE: ("OPENCV_FISHEYE", "THIN_PRISM_FISHEYE"),
}
"""Models of refined and written cameras, by family; the smaller one first."""


def projection_of_model(model: str) -> str:
    """Return the projection of one of `PARAMETERS`."""
    if model == "EQUIRECTANGULAR":
        return EQUIRECTANGULAR
    return FISHEYE if "FISHEYE" in model else PERSPECTIVE


def row_of_model(model: str, params: Sequence[float] | FloatArray) -> FloatArray:
    """Return a camera with a model and parameters of COLMAP as a row (12,) of `camera.rows`."""
    row = np.zeros(families.CAMERA)
    if model == "EQUIRECTANGULAR":
        return row_of_calibration(panorama_camera((int(params[0]), int(params[1]))))
    for name, value in zip(PARAMETERS[model], params, strict=True):
        row[[families.FX, families.FY] if name == "f" else INDEX[name]] = value
    return row


def params_of_row(row: FloatArray, model: str) -> list[float]:
    """Return the parameters of a model of COLMAP that holds a row (12,) but for its aspect."""
    fx, fy, cx, cy = row[:4]
    values = {"f": (fx * fy) ** 0.5, "w": 2.0 * cx, "h": 2.0 * cy}
    return [float(values[name] if name in values else row[INDEX[name]]) for name in PARAMETERS[model]]


def file_model(row: FloatArray, family: int) -> str:
    """Return the smallest of FILE_MODELS that holds a row (12,) of a perspective camera or a fisheye."""
    small, large = FILE_MODELS[family]
    return large if np.delete(row, [INDEX[name] for name in PARAMETERS[small]]).any() else small


def calibration_from_model(model: str, params: Sequence[float], size: tuple[int, int]) -> Calibration:
    """Return the camera of a model and parameters of COLMAP; size (0, 0) if unknown, ValueError if it is none."""
    names = PARAMETERS.get(model)
    if names is None:
        raise ValueError(f"the camera model {model} is not supported: only {', '.join(PARAMETERS)}")
    if len(params) != len(names):
        raise ValueError(f"{model} has {len(names)} parameters ({', '.join(names)}), not {len(params)}")
    projection = projection_of_model(model)
    if projection == EQUIRECTANGULAR:
        size = size if all(size) else (int(params[0]), int(params[1]))
        return Calibration(panorama_matrix(size), *size, GIVEN, identifiable=True, projection=projection)
    row = row_of_model(model, params)
    if not np.isfinite(row).all() or row[:2].min() <= 0.0:
        raise ValueError(f"the parameters of {model} are not those of a camera: {', '.join(map(str, params))}")
    K, terms = camera_matrix(*row[:4].tolist()), tuple(row[4:].tolist())
    return Calibration(K, *size, GIVEN, identifiable=True, projection=projection, distortion=terms)


def row_of_calibration(camera: Calibration) -> FloatArray:
    """Return a camera as a row (12,) of `camera.rows`."""
    panorama = camera.projection == EQUIRECTANGULAR
    K = panorama_matrix((camera.width, camera.height)) if panorama else camera.K
    row = np.zeros(families.CAMERA)
    row[:4] = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    row[4 : 4 + len(camera.distortion)] = camera.distortion
    return row
