"""Parts of a camera that bundle adjustment frees together, their priors, and the user's rules about a camera.

Ours; the choice of free parts by marginal likelihood is that of `geometry.least_squares`. A part has a narrow prior
about its usual value and a wide one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sfm_app.camera import models
from sfm_app.camera.projection import SEEN_ANGLE, angle_limit
from sfm_app.camera.rows import (
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
    SX,
    SY,
)
from sfm_app.geometry.least_squares import NormalPriors, binary_choices
from sfm_app.types import Calibration, CameraPrior
from sfm_app.types.arrays import BoolArray, FloatArray, IndexArray

LOG_FOCAL, LOG_ASPECT = FX, FY
"""Columns of log sqrt(fx fy) and log fy/fx, which replace fx and fy."""
FOCAL_SPREAD = 0.7
"""Prior standard deviation of log f about the value from mapping, or about a claim that is wrong: hardly a constraint.
Chosen by hand."""
ABSENT = 1e-4
"""Narrow prior of the terms of `Part.exact`, which become 0, as a share of the corner's radius. Chosen by hand."""


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
    """Whether an undetermined part keeps its value; otherwise it moves to its usual value. Mapping starts from a
    calibrated center and aspect, but estimates distortion without a prior."""
    powers: tuple[int, ...] = ()
    """Powers of the radius in the terms, whose deviations are then shares of the radius at the corner of the photo."""
    needs: tuple[str, ...] = ()
    """Parts that are freed before this one."""
    exact: bool = False
    """Whether it is exactly at its usual value, 0, unless it is freed."""


_CENTER = Part(
    "center", (CX, CY), models.NARROW[models.CENTER], models.WIDE[models.CENTER], models.FREE_SHARE[models.CENTER], True
)
_ASPECT = Part(
    "aspect",
    (LOG_ASPECT,),
    models.NARROW[models.ASPECT],
    models.WIDE[models.ASPECT],
    models.FREE_SHARE[models.ASPECT],
    True,
)
_FOCAL = Part("focal", (LOG_FOCAL,), FOCAL_SPREAD, FOCAL_SPREAD, models.FREE_SHARE[models.FOCAL])
PERSPECTIVE_PARTS = (
    _CENTER,
    _ASPECT,
    Part("k1", (K1,), models.NARROW[models.LENS], models.WIDE[models.LENS], models.FREE_SHARE[models.LENS]),
    Part("k2", (K2,), 0.01, 0.2, 0.3),
    Part("p1 p2", (P1, P2), 0.0002, 0.002, 0.05, True),
    Part("k3", (K3,), ABSENT, 0.03, 0.1, powers=(6,), needs=("k1", "k2"), exact=True),
    Part("k4 k5 k6", (K4, K5, K6), ABSENT, 0.05, 0.05, powers=(2, 4, 6), needs=("k1", "k2", "k3"), exact=True),
    _FOCAL,
)
"""Focal, center, aspect and k1 as in `camera.models`; others: docs/algorithms/bundle-adjustment.md. Chosen by hand."""
FISHEYE_PARTS = (
    _CENTER,
    _ASPECT,
    Part("k1", (K1,), 0.002, 0.2, 0.5, powers=(2,)),
    Part("k2", (K2,), 0.002, 0.1, 0.3, powers=(4,)),
    Part("p1 p2", (P1, P2), ABSENT, 0.002, 0.05, powers=(1, 1), exact=True),
    Part("k3 k4", (K3, K4), ABSENT, 0.05, 0.3, powers=(6, 8), needs=("k1", "k2"), exact=True),
    Part("thin prism", (SX, SY), ABSENT, 0.002, 0.05, powers=(1, 1), needs=("p1 p2",), exact=True),
    _FOCAL,
)
"""An equidistant lens is the usual one. At 175 degrees a stereographic lens has k1 0.19 and k2 0.05 of the radius, an
equisolid one k1 -0.1. docs/algorithms/bundle-adjustment.md. Chosen by hand."""
PARTS = {PERSPECTIVE: PERSPECTIVE_PARTS, FISHEYE: FISHEYE_PARTS, PANORAMA: PERSPECTIVE_PARTS}
"""By family; of a panorama, none is estimated."""
COUNT = len(PERSPECTIVE_PARTS)
"""Number of parts of a camera of any family."""


def part_names(family: int, chosen: BoolArray) -> tuple[str, ...]:
    """Return the names of parts (8,) of a camera."""
    return tuple(part.name for part, on in zip(PARTS[family], chosen, strict=True) if on)


