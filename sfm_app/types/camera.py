"""Calibrations: camera matrix, lens, standard deviations and correlations."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from itertools import combinations
from typing import Any

import numpy as np

from sfm_app.numerical import finite_entries
from sfm_app.types.arrays import FloatArray
from sfm_app.types.photos import CameraPrior, MatchedImage, PairId, Photo

PERSPECTIVE, FISHEYE, EQUIRECTANGULAR = "perspective", "fisheye", "equirectangular"
PROJECTIONS = (PERSPECTIVE, FISHEYE, EQUIRECTANGULAR)
GIVEN, KEPT, CLAIM = "given", "kept", "claim"
"""Methods of cameras from a calibration file: refined, and kept unchanged; and of a `CameraPrior` where the photos do
not determine the camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """One camera matrix with its evidence."""

    K: FloatArray
    """(3, 3) camera matrix in pixels, zero skew: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."""
    width: int
    height: int
    method: str
    """Name of the calibrator; "estimate" where the photos determine K roughly; `CLAIM` or "guess" where they do not;
    `GIVEN` or `KEPT` where the user gave it."""
    identifiable: bool
    """False when the fundamental matrices do not determine K; K is then a guess."""
    reason: str = ""
    """Why K is not identifiable; empty when it is."""
    projection: str = PERSPECTIVE
    """One of `PROJECTIONS`. With "equirectangular", a whole turn is as wide as the photo, and K only states the scale
    at its middle."""
    distortion: tuple[float, ...] = ()
    """Terms k1, k2, p1, p2, k3, k4, k5, k6 of COLMAP's FULL_OPENCV, or with sx1, sy1 at the end of its
    THIN_PRISM_FISHEYE; those that are left out at the end are 0. Before bundle adjustment, photos determine k1 of a
    perspective lens and k1 to k4 of a fisheye; the user may give all."""
    spread: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations where the calibrator estimates them: "fx", "fy", "cx", "cy" in pixels, "k1"."""
    correlations: Mapping[str, float] = field(default_factory=dict)
    """Correlations of the parameters in `spread`, from -1 to 1, by two names with a space between: "fx k1"."""
    held: tuple[str, ...] = ()
    """Parameters kept at their usual values, as the photos do not determine them: "center", "aspect", "k1"."""
    key_pairs: tuple[PairId, ...] = ()
    """Pairs of photos best suited to start a reconstruction from, by their evidence on K; best first."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """Named figures that support K: pairs used, support at the peak, ..."""

    @property
    def is_estimated(self) -> bool:
        """Whether mapping may build on K: the photos determine it, at least roughly."""
        return self.identifiable or self.method == "estimate"

    @property
    def is_claimed(self) -> bool:
        """Whether K is a claim, which the photos neither confirm nor contradict."""
        return self.method == CLAIM

    @property
    def is_given(self) -> bool:
        """Whether the user gave the camera."""
        return self.method in (GIVEN, KEPT)

    @property
    def is_kept(self) -> bool:
        """Whether the user gave the camera and wants it unchanged."""
        return self.method == KEPT

    @property
    def is_bent(self) -> bool:
        """Whether a perspective lens distorts, so that F does not describe its pairs exactly."""
        return self.projection == PERSPECTIVE and any(self.distortion)

    @property
    def radial(self) -> float:
        """k1 of a perspective lens: x_d = x_u (1 + k1 r^2) with r in focal lengths; 0 of others."""
        return self.distortion[0] if self.is_bent else 0.0

    @property
    def has_more_terms(self) -> bool:
        """Whether the user gave terms that are not estimated before bundle adjustment."""
        terms = self.distortion
        return any((*terms[2:4], *terms[6:]) if self.projection == FISHEYE else terms[1:])

    @property
    def focal_px(self) -> float:
        """Geometric mean of fx and fy."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        plain = {field.name: getattr(self, field.name) for field in fields(self)}
        tables = {"K": self.K.tolist(), "spread": dict(self.spread), "evidence": dict(self.evidence)}
        tables["correlations"] = dict(self.correlations)
        lists = {"held": list(self.held), "distortion": list(self.distortion)}
        return plain | tables | lists | {"key_pairs": [list(pair) for pair in self.key_pairs]}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Calibration":
        """Rebuild from `to_dict`; entries of other names are left out."""
        known = {field.name: values[field.name] for field in fields(cls) if field.name in values}
        pairs = tuple((int(first), int(second)) for first, second in values["key_pairs"])
        tables = {name: finite_entries(values[name]) for name in ("spread", "evidence")}
        tables["correlations"] = finite_entries(values.get("correlations", {}))  # older files have none
        plain = {"K": np.array(values["K"], np.float64), "held": tuple(values["held"]), "key_pairs": pairs}
        # older files have k1 of a perspective lens, or k1 to k4 of a fisheye
        k1, k2, k3, k4 = values.get("fisheye") or (values.get("radial", 0.0), 0.0, 0.0, 0.0)
        terms = tuple(values.get("distortion", (k1, k2, 0.0, 0.0, k3, k4)))
        return cls(**{**known, **tables, **plain, "distortion": terms})


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """One calibration per camera."""

    cameras: Mapping[str, Calibration]
    """By name of the camera; the first entry has the most photos."""
    camera_of: Mapping[str, str] = field(default_factory=dict)
    """Name of the camera by photo: its camera group, unless that was split because it held several cameras."""
    photos: Mapping[int, str] = field(default_factory=dict)
    """Name of the photo by the id that pairs use."""
    priors: Mapping[str, CameraPrior] = field(default_factory=dict)
    """Claims of a calibration file or a plug-in, by name of the photo; those of EXIF belong to the photos."""

    def camera_name(self, photo: Photo | MatchedImage) -> str:
        """Return the name of the camera that took a photo."""
        return self.camera_of.get(photo.name, photo.group)

    def camera(self, photo: Photo | MatchedImage) -> Calibration:
        """Return the camera that took a photo."""
        return self.cameras[self.camera_name(photo)]

    def divided_as(self, camera_of: Mapping[str, str]) -> dict[str, Calibration]:
        """Return all cameras by name, also those that mapping made of one: `camera_of` has their names by photo."""
        found = dict(self.cameras)
        for photo, name in camera_of.items():
            if photo in self.camera_of:
                found.setdefault(name, self.cameras[self.camera_of[photo]])
        return found

    @property
    def main(self) -> Calibration:
        """The camera that took the most photos."""
        return next(iter(self.cameras.values()))

    @property
    def K(self) -> FloatArray:
        """(3, 3) camera matrix of the camera that took the most photos."""
        return self.main.K

    @property
    def identifiable(self) -> bool:
        """Whether the photos determine the main camera's K."""
        return self.main.identifiable

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        cameras = {name: camera.to_dict() for name, camera in self.cameras.items()}
        photos = {str(key): name for key, name in self.photos.items()}
        priors = {"priors": {name: asdict(prior) for name, prior in self.priors.items()}} if self.priors else {}
        return {"cameras": cameras, "camera_of": dict(self.camera_of), "photos": photos} | priors

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Intrinsics":
        """Rebuild from `to_dict`."""
        cameras = {name: Calibration.from_dict(camera) for name, camera in values["cameras"].items()}
        photos = {int(key): name for key, name in values["photos"].items()}
        priors = {name: CameraPrior.from_dict(prior) for name, prior in values.get("priors", {}).items()}
        return cls(cameras, dict(values["camera_of"]), photos, priors)


