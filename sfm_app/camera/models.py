"""Camera matrices, the usual camera, and COLMAP's camera models: names of parameters, and cameras made from them.

A model with fewer parameters is a larger one with zeros: every perspective one of FULL_OPENCV (Brown 1971), every
fisheye of THIN_PRISM_FISHEYE (Kannala and Brandt 2006; Weng et al. 1992).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.camera import projection as families
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


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> NDArray[np.float64]:
    """Return the (3, 3) camera matrix without skew, in the unit of its arguments."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def guessed_camera_matrix(size: tuple[int, int], focal_px: float | None = None) -> NDArray[np.float64]:
    """Return the (3, 3) matrix of a camera with square pixels, a central principal point, and a focal or a guess."""
    focal = GUESSED_FOCAL * max(size) if focal_px is None else focal_px
    return camera_matrix(focal, focal, size[0] / 2, size[1] / 2)


def panorama_matrix(size: tuple[int, int]) -> NDArray[np.float64]:
    """Return the (3, 3) matrix with the scale of an equirectangular photo at its center, in pixels per radian."""
    return camera_matrix(size[0] / (2.0 * np.pi), size[1] / np.pi, size[0] / 2, size[1] / 2)


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
"""Families of `camera.projection`, by projection."""


def projection_of_model(model: str) -> str:
    """Return the projection of one of `PARAMETERS`."""
    if model == "EQUIRECTANGULAR":
        return EQUIRECTANGULAR
    return FISHEYE if "FISHEYE" in model else PERSPECTIVE


def calibration_from_model(model: str, params: Sequence[float], size: tuple[int, int]) -> Calibration:
    """Return the camera with a model and parameters of COLMAP, as given by the user.

    Lengths are in pixels; the size of the photos is (0, 0) where unknown.

    Raises:
        ValueError: the model is not supported, or the parameters are no camera.
    """
    names = PARAMETERS.get(model)
    if names is None:
        raise ValueError(f"the camera model {model} is not supported: only {', '.join(PARAMETERS)}")
    if len(params) != len(names):
        raise ValueError(f"{model} has {len(names)} parameters ({', '.join(names)}), not {len(params)}")
    values = dict(zip(names, (float(value) for value in params), strict=True))
    projection = projection_of_model(model)
    if projection == EQUIRECTANGULAR:
        if not all(size):
            size = int(values["w"]), int(values["h"])
        return Calibration(panorama_matrix(size), *size, GIVEN, identifiable=True, projection=projection)
    fx, fy = (values.get(name, values.get("f", 0.0)) for name in ("fx", "fy"))
    if not (np.isfinite(list(values.values())).all() and fx > 0.0 and fy > 0.0):
        raise ValueError(f"the parameters of {model} are not those of a camera: {', '.join(map(str, params))}")
    plain = Calibration(
        camera_matrix(fx, fy, values["cx"], values["cy"]), *size, GIVEN, identifiable=True, projection=projection
    )
    return with_terms(plain, tuple(values.get(name, 0.0) for name in TERMS[projection]))


def with_terms(camera: Calibration, terms: Sequence[float]) -> Calibration:
    """Return a perspective camera or fisheye with the eight distortion `terms` of `TERMS`, in the smallest form."""
    k1, k2, p1, p2, k3, k4, *last = (float(term) for term in terms)
    if camera.projection == FISHEYE:
        more = any((p1, p2, *last))
        return replace(camera, radial=0.0, fisheye=(k1, k2, k3, k4), distortion=tuple(terms) if more else ())
    more = any((k2, p1, p2, k3, k4, *last))
    return replace(camera, radial=k1, fisheye=(), distortion=tuple(terms) if more else ())


def distortion_terms(camera: Calibration) -> NDArray[np.float64]:
    """Return (8,) all terms of a camera, in the order of `TERMS`; zeros of a panorama."""
    if camera.distortion:
        return np.array(camera.distortion, np.float64)
    terms = np.zeros(8)
    if camera.projection == FISHEYE:
        terms[[0, 1, 4, 5]] = camera.fisheye or (0.0, 0.0, 0.0, 0.0)
    else:
        terms[0] = camera.radial
    return terms


def params_of_calibration(camera: Calibration) -> NDArray[np.float64]:
    """Return the parameters (12,) of a camera, as in `camera.projection`."""
    K = panorama_matrix((camera.width, camera.height)) if camera.projection == EQUIRECTANGULAR else camera.K
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], distortion_terms(camera)])


def model_of_calibration(camera: Calibration) -> tuple[str, list[float]]:
    """Return the smallest of COLMAP's models with two focals that holds a camera, and its parameters."""
    values = dict(zip(TERMS[camera.projection], distortion_terms(camera).tolist(), strict=True))
    values |= {"fx": camera.K[0, 0], "fy": camera.K[1, 1], "cx": camera.K[0, 2], "cy": camera.K[1, 2]}
    fisheye = camera.projection == FISHEYE
    models = ("OPENCV_FISHEYE", "THIN_PRISM_FISHEYE") if fisheye else ("OPENCV", "FULL_OPENCV")
    for model in models:
        if not any(value for name, value in values.items() if name not in PARAMETERS[model]):
            break
    return model, [float(values[name]) for name in PARAMETERS[model]]
