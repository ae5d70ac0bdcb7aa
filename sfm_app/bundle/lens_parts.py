"""What the user lays down about a camera: its values, that these stay, or the model that it ends with."""

from dataclasses import dataclass, replace

import numpy as np

from sfm_app.camera.models import (
    PARAMETERS,
    TERMS,
    TWO_FOCALS,
    camera_matrix,
    distortion_terms,
    projection_of_model,
    with_terms,
)
from sfm_app.camera.projection import (
    CAMERA,
    CX,
    CY,
    FISHEYE,
    FX,
    FY,
    K1,
    K2,
    K3,
    K4,
    K5,
    K6,
    P1,
    P2,
    PANORAMA,
    PERSPECTIVE,
    SEEN_ANGLE,
    SX,
    SY,
    angle_limit,
)
from sfm_app.geometry.least_squares import NormalPriors, binary_choices
from sfm_app.selfcal.priors import ASPECT, CENTER, FREE_SHARE, LENS, NARROW, WIDE
from sfm_app.types import Calibration
from sfm_app.types import camera as kinds
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

# Parts of a camera that are freed together, with their priors, for each family of lenses.
#
# Ours; the choice by marginal likelihood is that of `geometry.model_selection`. A part has a narrow prior about its
# usual value and a wide one.

LOG_FOCAL, LOG_ASPECT = FX, FY
"""Columns of log sqrt(fx fy) and log fy/fx, which replace fx and fy."""
FOCAL_SPREAD = 0.7
"""Prior standard deviation of log f about the value from mapping: hardly a constraint. Chosen by hand; not measured on
its own."""
ABSENT = 1e-4
"""Standard deviation of the terms of `Part.exact` where they are not freed, as a share of the radius of the corner: a
tenth of a pixel. They are then set to 0. Chosen by hand; not measured on its own."""


@dataclass(frozen=True, slots=True)
class Part:
    """Parameters of a camera that are freed together."""

    name: str
    places: tuple[int, ...]
    narrow: float
    """Standard deviation about the usual value; the center's in longer sides."""
    wide: float
    share: float
    """Share of cameras for which the wide prior is the right one."""
    stays: bool = False
    """Whether it keeps its value where the photos do not determine it; otherwise it moves to its usual value. Mapping
    starts from a calibrated center and aspect, but estimates distortion without a prior."""
    powers: tuple[int, ...] = ()
    """Powers of the radius that the terms are multiplied with. Their deviations then state a share of the radius at the
    corner of the photo; without powers they are those of the parameters."""
    needs: tuple[str, ...] = ()
    """Parts that are freed before this one."""
    exact: bool = False
    """Whether it is exactly at its usual value, 0, unless it is freed."""


_CENTER = Part("center", (CX, CY), NARROW[CENTER], WIDE[CENTER], FREE_SHARE[CENTER], True)
_ASPECT = Part("aspect", (LOG_ASPECT,), NARROW[ASPECT], WIDE[ASPECT], FREE_SHARE[ASPECT], True)
PERSPECTIVE_PARTS = (
    _CENTER,
    _ASPECT,
    Part("k1", (K1,), NARROW[LENS], WIDE[LENS], FREE_SHARE[LENS]),
    Part("k2", (K2,), 0.01, 0.2, 0.3),
    Part("p1 p2", (P1, P2), 0.0002, 0.002, 0.05, True),
    Part("k3", (K3,), ABSENT, 0.03, 0.1, powers=(6,), needs=("k1", "k2"), exact=True),
    Part("k4 k5 k6", (K4, K5, K6), ABSENT, 0.05, 0.05, powers=(2, 4, 6), needs=("k1", "k2", "k3"), exact=True),
)
"""The priors of center, aspect and k1 are those of `camera_priors`; the others: docs/algorithms.md, Bundle adjustment.
Chosen by hand; not measured on their own."""
FISHEYE_PARTS = (
    _CENTER,
    _ASPECT,
    Part("k1", (K1,), 0.002, 0.2, 0.5, powers=(2,)),
    Part("k2", (K2,), 0.002, 0.1, 0.3, powers=(4,)),
    Part("p1 p2", (P1, P2), ABSENT, 0.002, 0.05, powers=(1, 1), exact=True),
    Part("k3 k4", (K3, K4), ABSENT, 0.05, 0.3, powers=(6, 8), needs=("k1", "k2"), exact=True),
    Part("thin prism", (SX, SY), ABSENT, 0.002, 0.05, powers=(1, 1), needs=("p1 p2",), exact=True),
)
"""An equidistant lens is the usual one. At 175 degrees a stereographic lens has k1 0.19 and k2 0.05 of the radius, an
equisolid one k1 -0.1. docs/algorithms.md, Bundle adjustment. Chosen by hand; not measured on their own."""
PARTS = {PERSPECTIVE: PERSPECTIVE_PARTS, FISHEYE: FISHEYE_PARTS, PANORAMA: PERSPECTIVE_PARTS}
"""By family; a panorama is never asked about any."""
COUNT = len(PERSPECTIVE_PARTS)
"""Number of parts of a camera of any family."""