def correlation_key(first: str, second: str) -> str:
    """Return the name of a pair of parameters, "fx k1", in the order of the parameters."""
    return f"{first} {second}"


def named_correlations(names: Sequence[str], covariance: FloatArray) -> dict[str, float]:
    """Return the correlations of parameters with variances > 0, by `correlation_key`, from a covariance (n, n)."""
    variances = np.diag(covariance)
    known = [k for k in range(len(names)) if np.isfinite(variances[k]) and variances[k] > 0.0]
    correlations = {}
    for i, j in combinations(known, 2):
        value = float(covariance[i, j] / np.sqrt(variances[i] * variances[j]))
        if np.isfinite(value):
            correlations[correlation_key(names[i], names[j])] = round(float(np.clip(value, -1.0, 1.0)), 4)
    return correlations


@dataclass(frozen=True, slots=True)
class GivenCameras:
    """Contents of a calibration file; falsy where none was given."""

    cameras: Mapping[str, Calibration] = field(default_factory=dict)
    """By name in the file. Width and height are 0 where the file does not give the size of the photos."""
    camera_of: Mapping[str, str] = field(default_factory=dict)
    """Name of the camera by photo, where the file assigns one."""
    source: str = ""
    """Path and form of the file, for people."""
    digest: str = ""
    """Hash of the contents; empty without a file."""

    def __bool__(self) -> bool:
        return bool(self.cameras)

    def camera_name(self, photo: str) -> str | None:
        """Return the name of the camera that the file assigns to a photo."""
        return self.camera_of.get(photo, photo if photo in self.cameras else None)
