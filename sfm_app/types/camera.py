"""Calibrations: camera matrix, lens, standard deviations and correlations."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfm_app.numerical import finite_entries
from sfm_app.types.photos import MatchedImage, PairId, Photo

PERSPECTIVE, FISHEYE, EQUIRECTANGULAR = "perspective", "fisheye", "equirectangular"
PROJECTIONS = (PERSPECTIVE, FISHEYE, EQUIRECTANGULAR)
GIVEN, KEPT = "given", "kept"
"""Methods of cameras from a calibration file: refined, and kept unchanged."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """One camera matrix with its evidence."""

    K: NDArray[np.float64]
    """(3, 3) camera matrix in pixels, zero skew: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]."""
    width: int
    height: int
    method: str
    """Name of the calibrator; "estimate" where the photos determine K roughly; "exif" or "guess" for a guess; `GIVEN`
    or `KEPT` where the user gave it."""
    identifiable: bool
    """False when the fundamental matrices do not determine K; K is then a guess."""
    reason: str = ""
    """Why K is not identifiable; empty when it is."""
    radial: float = 0.0
    """k1 of COLMAP's SIMPLE_RADIAL: x_d = x_u (1 + k1 r^2) with r in focal lengths; 0 where it was not estimated. Only
    with the projection "perspective"."""
    projection: str = PERSPECTIVE
    """One of `PROJECTIONS`. With "equirectangular", a whole turn is as wide as the photo, and K only states the scale
    at its middle."""
    fisheye: tuple[float, ...] = ()
    """k1, ..., k4 of COLMAP's OPENCV_FISHEYE with the projection "fisheye": the radius in focal lengths is
    theta (1 + k1 theta^2 + ... + k4 theta^8), theta the angle to the optical axis. Empty otherwise."""
    distortion: tuple[float, ...] = ()
    """The eight terms of COLMAP's FULL_OPENCV or THIN_PRISM_FISHEYE in their order, where the user gave a camera with
    more terms than `radial` or `fisheye`; these two then hold its radial terms as far as they go. Empty otherwise."""
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
        return bool(self.radial or self.distortion)

    @property
    def focal_px(self) -> float:
        """Geometric mean of fx and fy."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))

    def to_dict(self) -> dict[str, Any]:
        """Return JSON values."""
        plain = {field.name: getattr(self, field.name) for field in fields(self)}
        tables = {"K": self.K.tolist(), "spread": dict(self.spread), "evidence": dict(self.evidence)}
        tables["correlations"] = dict(self.correlations)
        lists = {"held": list(self.held), "fisheye": list(self.fisheye), "distortion": list(self.distortion)}
        if not self.distortion:
            del plain["distortion"], lists["distortion"]
        return plain | tables | lists | {"key_pairs": [list(pair) for pair in self.key_pairs]}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Calibration":
        """Rebuild from `to_dict`."""
        pairs = tuple((int(first), int(second)) for first, second in values["key_pairs"])
        tables = {name: finite_entries(values[name]) for name in ("spread", "evidence")}
        tables["correlations"] = finite_entries(values.get("correlations", {}))  # older files have none
        plain = {"K": np.array(values["K"], np.float64), "held": tuple(values["held"]), "key_pairs": pairs}
        terms = {name: tuple(values.get(name, ())) for name in ("fisheye", "distortion")}
        return cls(**{**values, **tables, **plain, **terms})


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """One calibration per camera."""

    cameras: Mapping[str, Calibration]
    """By name of the camera; the first entry has the most photos."""
    camera_of: Mapping[str, str] = field(default_factory=dict)
    """Name of the camera by photo: its camera group, unless that was split because it held several cameras."""
    photos: Mapping[int, str] = field(default_factory=dict)
    """Name of the photo by the id that pairs use."""

    def camera_name(self, photo: Photo | MatchedImage) -> str:
        """Return the name of the camera that took a photo."""
        return self.camera_of.get(photo.name, photo.group)

    def camera(self, photo: Photo | MatchedImage) -> Calibration:
        """Return the camera that took a photo."""
        return self.cameras[self.camera_name(photo)]

    @property
    def main(self) -> Calibration:
        """The camera that took the most photos."""
        return next(iter(self.cameras.values()))

    @property
    def K(self) -> NDArray[np.float64]:
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
        return {"cameras": cameras, "camera_of": dict(self.camera_of), "photos": photos}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Intrinsics":
        """Rebuild from `to_dict`."""
        cameras = {name: Calibration.from_dict(camera) for name, camera in values["cameras"].items()}
        return cls(cameras, dict(values["camera_of"]), {int(key): name for key, name in values["photos"].items()})


def correlation_key(first: str, second: str) -> str:
    """Return the name of a pair of parameters, "fx k1", in the order of the parameters."""
    return f"{first} {second}"


def named_correlations(names: Sequence[str], covariance: NDArray[np.float64]) -> dict[str, float]:
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