def part_names(family: int, chosen: BoolArray) -> tuple[str, ...]:
    """Return the names of some parts of a camera.

    Args:
        chosen: (7,) the parts.
    """
    return tuple(part.name for part, on in zip(PARTS[family], chosen, strict=True) if on)


def model_name(family: int, freed: tuple[str, ...]) -> str:
    """Return COLMAP's name of the smallest camera model that has some parts; the center alone makes no other model."""
    if family == PANORAMA:
        return "EQUIRECTANGULAR"
    steps = _FISHEYE_MODELS if family == FISHEYE else _PERSPECTIVE_MODELS
    return next((name for name, wants in steps if set(freed) & wants), steps[-1][0])


_PERSPECTIVE_MODELS = (
    ("FULL_OPENCV", {"k3", "k4 k5 k6"}),
    ("OPENCV", {"p1 p2"}),
    ("RADIAL", {"k2"}),
    ("SIMPLE_RADIAL", {"k1"}),
    ("PINHOLE", {"aspect"}),
    ("SIMPLE_PINHOLE", {""}),
)
_FISHEYE_MODELS = (
    ("THIN_PRISM_FISHEYE", {"p1 p2", "thin prism"}),
    ("OPENCV_FISHEYE", {"k3 k4", "aspect"}),
    ("RADIAL_FISHEYE", {"k2"}),
    ("SIMPLE_RADIAL_FISHEYE", {"k1"}),
    ("SIMPLE_FISHEYE", {""}),
)