def determined_names(family: int, chosen: BoolArray) -> tuple[str, ...]:
    """Return the names of parts (8,) of a camera besides its focal, which no part leaves at its usual value."""
    return tuple(name for name in part_names(family, chosen) if name != _FOCAL.name)


def model_name(family: int, freed: tuple[str, ...]) -> str:
    """Return COLMAP's name of the smallest camera model with these parts; a free center makes no other model."""
    if family == PANORAMA:
        return "EQUIRECTANGULAR"
    steps = _FISHEYE_MODELS if family == FISHEYE else _PERSPECTIVE_MODELS
    return next((name for name, needs in steps if set(freed) & needs), steps[-1][0])


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
    """(C,) radius of the corners in focal lengths; of a fisheye, at most that of its largest angle."""
    estimated: BoolArray
    """(C, 8) parts to estimate, in the order of PARTS; the others keep their values."""
    choices: tuple[BoolArray, ...]
    """For each camera (K, 8) parts that may be freed together; choices that free less come first."""
    usual: FloatArray
    """(C, 12) usual values of any camera, or the user's values for this one. Where no focal is claimed, only the ratio
    of fx and fy counts."""
    claims: FloatArray
    """(C, 12) narrow deviations about claimed values of log f, cx, cy and k1; NaN without a claim."""
    fixed: BoolArray
    """(C,) cameras that keep all of their parameters."""

    @classmethod
    def from_cameras(
        cls, params: FloatArray, family: IndexArray, sizes: FloatArray, estimated: BoolArray,
        rules: Sequence["CameraRule"] = (),
    ) -> "LensPriors":  # fmt: skip
        """Return the priors of cameras (C, 12), as in `Bundle`, before any evidence; `rules` are one for each, or none.

        `estimated` (C, 8) are the parts to estimate where no rule decides.
        """
        reach = np.hypot(*sizes.T) / (2.0 * np.sqrt(params[:, FX] * params[:, FY]))
        reach = np.where(family == FISHEYE, np.minimum(reach, SEEN_ANGLE), reach)
        rules = rules or (NO_RULE,) * len(params)
        fixed = np.array([rule.is_kept for rule in rules], np.bool_)
        usual, claims = np.zeros_like(params), np.full_like(params, np.nan)
        usual[:, [FX, FY]], usual[:, [CX, CY]] = 1.0, sizes / 2.0
        priors = cls(sizes, family, reach, estimated.copy(), (), usual, claims, fixed)
        for row, rule in enumerate(rules):
            rule.write_values(int(family[row]), usual[row], claims[row])
        choices = [priors.consistent_choices(row) for row in range(len(params))]
        for row, rule in enumerate(rules):
            parts, own = rule.parts(int(family[row])), priors.estimated[row]
            if rule.is_kept:
                own[:] = False
            elif parts is not None:
                choices[row] = choices_of_model(parts, choices[row])
                own[:] = choices[row].any(axis=0) | _is_focal(int(family[row]))
            choices[row] = choices[row][~np.any(choices[row] & ~own, axis=1)]
        return replace(priors, choices=tuple(choices))

    def consistent_choices(self, camera: int) -> BoolArray:
        """Return all choices (K, 8) for a camera; a focal that nobody claims is no choice."""
        choices, is_focal = consistent_choices(int(self.family[camera])), _is_focal(int(self.family[camera]))
        claimed = np.isfinite(self.claims[camera, LOG_FOCAL])
        return choices if claimed else choices[~choices[:, is_focal].ravel()]

    @property
    def sides(self) -> FloatArray:
        """(C,) longer sides in pixels."""
        return np.asarray(self.sizes.max(axis=1), np.float64)

    def drop_lens(self, camera: int, free: BoolArray) -> "LensPriors":
        """Return the priors without the choices for a camera that have the radial terms of a barred one (8,)."""
        radial = [k for k, part in enumerate(PARTS[int(self.family[camera])]) if part.name.startswith("k")]
        differs = np.any(self.choices[camera][:, radial] != free[radial], axis=1)
        choices = list(self.choices)
        choices[camera] = choices[camera][differs]
        return replace(self, choices=tuple(choices))

    def deviations(self, camera: int, free: BoolArray) -> FloatArray:
        """Return (K, 12) standard deviations of the prior of a camera under choices (K, 8)."""
        deviations = np.full((len(free), CAMERA), FOCAL_SPREAD)
        for k, part in enumerate(PARTS[int(self.family[camera])]):
            unit = self.sides[camera] if part.name == "center" else 1.0
            for place, power in zip(part.places, part.powers or (0,) * len(part.places), strict=True):
                narrow, wide = np.array([part.narrow, part.wide]) * unit * self.reach[camera] ** -power
                claim = self.claims[camera, place]
                deviations[:, place] = np.where(free[:, k], wide, claim if np.isfinite(claim) else narrow)
        return deviations

    def precision(self, free: BoolArray) -> FloatArray:
        """Return (C, 12) precisions of the prior, the wide one for the parts in `free` (C, 8)."""
        rows = [self.deviations(camera, free[[camera]])[0] for camera in range(len(free))]
        return np.asarray(np.array(rows).reshape(-1, CAMERA) ** -2.0, np.float64)

    def choice_priors(self, choices: BoolArray, camera: int, offsets: FloatArray) -> NormalPriors:
        """Return the priors of one camera under choices (K, 8), for offsets (12,) from it to its usual values."""
        share = np.array([part.share for part in PARTS[int(self.family[camera])]])
        log_odds = np.sum(np.log(np.where(choices, share, 1.0 - share)), axis=1)
        return NormalPriors(self.deviations(camera, choices) ** -2.0, np.tile(offsets, (len(choices), 1)), log_odds)

    def prior_offsets(self, params: FloatArray) -> FloatArray:
        """Return (C, 12) offsets from the cameras to their usual values; 0 for those that are open or not estimated."""
        offsets = self.usual - params
        focals = np.sqrt(params[:, FX] * params[:, FY]), np.sqrt(self.usual[:, FX] * self.usual[:, FY])
        claimed = np.isfinite(self.claims[:, LOG_FOCAL])
        offsets[:, LOG_FOCAL] = np.where(claimed, np.log(focals[1] / focals[0]), 0.0)
        offsets[:, LOG_ASPECT] = np.log(params[:, FX] / params[:, FY]) - np.log(self.usual[:, FX] / self.usual[:, FY])
        return np.where(self.parameter_mask(self.estimated), offsets, 0.0)

    def parameter_mask(self, parts: BoolArray) -> BoolArray:
        """Return (C, 12) mask of the parameters of some parts (C, 8)."""
        chosen = np.ones((len(parts), CAMERA), np.bool_)
        for camera, row in enumerate(parts):
            for part, on in zip(PARTS[int(self.family[camera])], row, strict=True):
                chosen[camera, list(part.places)] = on
        return chosen

    @property
    def required(self) -> BoolArray:
        """(C, 8) parts that every choice frees because the user named the model; they move, determined or not."""
        return np.array([one.all(axis=0) & (len(one) > 0) for one in self.choices], np.bool_).reshape(-1, COUNT)

    def part_mask(self, quality: str) -> BoolArray:
        """Return (C, 8) which parts have a quality: "stays" or "exact"."""
        rows = [[bool(getattr(part, quality)) for part in PARTS[int(kind)]] for kind in self.family]
        return np.array(rows, np.bool_).reshape(-1, COUNT)

    def folds(self, camera: int, params: FloatArray) -> bool:
        """Return whether parameters (12,) of a camera fold inside the photo."""
        if self.family[camera] == PANORAMA or not np.isfinite(params).all() or min(params[FX], params[FY]) <= 0.0:
            return False
        corners = self.sizes[camera] * np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) - params[[CX, CY]]
        farthest = float(np.hypot(*(corners / params[[FX, FY]]).T).max())
        return bool(np.isnan(angle_limit(params, int(self.family[camera]), farthest)))


