"""What the user lays down about a camera: its values, that these stay, or the model that it ends with."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sfm_app.bundle_adjustment.lens_parts import PARTS
from sfm_app.geometry.camera import camera_matrix
from sfm_app.geometry.lenses.camera_models import (
    PARAMETERS,
    TERMS,
    TWO_FOCALS,
    distortion_terms,
    projection_of_model,
    with_terms,
)
from sfm_app.geometry.lenses.projections import CX, CY, FISHEYE, FX, FY, K1, PANORAMA, PERSPECTIVE
from sfm_app.types import Calibration
from sfm_app.types import calibration as kinds

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

FAMILIES = {kinds.PERSPECTIVE: PERSPECTIVE, kinds.FISHEYE: FISHEYE, kinds.EQUIRECTANGULAR: PANORAMA}
"""Families by projection."""
PROJECTIONS = {family: projection for projection, family in FAMILIES.items()}


@dataclass(frozen=True, slots=True, eq=False)
class CameraRule:
    """What holds for one camera in bundle adjustment, whatever the photos say."""

    given: Calibration | None = None
    """Camera that the user gave: where its parameters are not determined, they stay near these values."""
    model: str = ""
    """COLMAP's name of the camera model that is fitted; empty for the one that the photos support best."""

    @property
    def kept(self) -> bool:
        """Whether no parameter may change."""
        return self.given is not None and self.given.is_kept

    @property
    def family(self) -> int | None:
        """Family that the camera must have; None where the photos choose."""
        if self.given is not None and self.kept:
            return FAMILIES[self.given.projection]
        return FAMILIES[projection_of_model(self.model)] if self.model else None

    def usual(self, family: int) -> FloatArray | None:
        """Return the given parameters (12,) of a family; None where none are given in it."""
        if self.given is None or FAMILIES[self.given.projection] != family:
            return None
        return params_of_calibration(self.given)

    def parts(self, family: int) -> BoolArray | None:
        """Return (7,) which parts the model has besides its center; None where it is not of this family, or open."""
        if not self.model or self.family != family or family == PANORAMA:
            return None
        names = (*TWO_FOCALS, *TERMS[PROJECTIONS[family]])
        has = set(PARAMETERS[self.model])
        rows = [part.name != "center" and has.issuperset(names[k] for k in part.places) for part in PARTS[family]]
        return np.array(rows, np.bool_)


NO_RULE = CameraRule()


def params_of_calibration(camera: Calibration) -> FloatArray:
    """Return a perspective or fisheye camera as the parameters (12,) of `Bundle`."""
    K = camera.K
    return np.concatenate([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]], distortion_terms(camera)])


def calibration_from_params(
    params: FloatArray, family: int, size: tuple[int, int], deviations: FloatArray, determined: tuple[str, ...]
) -> Calibration:
    """Return parameters of `Bundle` as a calibration by bundle adjustment.

    Args:
        params: (12,) of a perspective camera or a fisheye.
        family: of the camera.
        size: (width, height) in pixels.
        deviations: (12,) their standard deviations.
        determined: names of the parts that the photos determine.
    """
    K = camera_matrix(*(float(params[k]) for k in (FX, FY, CX, CY)))
    spread = {name: float(deviations[k]) for name, k in (("fx", FX), ("fy", FY), ("cx", CX), ("cy", CY), ("k1", K1))}
    spread = {name: value for name, value in spread.items() if np.isfinite(value)}
    held = tuple(name for name in ("center", "aspect", "k1") if name not in determined)
    plain = Calibration(K, *size, "adjustment", identifiable=True, projection=PROJECTIONS[family], spread=spread)
    return replace(with_terms(plain, params[K1:].tolist()), held=held)


def fit_to_model(params: FloatArray, parts: BoolArray, family: int) -> FloatArray:
    """Return a camera (12,) without the parameters that its model lacks: square pixels, terms of 0.

    Args:
        params: (12,) as in `Bundle`.
        parts: (7,) that the model has.
        family: of the camera.
    """
    found = params.copy()
    for part, on in zip(PARTS[family], parts, strict=True):
        if part.name == "aspect" and not on:
            found[[FX, FY]] = np.sqrt(params[FX] * params[FY])
        elif part.name != "center" and not on:
            found[list(part.places)] = 0.0
    return found


def choices_of_model(parts: BoolArray, choices: BoolArray) -> BoolArray:
    """Return (K, 7) the choices of freed parts that make exactly a model, with and without a free center.

    Args:
        parts: (7,) that the model has besides its center.
        choices: (M, 7) all consistent choices.
    """
    center = np.array([part.name == "center" for part in PARTS[PERSPECTIVE]], np.bool_)
    return choices[np.all(choices[:, ~center] == parts[~center], axis=1)]
