"""The sparse reconstruction as the rest of the program sees it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel:
    """One camera after bundle adjustment."""

    model: str
    """COLMAP's name of the camera model: OPENCV, FULL_OPENCV, OPENCV_FISHEYE, THIN_PRISM_FISHEYE, EQUIRECTANGULAR."""
    params: tuple[float, ...]
    """COLMAP's parameters of that model."""
    K: NDArray[np.float64]
    width: int
    height: int
    deviations: Mapping[str, float] = field(default_factory=dict)
    """Standard deviations: "fx", "fy", "cx", "cy" in pixels, and the others by COLMAP's names; none of a panorama."""
    determined: tuple[str, ...] = ()
    """What the photos determine besides the focal: "center", "aspect", "k1", ...; the others kept their values."""
    correlations: Mapping[str, float] = field(default_factory=dict)
    """Correlations of the parameters in `deviations`, from -1 to 1, by two names with a space between: "fx k1"."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain values for JSON."""
        plain = {field.name: getattr(self, field.name) for field in fields(self)}
        return plain | {"K": self.K.tolist(), "params": list(self.params), "determined": list(self.determined)}


@dataclass(frozen=True, slots=True)
class Scene:
    """A COLMAP model on disk, with the figures of its summary."""

    model_dir: Path
    cam_from_world: Mapping[str, NDArray[np.float64]]
    """By name of a photo that has a pose: (3, 4) [R | t]."""
    unregistered: Mapping[str, str]
    """Names of the photos without a pose, with the reason."""
    cameras: Mapping[str, CameraModel]
    """By name, as in `Intrinsics`."""
    points: int
    observations: int
    mean_reprojection_px: float
    camera_of: Mapping[str, str] = field(default_factory=dict)
    """Name of the camera by photo that has a pose."""
    gps_deviation: float | None = None
    """Relative standard deviation of the unit where GPS makes it the meter; None: the unit is arbitrary."""

    @property
    def registered(self) -> tuple[str, ...]:
        """Names of the photos that have a pose."""
        return tuple(self.cam_from_world)