def _is_focal(family: int) -> BoolArray:
    return np.array([part is _FOCAL for part in PARTS[family]], np.bool_)


def consistent_choices(family: int) -> BoolArray:
    """Return choices (K, 8) in which no free part lacks a part that it needs; choices that free less come first."""
    names = [part.name for part in PARTS[family]]
    choices = binary_choices(len(names))
    for k, part in enumerate(PARTS[family]):
        needed = [names.index(name) for name in part.needs]
        choices = choices[~choices[:, k] | choices[:, needed].all(axis=1)]
    return choices


def step_cameras(params: FloatArray, step: FloatArray) -> FloatArray:
    """Return cameras (C, 12) after a step (C, 12), with log sqrt(fx fy) and log fy/fx in place of fx and fy."""
    result = params + step
    result[:, FX] = params[:, FX] * np.exp(step[:, LOG_FOCAL] - 0.5 * step[:, LOG_ASPECT])
    result[:, FY] = params[:, FY] * np.exp(step[:, LOG_FOCAL] + 0.5 * step[:, LOG_ASPECT])
    return result


PROJECTIONS = {family: projection for projection, family in models.FAMILIES.items()}


@dataclass(frozen=True, slots=True, eq=False)
class CameraRule:
    """The user's rule about one camera in bundle adjustment."""

    given: Calibration | None = None
    """The user's camera: parameters that the photos do not determine stay near these values."""
    prior: CameraPrior | None = None
    """Claim about the camera, which the photos may contradict."""
    model: str = ""
    """COLMAP's name of the camera model to fit; empty for the model that the photos support best."""

    @property
    def is_kept(self) -> bool:
        """Whether no parameter may change."""
        return self.given is not None and self.given.is_kept

    @property
    def family(self) -> int | None:
        """Required family; None where the photos choose."""
        if self.given is not None and self.is_kept:
            return models.FAMILIES[self.given.projection]
        return models.FAMILIES[models.projection_of_model(self.model)] if self.model else None

    def usual(self, family: int) -> FloatArray | None:
        """Return the user's parameters (12,); None if they are not of this family."""
        if self.given is None or models.FAMILIES[self.given.projection] != family:
            return None
        return models.row_of_calibration(self.given)

    def write_values(self, family: int, usual: FloatArray, claims: FloatArray) -> None:
        """Write the user's or the claimed parameters (12,) over usual ones, and deviations of claims over `claims`."""
        given, claim = self.usual(family), self.prior
        if given is not None:
            usual[:] = given
        elif claim is not None:
            usual[[FX, FY]], claims[LOG_FOCAL] = claim.focal_px, claim.focal_deviation_px / claim.focal_px
            if claim.center_px is not None:
                usual[[CX, CY]], claims[[CX, CY]] = claim.center_px, claim.center_deviation_px
            if claim.k1 is not None and family == PERSPECTIVE:
                usual[K1], claims[K1] = claim.k1, claim.k1_deviation

    def parts(self, family: int) -> BoolArray | None:
        """Return (8,) the parts of the model besides focal and center; None if it is open, or not of this family."""
        if not self.model or self.family != family or family == PANORAMA:
            return None
        names = (*models.TWO_FOCALS, *models.TERMS[PROJECTIONS[family]])
        has = set(models.PARAMETERS[self.model])
        rows = [
            part not in (_FOCAL, _CENTER) and has.issuperset(names[k] for k in part.places) for part in PARTS[family]
        ]
        return np.array(rows, np.bool_)