@dataclass(frozen=True, slots=True, eq=False)
class LensPriors:
    """Priors on the cameras, one row each."""

    sizes: FloatArray
    """(C, 2) widths and heights in pixels."""
    family: IndexArray
    """(C,) as in `Bundle`."""
    reach: FloatArray
    """(C,) radius of the corners in focal lengths, at most that of what a fisheye shows."""
    asked: BoolArray
    """(C, 7) parts that are estimated, in the order of PARTS; the others keep their values."""
    choices: tuple[BoolArray, ...]
    """For each camera (K, 7) which parts may be freed together; those that free less come first."""
    usual: FloatArray
    """(C, 12) the usual values: of any camera, or those that the user gave for this one. Of fx and fy only the ratio
    counts."""
    fixed: BoolArray
    """(C,) cameras that keep all of their parameters."""

    @classmethod
    def from_cameras(cls, params: FloatArray, family: IndexArray, sizes: FloatArray, asked: BoolArray) -> "LensPriors":
        """Return the priors before any evidence.

        Args:
            params: (C, 12) cameras as in `Bundle`.
        """
        reach = np.hypot(*sizes.T) / (2.0 * np.sqrt(params[:, FX] * params[:, FY]))
        reach = np.where(family == FISHEYE, np.minimum(reach, SEEN_ANGLE), reach)
        choices = []
        for kind, row in zip(family, asked, strict=True):
            allowed = consistent_choices(int(kind))
            choices.append(allowed[~np.any(allowed & ~row, axis=1)])
        usual = np.zeros_like(params)
        usual[:, [FX, FY]], usual[:, [CX, CY]] = 1.0, sizes / 2.0
        return cls(sizes, family, reach, asked, tuple(choices), usual, np.zeros(len(params), np.bool_))

    @property
    def sides(self) -> FloatArray:
        """(C,) longer sides in pixels."""
        return np.asarray(self.sizes.max(axis=1), np.float64)

    def drop_lens(self, camera: int, free: BoolArray) -> "LensPriors":
        """Return the priors without some choices for a camera: those whose lens is that of one.

        Args:
            free: (7,) the choice that is barred, with all of the same radial terms.
        """
        radial = [k for k, part in enumerate(PARTS[int(self.family[camera])]) if part.name.startswith("k")]
        kept = np.any(self.choices[camera][:, radial] != free[radial], axis=1)
        choices = list(self.choices)
        choices[camera] = choices[camera][kept]
        return replace(self, choices=tuple(choices))

    def deviations(self, camera: int, free: BoolArray) -> FloatArray:
        """Return (K, 12) standard deviations of the prior of a camera under choices (K, 7)."""
        found = np.full((len(free), CAMERA), FOCAL_SPREAD)
        for k, part in enumerate(PARTS[int(self.family[camera])]):
            unit = self.sides[camera] if part.name == "center" else 1.0
            sigma = np.where(free[:, k], part.wide, part.narrow) * unit
            for place, power in zip(part.places, part.powers or (0,) * len(part.places), strict=True):
                found[:, place] = sigma * self.reach[camera] ** -power
        return found

    def precision(self, free: BoolArray) -> FloatArray:
        """Return (C, 12) precisions of the prior, the wide one for the parts in `free` (C, 7)."""
        rows = [self.deviations(camera, free[[camera]])[0] for camera in range(len(free))]
        return np.asarray(np.array(rows).reshape(-1, CAMERA) ** -2.0, np.float64)

    def choice_priors(self, trials: BoolArray, camera: int, away: FloatArray) -> NormalPriors:
        """Return the priors of one camera under each of K choices.

        Args:
            trials: (K, 7) the choices.
            away: (12,) from it to its usual values.
        """
        share = np.array([part.share for part in PARTS[int(self.family[camera])]])
        log_odds = np.sum(np.log(np.where(trials, share, 1.0 - share)), axis=1)
        return NormalPriors(self.deviations(camera, trials) ** -2.0, np.tile(away, (len(trials), 1)), log_odds)

    def prior_offsets(self, params: FloatArray) -> FloatArray:
        """Return (C, 12) offsets from the cameras to their usual values; 0 for focals and for parts not estimated."""
        away = self.usual - params
        away[:, LOG_FOCAL] = 0.0
        away[:, LOG_ASPECT] = np.log(params[:, FX] / params[:, FY]) - np.log(self.usual[:, FX] / self.usual[:, FY])
        return np.where(self.parameter_mask(self.asked), away, 0.0)

    def parameter_mask(self, parts: BoolArray) -> BoolArray:
        """Return (C, 12) mask of the parameters of some parts (C, 7), and of the focal."""
        chosen = np.ones((len(parts), CAMERA), np.bool_)
        for camera, row in enumerate(parts):
            for part, on in zip(PARTS[int(self.family[camera])], row, strict=True):
                chosen[camera, list(part.places)] = on
        return chosen

    @property
    def demanded(self) -> BoolArray:
        """(C, 7) parts that every choice frees, because the user named the model; they move, determined or not."""
        return np.array([one.all(axis=0) & (len(one) > 0) for one in self.choices], np.bool_).reshape(-1, COUNT)

    def part_mask(self, quality: str) -> BoolArray:
        """Return (C, 7) which parts have a quality: "stays" or "exact"."""
        rows = [[bool(getattr(part, quality)) for part in PARTS[int(kind)]] for kind in self.family]
        return np.array(rows, np.bool_).reshape(-1, COUNT)

    def folds(self, camera: int, params: FloatArray) -> bool:
        """Return whether the lens of a camera folds inside the photo.

        Args:
            params: (12,) a candidate for it.
        """
        if self.family[camera] == PANORAMA or not np.isfinite(params).all() or min(params[FX], params[FY]) <= 0.0:
            return False
        corners = self.sizes[camera] * np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) - params[[CX, CY]]
        farthest = float(np.hypot(*(corners / params[[FX, FY]]).T).max())
        return bool(np.isnan(angle_limit(params, int(self.family[camera]), farthest)))


def consistent_choices(family: int) -> BoolArray:
    """Return (K, 7) choices of what is freed in which no part lacks what it needs; those that free less come first."""
    names = [part.name for part in PARTS[family]]
    trials = binary_choices(len(names))
    for k, part in enumerate(PARTS[family]):
        needed = [names.index(name) for name in part.needs]
        trials = trials[~trials[:, k] | trials[:, needed].all(axis=1)]
    return trials


def step_cameras(params: FloatArray, step: FloatArray) -> FloatArray:
    """Return cameras (C, 12) after a step.

    Args:
        params: (C, 12) before it.
        step: (C, 12), with log sqrt(fx fy) and log fy/fx in place of fx and fy.
    """
    moved = params + step
    moved[:, FX] = params[:, FX] * np.exp(step[:, LOG_FOCAL] - 0.5 * step[:, LOG_ASPECT])
    moved[:, FY] = params[:, FY] * np.exp(step[:, LOG_FOCAL] + 0.5 * step[:, LOG_ASPECT])
    return moved


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
        size: (width, height) in pixels.
        deviations: (12,) their standard deviations.
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