NO_RULE = CameraRule()


def calibration_from_params(
    params: FloatArray, family: int, size: tuple[int, int], deviations: FloatArray, determined: tuple[str, ...]
) -> Calibration:
    """Return parameters (12,) of `Bundle`, with deviations (12,), as a calibration by bundle adjustment.

    The camera is no panorama; `determined` names the parts that the photos determine.
    """
    K = models.camera_matrix(*(float(params[k]) for k in (FX, FY, CX, CY)))
    spread = {name: float(deviations[k]) for name, k in (("fx", FX), ("fy", FY), ("cx", CX), ("cy", CY), ("k1", K1))}
    spread = {name: value for name, value in spread.items() if np.isfinite(value)}
    held = tuple(name for name in ("center", "aspect", "k1") if name not in determined)
    return Calibration(
        K, *size, "adjustment", True, projection=PROJECTIONS[family], distortion=tuple(params[K1:].tolist()),
        spread=spread, held=held,
    )  # fmt: skip


def fit_to_model(params: FloatArray, parts: BoolArray, family: int) -> FloatArray:
    """Return a camera (12,) without the parameters of parts (8,) that its model lacks: square pixels, terms of 0."""
    fitted = params.copy()
    for part, on in zip(PARTS[family], parts, strict=True):
        if part.name == "aspect" and not on:
            fitted[[FX, FY]] = np.sqrt(params[FX] * params[FY])
        elif part not in (_FOCAL, _CENTER) and not on:
            fitted[list(part.places)] = 0.0
    return fitted


def choices_of_model(parts: BoolArray, choices: BoolArray) -> BoolArray:
    """Return those of all consistent choices (M, 8) that have exactly these parts (8,) besides focal and center."""
    is_open = np.array([part in (_FOCAL, _CENTER) for part in PARTS[PERSPECTIVE]], np.bool_)
    return choices[np.all(choices[:, ~is_open] == parts[~is_open], axis=1)]
